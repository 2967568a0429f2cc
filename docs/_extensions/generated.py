"""Parts of pages that are generated from the code: the directive ``generated``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import before_after
import benchmark_results
import campaign_keys
import command_line
import product_variables
import python_api
import stiff_cases
import verdicts
from sphinx.util.docutils import SphinxDirective

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx

PARTS: Final[dict[str, Callable[[], str]]] = {
    "accuracy": partial(benchmark_results.page, "accuracy"),
    "before-after": before_after.page,
    "campaign-keys": campaign_keys.page,
    "command-line": command_line.page,
    "every-function": python_api.every_function,
    "memory": partial(benchmark_results.page, "memory"),
    "modules": python_api.offered,
    "product-variables": product_variables.page,
    "published": partial(benchmark_results.page, "published"),
    "scoreboard": benchmark_results.scoreboard,
    "stability": partial(benchmark_results.page, "stability"),
    "stiff-cases": stiff_cases.page,
    "throughput": partial(benchmark_results.page, "throughput"),
    "varying-lidar-ratio": partial(
        benchmark_results.page, "stability", "networks, varying lidar ratio"
    ),
    "verdicts": verdicts.page,
}


class Generated(SphinxDirective):
    """Markdown of one of the parts."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return what the part is parsed to."""
        # Code may have changed since, which Sphinx does not see.
        self.env.note_reread()
        text = PARTS[self.arguments[0]]()
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def _write_pages(app: Sphinx) -> None:
    python_api.write_pages(Path(app.srcdir) / "reference" / "made")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("generated", Generated)
    app.connect("builder-inited", _write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

"""Page templates and the shared style of reports and the site."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from lidarops.figures.wording import visible


@cache
def page_style() -> str:
    """Return the style sheet that reports and the site share."""
    return Path(__file__).with_name("page.css").read_text(encoding="utf-8")


@cache
def environment(package: str) -> Environment:
    """Return the environment of the templates in the folder ``templates`` of a package.

    Every text is escaped, with its control characters shown.
    """
    return Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: visible(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )

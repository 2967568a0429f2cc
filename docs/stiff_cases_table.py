"""Regenerate ``docs/stiff_cases.md``: ``PYTHONPATH=tests python docs/stiff_cases_table.py``."""

from __future__ import annotations

from pathlib import Path

from support.stiff import CASES
from support.stiff.cases import Retrieval

PAGE = Path(__file__).with_name("stiff_cases.md")
HEAD = """# Stiff and extreme cases

Difficult input with a known answer, in closed form or to 60 digits. `tests/stiff` checks all
of them; any other exception and any warning is a failure.
"""


def page() -> str:
    """Return the page."""
    lines = [HEAD]
    for retrieval in Retrieval:
        lines += [f"## {retrieval.value.capitalize()}\n", "| case | expected |", "| --- | --- |"]
        lines += [f"| {c.name} | {c} |" for c in CASES if c.retrieval is retrieval]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")

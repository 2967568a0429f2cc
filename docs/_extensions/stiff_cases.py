"""The page of the stiff and extreme cases, from those that tests check."""

from __future__ import annotations

from support.stiff import CASES
from support.stiff.cases import Retrieval
from tables import table


def page() -> str:
    """Return a section for each retrieval."""
    lines = []
    for retrieval in Retrieval:
        cases = [case for case in CASES if case.retrieval is retrieval]
        lines += [f"## {retrieval.value.capitalize()}"]
        lines += table(("case", "expected"), [(case.name, str(case)) for case in cases])
    return "\n".join(lines)

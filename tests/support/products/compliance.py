"""What compliance-checker finds in a product, in strict mode, and what it may find."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xarray as xr
from compliance_checker.runner import CheckSuite, ComplianceChecker

from lidarops.netcdf.variables import layout_of


def findings(path: Path) -> tuple[set[str], set[str]]:
    """Everything that the checker has to say of a file: of CF, and of ACDD."""
    checks = ["cf:1.11", "acdd:1.3"]
    CheckSuite.load_all_available_checkers()
    report = path.with_suffix(".json")
    ComplianceChecker.run_checker(
        str(path), checks, 0, "strict", output_filename=str(report), output_format="json"
    )
    results = json.loads(report.read_text(encoding="utf-8"))
    said = []
    for check in checks:
        said.append(set(_said(results[check]["all_priorities"])))
        assert results[check]["possible_points"] > 90
        full = results[check]["scored_points"] == results[check]["possible_points"]
        assert full == (not said[-1])
    return said[0], said[1]


def _said(results: list[dict[str, Any]]) -> Iterator[str]:
    for result in results:
        scored, possible = result["value"]
        # A test that is passed may still give advice, such as on the default calendar.
        if scored != possible:
            yield from (f"{result['name']} {message}" for message in result["msgs"])
        yield from _said(result["children"])


def permitted(kind: str, data: xr.Dataset) -> set[str]:
    """One finding for each quantity that CF has no standard name for; none is left out."""
    return {
        f'variable "{row.name}" missing the following attributes: standard_name'
        for row in layout_of(kind).variables
        # The checker takes coded variables for flags, not for quantities.
        if row.standard_name is None and not row.states
        if row.name in data or not row.optional
    }

"""What compliance-checker finds in a product, in strict mode, and what it may find."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final
from unittest import mock

import xarray as xr
from compliance_checker.cf import util
from compliance_checker.runner import CheckSuite, ComplianceChecker

from lidarops.netcdf.variables import layout_of

_SEARCHES: Final = (
    "get_auxiliary_coordinate_variables",
    "get_axis_variables",
    "get_bounds_variables",
    "get_cell_boundary_variables",
    "get_geophysical_variables",
    "get_instrument_variables",
    "get_latitude_variables",
    "get_longitude_variables",
    "get_platform_variables",
    "get_time_variables",
    "get_z_variables",
)
"""Searches among all variables of a file, which the checker repeats for each variable."""


def _once(search: Callable[[Any], list[str]]) -> Callable[[Any], list[str]]:
    """Return a search that is done once for each open file; callers may change what they get."""
    cached = cache(search)
    return lambda file: list(cached(file))


def findings(path: Path) -> tuple[set[str], set[str]]:
    """Everything that the checker has to say of a file: of CF, and of ACDD."""
    checks = ["cf:1.11", "acdd:1.3"]
    CheckSuite.load_all_available_checkers()
    report = path.with_suffix(".json")
    with mock.patch.multiple(util, **{name: _once(getattr(util, name)) for name in _SEARCHES}):
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

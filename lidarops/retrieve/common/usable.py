"""Test of single values within compiled loops."""

from __future__ import annotations

from typing import Final

from lidarops.retrieve.common.compiled_code import compiled

HUGE: Final = 1e300
"""Magnitude from which a value counts as missing: a quick test for infinity and NaN."""


@compiled
def usable(power: float, variance: float) -> bool:
    """Return whether a power and its variance are finite, and the variance not negative."""
    return abs(power) < HUGE and 0.0 <= variance < HUGE

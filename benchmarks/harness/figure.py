"""A measured number with its Monte Carlo error, and its text."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
_ROUNDING: Final = 1e-12
"""Relative error of sums of equal values, which is no Monte Carlo error."""


class Unit(StrEnum):
    """Unit of a value, which selects how it is written."""

    NUMBER = ""
    SHARE = "1"
    """0 to 1, written in percent."""
    TIME = "ns"
    """Written in a suitable unit and drawn in microseconds."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its Monte Carlo standard error, which is 0 without one."""

    value: float
    error: float = 0.0
    unit: Unit = Unit.NUMBER

    def times(self, factor: float) -> Figure:
        """Return the figure in another unit of the same kind."""
        return replace(self, value=factor * self.value, error=factor * self.error)


def share(value: Figure | float) -> Figure:
    """Return a figure that is written in percent."""
    return replace(value if isinstance(value, Figure) else Figure(value), unit=Unit.SHARE)


def cpu_time(nanoseconds: float) -> Figure:
    """Return the figure of a time."""
    return Figure(nanoseconds, unit=Unit.TIME)


def with_error(value: float, error: float) -> str:
    """Return a value with its error in units of the last digit."""
    if not error > _ROUNDING * abs(value):
        return f"{value:,.0f}" if abs(value) >= 1e3 else f"{value:.3g}"
    digits = max(-math.floor(math.log10(error)), 0)
    # Zero has no sign.
    shown = round(value, digits) + 0.0
    return f"{shown:.{digits}f}({error * 10**digits:.0f})"


def share_text(share: float) -> str:
    """Return a share that was chosen, not measured, in percent."""
    return f"{100.0 * share:g} %"


def format_time(nanoseconds: float) -> str:
    """Return a time in s, ms, µs or ns."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"

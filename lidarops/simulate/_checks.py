"""Checks of arguments: refuse values that no real lidar has, and name the argument."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import LidarOpsError


class SimulationInputError(LidarOpsError, ValueError):
    """A lidar, a pulse or an atmosphere that cannot be simulated."""


def positive(field: str, value: float, unit: str = "") -> None:
    """Raise unless `value` is positive and finite."""
    if not (math.isfinite(value) and value > 0.0):
        raise _refusal(field, value, unit, "be positive and finite")


def not_negative(field: str, value: float, unit: str = "") -> None:
    """Raise unless `value` is finite and not negative."""
    if not (math.isfinite(value) and value >= 0.0):
        raise _refusal(field, value, unit, "be finite and not negative")


def between(field: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise unless `value` lies between `low` and `high`, ends included."""
    if not low <= value <= high:
        raise _refusal(field, value, unit, f"lie between {low:g} and {high:g}")


def profile(field: str, values: NDArray[np.float64], shape: tuple[int, ...], unit: str) -> None:
    """Raise unless a profile has this shape and its values are finite and not negative."""
    if values.shape != shape:
        raise SimulationInputError(f"has shape {values.shape}, not {shape}", field=field)
    # NaN passes neither comparison.
    if not (values.min(initial=0.0) >= 0.0 and values.max(initial=0.0) < np.inf):
        where = int(np.argmin(np.isfinite(values) & (values >= 0.0)))
        raise _refusal(f"{field}[{where}]", float(values[where]), unit, "not be negative or NaN")


def ascending(field: str, values: NDArray[np.float64]) -> None:
    """Raise unless a grid has one axis and at least two ascending values."""
    if values.ndim != 1 or values.size < 2 or not np.all(np.diff(values) > 0.0):
        raise SimulationInputError("must be one axis of at least 2 ascending values", field=field)


def _refusal(field: str, value: Any, unit: str, rule: str) -> SimulationInputError:
    text = f"{value:g} {unit}".rstrip()
    return SimulationInputError(f"must {rule}, not {text}", field=field)

"""Arguments of the retrievals, checked and brought to one shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError

Array = npt.NDArray[np.float64]
_Any = TypeVar("_Any", bound=np.generic)

SHORTEST_RANGE: Final = 50.0
"""m; a profile that ends nearer is taken for one whose range is in km."""


@dataclass(frozen=True, slots=True)
class Profiles:
    """Profiles as rows, range ascending."""

    power: npt.NDArray[Any]
    """(profile, bin), float32 or float64, native and contiguous."""
    range: Array
    """(bin,), m."""
    leading: tuple[int, ...]
    """Shape of the leading axes."""
    reversed: bool
    """Whether the range came descending."""

    def shaped(self, values: npt.NDArray[_Any]) -> npt.NDArray[_Any]:
        """Give one value a profile the shape of the leading axes."""
        return values.reshape(self.leading)


def profiles(power: npt.ArrayLike, range: npt.ArrayLike) -> Profiles:  # noqa: A002
    """Check power and range.

    Raises
    ------
    RetrievalInputError
        Where types, shapes or the range cannot be right.
    """
    distance = _real(range, "range").astype(np.float64)
    values = _real(power, "power")
    if distance.ndim != 1 or values.ndim < 1 or values.shape[-1] != distance.size:
        raise RetrievalInputError(
            f"has shape {values.shape}, range has shape {distance.shape}",
            field="power",
            remedy="the last axis of power is range",
        )
    if distance.size == 0:
        raise RetrievalInputError("holds no bins", field="range")
    backward = distance.size > 1 and bool(distance[0] > distance[-1])
    if backward:
        distance, values = distance[::-1], values[..., ::-1]
    _check_range(distance)
    kind = np.float32 if values.dtype in (np.float32, np.float16) else np.float64
    rows = np.ascontiguousarray(values.reshape(-1, distance.size), dtype=kind)
    return Profiles(rows, np.ascontiguousarray(distance), values.shape[:-1], backward)


def _check_range(distance: Array) -> None:
    if not np.all(np.isfinite(distance)) or distance[0] <= 0 or not np.all(np.diff(distance) > 0):
        raise RetrievalInputError(
            "must be finite, positive and strictly monotonic",
            field="range",
            remedy="drop the bins at or behind the lidar",
        )
    if distance[-1] < SHORTEST_RANGE:
        raise RetrievalInputError(
            f"ends at {distance[-1]:g}, which is no lidar range in m",
            field="range",
            remedy="give m, not km",
        )


def _real(values: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise RetrievalInputError(f"has type {array.dtype}", field=name, remedy="give real numbers")
    return array


def spread(values: npt.ArrayLike, given: Profiles, name: str) -> Array:
    """Broadcast something over bins to rows of profiles, or to one row for all.

    Raises
    ------
    RetrievalInputError
        Where it does not broadcast to the power, or holds a negative value.
    """
    array = _real(values, name).astype(np.float64)
    bins = given.range.size
    if array.ndim and array.shape[-1] == bins and given.reversed:
        array = array[..., ::-1]
    with np.errstate(invalid="ignore"):
        if (array < 0).any():
            raise RetrievalInputError("is negative", field=name, remedy="give squares of noise")
    try:
        if array.ndim <= 1:
            return np.ascontiguousarray(np.broadcast_to(array, (1, bins)))
        whole = np.broadcast_to(array, (*given.leading, bins))
    except ValueError as error:
        raise RetrievalInputError(
            f"has shape {array.shape}, which does not broadcast to {(*given.leading, bins)}",
            field=name,
            remedy="give one value, one a bin, or one a bin and profile",
        ) from error
    return np.ascontiguousarray(whole.reshape(-1, bins))


def is_uniform(range: Array) -> bool:  # noqa: A002 - the field's word
    """Return whether the bins are equidistant to the rounding of a coordinate."""
    steps = np.diff(range)
    tolerance = 1e-6 * np.abs(steps).mean() + 4.0 * np.finfo(np.float32).eps * range[-1]
    return steps.size == 0 or bool(np.ptp(steps) <= tolerance)

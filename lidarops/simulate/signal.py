"""The lidar equation for a short pulse: from optical properties along a beam to a signal.

`lidarops.simulate.pulse` computes the signal of a pulse of any length and shape.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import LidarOpsError

Array = NDArray[np.float64]

_FARTHEST: Final = 1.0e9
"""m: the Moon is nearer, and no lidar reaches farther."""


class SimulationInputError(LidarOpsError, ValueError):
    """A lidar, a pulse or an atmosphere that cannot be simulated."""


def check_positive(field: str, value: float, unit: str = "") -> None:
    """Raise unless `value` is positive and finite."""
    if not (math.isfinite(value) and value > 0.0):
        raise _refusal(field, value, unit, "be positive and finite")


def check_not_negative(field: str, value: float, unit: str = "") -> None:
    """Raise unless `value` is finite and not negative."""
    if not (math.isfinite(value) and value >= 0.0):
        raise _refusal(field, value, unit, "be finite and not negative")


def check_between(field: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise unless `value` lies between `low` and `high`, ends included."""
    if not low <= value <= high:
        raise _refusal(field, value, unit, f"lie between {low:g} and {high:g}")


def check_profile(
    field: str, values: NDArray[np.float64], shape: tuple[int, ...], unit: str
) -> None:
    """Raise unless a profile has this shape and its values are finite and not negative."""
    if values.shape != shape:
        raise SimulationInputError(f"has shape {values.shape}, not {shape}", field=field)
    # NaN passes neither comparison.
    if not (values.min(initial=0.0) >= 0.0 and values.max(initial=0.0) < np.inf):
        where = int(np.argmin(np.isfinite(values) & (values >= 0.0)))
        raise _refusal(f"{field}[{where}]", float(values[where]), unit, "not be negative or NaN")


def check_ascending(field: str, values: NDArray[np.float64]) -> None:
    """Raise unless a grid has one axis and at least two ascending values."""
    if values.ndim != 1 or values.size < 2 or not np.all(np.diff(values) > 0.0):
        raise SimulationInputError("must be one axis of at least 2 ascending values", field=field)


def _refusal(field: str, value: Any, unit: str, rule: str) -> SimulationInputError:
    text = f"{value:g} {unit}".rstrip()
    return SimulationInputError(f"must {rule}, not {text}", field=field)


def bin_centres(bins: int, bin_width: float, offset: float = 0.0) -> Array:
    """Return the range of the centres of bins, m: (j + 1/2) bin_width + offset.

    A bin holds the light that returns while it is open, so its signal belongs to its centre. At
    the start of the bin the lidar equation would be off by bin_width / R.
    """
    check_not_negative("bins", bins)
    check_positive("bin_width", bin_width, "m")
    check_between("offset", offset, -_FARTHEST, _FARTHEST, "m")
    return (np.arange(bins, dtype=np.float64) + 0.5) * bin_width + offset


def sine_overlap(distance: Array, full_overlap_range: float) -> Array:
    r"""Return the share of the beam that the telescope sees, 1, at ranges in m.

    Parameters
    ----------
    distance : ndarray, m
    full_overlap_range : float, m
        From which on the overlap is complete; for 0 it is 1 for all R > 0.

    Notes
    -----
    :math:`O(R) = \sin^2(\pi R / 2 R_f)` up to the range of full overlap :math:`R_f`, exactly 1
    beyond: smooth at both ends, and of second order at R = 0, where :math:`R^{-2}` diverges.
    """
    check_not_negative("full_overlap_range", full_overlap_range, "m")
    if full_overlap_range == 0.0:
        return np.where(distance > 0.0, 1.0, 0.0)
    fraction = np.clip(distance / full_overlap_range, 0.0, 1.0)
    return np.where(fraction < 1.0, np.sin(0.5 * np.pi * fraction) ** 2, 1.0)


def optical_depth(distance: Array, extinction: Array) -> Array:
    """Return the optical depth from the lidar to each bin centre, 1.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Bin centres, ascending.
    extinction : ndarray, m-1, shape (..., bins)
        At the bin centres.

    Notes
    -----
    The extinction is taken as constant within a bin, and as that of the first bin from the lidar
    to there: exact for constant extinction. Nothing attenuates before the pulse leaves (R <= 0).
    """
    edges = np.concatenate([[0.0], 0.5 * (distance[1:] + distance[:-1])])
    before = np.clip(edges, 0.0, None)
    step = np.diff(before)
    to_edge = np.zeros(extinction.shape)
    np.cumsum(extinction[..., :-1] * step, axis=-1, out=to_edge[..., 1:])
    depth: Array = to_edge + extinction * np.clip(distance - before, 0.0, None)
    return depth


def backscatter_signal(
    distance: Array,
    *,
    extinction: Array,
    backscatter: Array,
    system_constant: float,
    full_overlap_range: float = 0.0,
    returning_extinction: Array | None = None,
) -> Array:
    r"""Return the signal of backscatter at the bin centres, in the unit of the system constant.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Range of the bin centres. Bins at R <= 0 hold no signal.
    extinction : ndarray, m-1, shape (bins,)
        At the wavelength of the laser.
    backscatter : ndarray, m-1 sr-1, shape (bins,)
        From the laser wavelength into the detected wavelength.
    system_constant : float, MHz m3 sr
        Or W m3 sr for a power.
    full_overlap_range : float, m
        Of `sine_overlap`.
    returning_extinction : ndarray, m-1, shape (bins,), optional
        At the detected wavelength, where scattering changes it (Raman); by default that of the
        laser.

    Raises
    ------
    SimulationInputError
        If a property is negative or not finite, or the ranges do not ascend.

    Notes
    -----
    .. math:: P(R) = K O(R) \beta(R) R^{-2} \exp(-\tau_L(R) - \tau_\lambda(R))

    at the bin centre, for a pulse that is short against the bin. It is less than the mean over
    the bin by the fraction :math:`((1/R + \sigma)^2 + 1/(2 R^2)) \Delta R^2 / 6`: 1.6e-4 at 300 m
    for bins of 7.5 m.

    References
    ----------
    `vasylkivskyi2009`, equations 15 and 22 (23 where both wavelengths are equal), taken at the
    bin centre.
    """
    if distance.ndim != 1 or distance.size > 1:
        check_ascending("distance", distance)
    if not np.all(np.abs(distance[-1:]) <= _FARTHEST):
        raise SimulationInputError(f"ends at {distance[-1]:g} m", field="distance")
    check_not_negative("system_constant", system_constant, "MHz m3 sr")
    check_profile("extinction", extinction, distance.shape, "m-1")
    check_profile("backscatter", backscatter, distance.shape, "m-1 sr-1")
    if returning_extinction is not None:
        check_profile("returning_extinction", returning_extinction, distance.shape, "m-1")
    two_way = extinction + (extinction if returning_extinction is None else returning_extinction)
    positive = distance > 0.0
    safe = np.where(positive, distance, 1.0)
    gathered = sine_overlap(distance, full_overlap_range) * backscatter / safe**2
    transmitted = np.exp(-optical_depth(distance, two_way))
    return np.where(positive, system_constant * gathered * transmitted, 0.0)

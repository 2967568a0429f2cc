r"""Signal of a laser pulse of any shape and length, on a detector that integrates over bins.

A pulse of power E F(t) returns from range R at the time t = 2 R / c. Light of its later parts,
from nearer ranges, arrives at the same time:

.. math:: P(R) = K \int \beta(R') T(R') O(R') F(2 (R - R') / c) \frac{dR'}{R'^2} \frac{2}{c}

(`vasylkivskyi2009`, 20, with K = E A eta c / 2). A detector that integrates over a bin acts
like a longer pulse. The integral is a sum over cells of the pulse. Each cell from R_a to R_b
is taken at the geometric mean of its edges with the weight :math:`(R_b - R_a) / (R_a R_b)`, which
is the integral of :math:`R^{-2}` itself: a rectangular pulse gives the near-range factor
:math:`(c \tau / 2) / [R (R - c \tau / 2)]` to the last digits, at any range behind the pulse.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from lidarops.campaign import simulated_instrument as settings
from lidarops.constants import SPEED_OF_LIGHT
from lidarops.simulate.atmosphere import BeamPath
from lidarops.simulate.signal import (
    SimulationInputError,
    bin_centres,
    check_ascending,
    check_between,
    check_not_negative,
    check_positive,
    check_profile,
)

Array = NDArray[np.float64]

_FWHM: Final = 2.0 * math.sqrt(2.0 * math.log(2.0))
_MOST_CELLS: Final = 100_000
_CELLS_OF_PULSE: Final = 32
_CELLS_OF_BIN: Final = 5
_DECAYS: Final = 16.0
_REACH: Final = 3.0
"""Standard deviations."""


@dataclass(frozen=True, slots=True)
class Pulse(ABC):
    """Power of a laser pulse of unit energy over time; its peak leaves at time zero, range 0."""

    width: float
    """s: duration of a rectangle, full width at half maximum of a Gaussian, or the time in which
    the power of an exponential falls to 1/e."""
    ends: ClassVar[tuple[float, float]]
    """Where the pulse is cut, in units of time."""

    def __post_init__(self) -> None:
        check_between("width", self.width, 1e-15, 1e-3, "s")

    @property
    def unit(self) -> float:
        """Unit of the time in which the shape is given, s."""
        return self.width

    @property
    def start(self) -> float:
        """Time before which no energy leaves, s."""
        return self.ends[0] * self.unit

    @property
    def stop(self) -> float:
        """Time after which no energy leaves, s."""
        return self.ends[1] * self.unit

    def passed(self, time: Array) -> Array:
        """Return the share of the energy that has left by a time (s), from 0 to 1."""
        return self._share(np.clip(time / self.unit, *self.ends))

    def passed_integral(self, time: Array) -> Array:
        """Return the integral of `passed` up to a time, s."""
        integral = self._integral(np.clip(time / self.unit, *self.ends))
        return self.unit * integral + np.clip(time - self.stop, 0.0, None)

    @abstractmethod
    def _share(self, u: Array) -> Array:
        """Return `passed` at times in units."""

    @abstractmethod
    def _integral(self, u: Array) -> Array:
        """Return the integral of `_share` up to times in units."""


class RectangularPulse(Pulse):
    """Constant power for a given time; the leading edge leaves at time zero."""

    ends = (0.0, 1.0)

    def _share(self, u: Array) -> Array:
        return u

    def _integral(self, u: Array) -> Array:
        return 0.5 * u**2


class GaussianPulse(Pulse):
    """Gaussian power, cut at 3 standard deviations on both sides of its peak, at time zero."""

    ends = (-_REACH, _REACH)

    @property
    def unit(self) -> float:
        """Standard deviation of the uncut Gaussian, s."""
        return self.width / _FWHM

    def _share(self, u: Array) -> Array:
        cut = ndtr(-_REACH)
        share: Array = (ndtr(u) - cut) / (1.0 - 2.0 * cut)
        return share

    def _integral(self, u: Array) -> Array:
        cut = ndtr(-_REACH)
        low = -_REACH * cut + _density(np.array(_REACH))
        inside = u * ndtr(u) + _density(u) - low - cut * (u + _REACH)
        integral: Array = inside / (1.0 - 2.0 * cut)
        return integral


class ExponentialPulse(Pulse):
    """Full power at time zero, then exponential decay, cut after 16 decay times."""

    ends = (0.0, _DECAYS)

    def _share(self, u: Array) -> Array:
        share: Array = np.expm1(-u) / math.expm1(-_DECAYS)
        return share

    def _integral(self, u: Array) -> Array:
        integral: Array = (u + np.expm1(-u)) / -math.expm1(-_DECAYS)
        return integral


def response(
    pulse: Pulse | None, *, bin_width: float | None = None, resolution: float | None = None
) -> tuple[Array, Array]:
    """Return the energy of a pulse over range, convolved with a bin.

    Parameters
    ----------
    pulse : Pulse, optional
        None for a pulse without length.
    bin_width : float, m, optional
        Over which the detector integrates, centred on the range; None for the instantaneous
        power.
    resolution : float, m, optional
        Longest cell; by default a fifth of the bin, or 1/32 of the pulse without a bin.

    Returns
    -------
    edges : ndarray, m, shape (cells + 1,)
        Of cells behind the range of the time, ascending.
    density : ndarray, m-1, shape (cells,)
        Energy in each cell over its length; the sum of density times length is 1.

    Raises
    ------
    SimulationInputError
        If there is neither pulse nor bin, or a length is not positive.
    """
    start, stop = (0.0, 0.0) if pulse is None else (pulse.start, pulse.stop)
    start, stop = 0.5 * SPEED_OF_LIGHT * start, 0.5 * SPEED_OF_LIGHT * stop
    if bin_width is not None:
        check_positive("bin_width", bin_width, "m")
    elif pulse is None:
        raise SimulationInputError("needs a pulse, a bin width or both", field="pulse")
    half = 0.5 * (bin_width or 0.0)
    if resolution is None:
        resolution = bin_width / _CELLS_OF_BIN if bin_width else (stop - start) / _CELLS_OF_PULSE
    check_positive("resolution", resolution, "m")
    span = stop - start + 2.0 * half
    # Rounding must not add a cell to a pulse of a whole number of cells.
    cells = max(math.ceil(span / resolution * (1.0 - 1e-12)), 1)
    check_between("resolution", cells, 1, _MOST_CELLS, "cells")
    edges = np.linspace(start - half, stop + half, cells + 1)
    return edges, np.diff(_passed(pulse, edges, half)) / (span / cells)


def _passed(pulse: Pulse | None, edges: Array, half: float) -> Array:
    """Return the share of the energy of pulse and bin in front of each edge."""
    to_time = 2.0 / SPEED_OF_LIGHT
    if pulse is None:
        share: Array = (edges - edges[0]) / (edges[-1] - edges[0])
    elif half == 0.0:
        share = pulse.passed(edges * to_time)
    else:
        after = pulse.passed_integral((edges + half) * to_time)
        before = pulse.passed_integral((edges - half) * to_time)
        share = (after - before) / (2.0 * half * to_time)
    share[0], share[-1] = 0.0, 1.0
    return share


def pulsed_signal(
    distance: Array,
    *,
    extinction: Array,
    backscatter: Array,
    system_constant: float,
    pulse: Pulse | None,
    bin_width: float | None = None,
    full_overlap_range: float = 0.0,
    returning_extinction: Array | None = None,
    path: Array | None = None,
    resolution: float | None = None,
) -> Array:
    """Return the signal of a pulse of any shape, in the unit of the system constant.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Ranges (c / 2 times the time) of the signal: bin centres.
    extinction : ndarray, m-1, shape (points,)
        At the wavelength of the laser.
    backscatter : ndarray, m-1 sr-1, shape (points,)
    system_constant : float, MHz m3 sr or W m3 sr
    pulse : Pulse, optional
        None for a pulse without length.
    bin_width : float, m, optional
        Over which the detector averages; None for the power at the range itself.
    full_overlap_range : float, m
        Of `signal.sine_overlap`.
    returning_extinction : ndarray, m-1, shape (points,), optional
        At the wavelength of the detector (Raman); by default that of the laser.
    path : ndarray, m, shape (points,), optional
        Ranges of the optical properties, which are linear between them and constant outside;
        by default `distance`.
    resolution : float, m, optional
        Longest cell of the quadrature; see `response`.

    Raises
    ------
    SimulationInputError
        If a property is negative, the pulse is as long as the range, or the signal would be
        infinite: light returns while the pulse still leaves, and the overlap is complete at the
        lidar.

    References
    ----------
    `vasylkivskyi2009`, equations 10, 14 and 20.
    """
    check_not_negative("system_constant", system_constant, "MHz m3 sr")
    check_not_negative("full_overlap_range", full_overlap_range, "m")
    edges, density = response(pulse, bin_width=bin_width, resolution=resolution)
    _refuse_near(distance, edges, full_overlap_range)
    grid = distance if path is None else path
    points = _points(grid, extinction, backscatter, returning_extinction)
    signal: Array = _sum_cells(distance, edges, density, *points, full_overlap_range)
    return system_constant * signal


def pulse_echo(
    distance: Array,
    path: BeamPath,
    pulse: settings.Pulse,
    *,
    system_constant: float,
    full_overlap_range: float,
) -> Array:
    """Return the mean rate of photoelectrons while each bin is open, MHz.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Range of the bin centres, equally spaced; time zero is the centroid of the pulse.
    path : BeamPath
        Optical properties at the bin centres, linear between them.
    pulse : simulated_instrument.Pulse
        Of a campaign file.
    system_constant : float, MHz m3 sr
    full_overlap_range : float, m
        Must be positive: without overlap the signal at the lidar is infinite.

    Raises
    ------
    SimulationInputError
        See `pulsed_signal`.

    References
    ----------
    `vasylkivskyi2009`, equations 20 to 23.
    """
    step = float(distance[1] - distance[0])
    shape, centroid = _SHAPES[pulse.shape](pulse.width)
    signal = pulsed_signal(
        distance + 0.5 * SPEED_OF_LIGHT * centroid,
        extinction=path.extinction,
        backscatter=path.backscatter,
        system_constant=system_constant,
        pulse=shape,
        bin_width=step,
        full_overlap_range=full_overlap_range,
        path=bin_centres(distance.size, step, float(distance[0]) - 0.5 * step),
    )
    return np.where(distance > 0.0, signal, 0.0)


_SHAPES: Final[Mapping[str, Callable[[float], tuple[Pulse, float]]]] = {
    "rectangle": lambda width: (RectangularPulse(width), 0.5 * width),
    "gaussian": lambda width: (GaussianPulse(width), 0.0),
    "exponential": lambda width: (ExponentialPulse(width), width),
}
"""Shape in a campaign file -> width in s -> the pulse, and the time of its centroid, s."""


def _refuse_near(distance: Array, edges: Array, full_overlap_range: float) -> None:
    check_ascending("distance", distance)
    if edges[-1] >= distance[-1]:
        raise SimulationInputError(
            f"is as long as the range: {edges[-1]:g} m of {distance[-1]:g} m",
            field="pulse",
            remedy="give a shorter pulse (in s) or a longer range",
        )
    reached = (distance > edges[0]) & (distance <= edges[-1])
    if reached.any() and full_overlap_range == 0.0:
        raise SimulationInputError(
            f"must be positive, or the signal within the pulse ({edges[-1]:g} m) is infinite",
            field="full_overlap_range",
            remedy="give the range of full overlap, or ranges behind the pulse",
        )


def _points(
    path: Array, extinction: Array, backscatter: Array, returning: Array | None
) -> tuple[Array, Array, Array, Array]:
    """Return range, two-way extinction, two-way optical depth and backscatter from R = 0 on."""
    check_ascending("path", path)
    check_profile("extinction", extinction, path.shape, "m-1")
    check_profile("backscatter", backscatter, path.shape, "m-1 sr-1")
    if returning is not None:
        check_profile("returning_extinction", returning, path.shape, "m-1")
    ahead = path > 0.0
    if not ahead.any():
        raise SimulationInputError("has no range in front of the lidar", field="path")
    two_way = extinction + (extinction if returning is None else returning)
    grid = np.concatenate([[0.0], path[ahead]])
    two_way = two_way[ahead][np.r_[0, 0 : ahead.sum()]]
    depth = np.concatenate([[0.0], np.cumsum(0.5 * (two_way[1:] + two_way[:-1]) * np.diff(grid))])
    return grid, two_way, depth, backscatter[ahead][np.r_[0, 0 : ahead.sum()]]


def _density(z: Array) -> Array:
    density: Array = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return density


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sum_cells(
    distance: Any,
    edges: Any,
    density: Any,
    grid: Any,
    two_way: Any,
    depth: Any,
    backscatter: Any,
    full: float,
) -> Any:
    signal = np.zeros(distance.size)
    inverse = 1.0 / (grid[1:] - grid[:-1])
    last = grid.size - 2
    k = 0
    for j in range(distance.size):
        total = 0.0
        for i in range(density.size):
            far, near = distance[j] - edges[i], distance[j] - edges[i + 1]
            if far <= 0.0 or density[i] == 0.0:
                continue
            if near > 0.0:
                square = near * far
                r, weight = math.sqrt(square), (edges[i + 1] - edges[i]) / square
            else:  # the lidar lies in the cell, where overlap over R^2 is constant
                r = 0.5 * far
                weight = far / r**2
            while k < last and grid[k + 1] < r:
                k += 1
            while k > 0 and grid[k] > r:
                k -= 1
            x = r - grid[k]
            share = min(x * inverse[k], 1.0)
            inside = min(x, grid[k + 1] - grid[k])
            slope = two_way[k + 1] - two_way[k]
            tau = (
                depth[k]
                + inside * (two_way[k] + 0.5 * slope * share)
                + (x - inside) * two_way[k + 1]
            )
            value = backscatter[k] + (backscatter[k + 1] - backscatter[k]) * share
            if r < full:
                value *= math.sin(0.5 * math.pi * r / full) ** 2
            total += density[i] * weight * value * math.exp(-tau)
        signal[j] = total
    return signal

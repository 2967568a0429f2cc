"""Means of beams over altitude cells, from all bins that a beam has in each cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarops.flags import Quality
from lidarops.retrieve.common.arrays import Array, Flags, frozen
from lidarops.retrieve.common.compiled_code import compiled

_MISSING = int(Quality.INPUT_MISSING)


class CellMeans(NamedTuple):
    """Means of beams over altitude cells; NaN where a bin is missing or the beam ends before."""

    signal: Array
    """(profile, altitude)."""
    variance: Array
    """(profile, altitude): of the noise of single bins."""
    response: Array
    """(altitude,): mean of the square of range over overlap, in m2: the change of `signal` per
    change of the background."""
    quality: Flags
    """(profile, altitude): bits of all bins of the cell."""


def average_over_cells(
    power: Array, variance: Array, quality: Flags, gain: Array, distance: Array, edges: Array
) -> CellMeans:
    r"""Return the range-corrected signal of beams of one direction, averaged over cells.

    A cell is the integral of a signal that is linear in each bin, with the slope between the bins
    beside: the part :math:`f` of bin :math:`j` that lies in the cell adds

    .. math:: f S_j + \tfrac{1}{4} (f^2 - f) (S_{j+1} - S_{j-1}) .

    All beams therefore average the same air with equal weights, and what varies with altitude
    within a cell is common to them, but for their attenuation (`at_centres`).

    Parameters
    ----------
    power, variance : (profile, range) float
        Without background; NaN where missing. The variance is that of independent bins.
    quality : (profile, range) int
    gain : (range,) float
        Square of range over overlap, m2.
    distance : (range,) float
        m, centres of bins of equal width; at least three.
    edges : (altitude + 1,) float
        m along the beam, ascending.
    """
    width = (distance[-1] - distance[0]) / (distance.size - 1)
    places = (edges - distance[0]) / width + 0.5
    shape = (power.shape[0], edges.size - 1)
    signal, spread = np.full(shape, np.nan), np.full(shape, np.nan)
    response, bits = np.full(shape[1], np.nan), np.full(shape, _MISSING, dtype=np.int32)
    _average(
        frozen(power), frozen(variance), frozen(quality), frozen(gain), frozen(places),
        signal, spread, response, bits,
    )  # fmt: skip
    return CellMeans(signal, spread, response, bits)


def at_centres(signal: Array, variance: Array) -> tuple[Array, Array]:
    r"""Return means over cells as values at their centres, and their variances.

    A signal :math:`S \propto e^{kz}` has the mean :math:`S_c \sinh(kh/2) / (kh/2)` over a cell of
    the height :math:`h`: the longer the path, the more the mean exceeds the value. :math:`k h` is
    the mean logarithm of the ratios to the cells beside.

    Parameters
    ----------
    signal, variance : (..., altitude) float
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        logarithm = np.log(np.where(signal > 0.0, signal, np.nan))
    rise = np.full((2, *signal.shape), np.nan)
    rise[0, ..., 1:] = rise[1, ..., :-1] = np.diff(logarithm, axis=-1)
    known = np.isfinite(rise)
    half = 0.5 * np.where(known, rise, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    with np.errstate(invalid="ignore"):
        ratio = np.where(half == 0.0, 1.0, half / np.sinh(half))
    return signal * ratio, variance * ratio**2


@compiled
def _add_integral(place: float, sign: float, bins: int, weights: Array) -> None:
    """Add the weights of the part of a bin up to a place, to those of the whole bins before."""
    last = min(int(place), bins - 1)
    part = place - last
    weights[last] += sign * part
    if 0 < last < bins - 1:
        slope = 0.25 * sign * (part * part - part)
        weights[last + 1] += slope
        weights[last - 1] -= slope


@compiled
def _average(
    power: Array,
    variance: Array,
    quality: Flags,
    gain: Array,
    places: Array,
    signal: Array,
    spread: Array,
    response: Array,
    bits: Flags,
) -> None:
    """Average all profiles over all cells that the bins cover; `places` are edges in bins."""
    bins = power.shape[1]
    weights = np.zeros(bins)
    for cell in range(places.size - 1):
        low, high = places[cell], places[cell + 1]
        if not (low >= 0.0 and high <= bins):
            continue
        first, past = max(int(low) - 1, 0), min(int(high) + 2, bins)
        weights[first:past] = 0.0
        weights[int(low) : min(int(high), bins - 1)] = 1.0
        _add_integral(high, 1.0, bins, weights)
        _add_integral(low, -1.0, bins, weights)
        total = 0.0
        for i in range(first, past):
            weights[i] *= gain[i] / (high - low) if weights[i] != 0.0 else 0.0
            total += weights[i]
        response[cell] = total
        for k in range(power.shape[0]):
            mean = noise = 0.0
            raised = 0
            for i in range(first, past):
                weight = weights[i]
                if weight != 0.0:
                    mean += weight * power[k, i]
                    noise += weight * weight * variance[k, i]
                    raised |= quality[k, i]
            signal[k, cell], spread[k, cell], bits[k, cell] = mean, noise, raised

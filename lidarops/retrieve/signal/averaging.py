"""Averages over time and range that carry variance and pass over gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen
from lidarops.retrieve.signal import _weighted_sums

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

LEFT_OUT: Final = -1
"""Group of a profile that goes into no mean."""


@dataclass(frozen=True, slots=True)
class Averages:
    """Means with the variance of their noise, and what did not average down."""

    values: Array
    """In the unit of the profiles; NaN where too few were finite."""
    variance: Array
    """Of the mean, from the variances of what went into it, as independent of each other."""
    shared_variance: Array
    """Of the mean, from errors that all that went into it has in common."""
    count: Counts
    """Finite values that went into each mean."""
    weight: Array
    """Sum of their weights."""

    @property
    def standard_error(self) -> Array:
        """Root of both variances together."""
        root: Array = np.sqrt(self.variance + self.shared_variance)
        return root


def time_groups(times: npt.ArrayLike, edges: npt.ArrayLike) -> npt.NDArray[np.intp]:
    """Sort times into bins.

    Parameters
    ----------
    times : (time,) float or datetime64
        Middle of each profile.
    edges : (bin + 1,) float or datetime64
        Ascending; a bin holds its lower edge and not its upper one.

    Returns
    -------
    (time,) int
        Number of the bin, `LEFT_OUT` outside of all and for times that are not known.

    Raises
    ------
    RetrievalInputError
        Where the edges do not rise, or are not of the kind of the times.
    """
    moments, limits = np.asarray(times), np.asarray(edges)
    if (moments.dtype.kind == "M") != (limits.dtype.kind == "M"):
        raise RetrievalInputError(
            f"hold {limits.dtype}, the times {moments.dtype}",
            field="edges",
            remedy="give both as datetime64, or both as numbers",
        )
    if limits.ndim != 1 or limits.size < 2 or not np.all(limits[1:] > limits[:-1]):
        raise RetrievalInputError("do not rise", field="edges", remedy="give ascending edges")
    group = np.searchsorted(limits, moments, side="right") - 1
    group[(group >= limits.size - 1) | (moments != moments)] = LEFT_OUT  # noqa: PLR0124 - NaN, NaT
    return group.astype(np.intp)


def time_mean(
    profiles: npt.ArrayLike,
    variance: npt.ArrayLike,
    *,
    groups: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    shared_variance: npt.ArrayLike | None = None,
    least_count: int = 1,
    axis: int = -2,
) -> Averages:
    r"""Average profiles over time, bin by bin.

    .. math:: \bar P = \frac{\sum_t w_t P_t}{\sum_t w_t}, \qquad
              v = \frac{\sum_t w_t^2 v_t}{(\sum_t w_t)^2}, \qquad
              s = \left(\frac{\sum_t w_t \sqrt{s_t}}{\sum_t w_t}\right)^2

    over the finite :math:`P_t` of a bin, in the order of time. The weights must not follow the
    noise: shots do not, inverse variances of realised counts do.

    Parameters
    ----------
    profiles : (..., time, range) float
        NaN is a gap.
    variance : (..., time, range) float
        Of the noise, independent from profile to profile; broadcast against `profiles`. Where
        it is not known (NaN), that of the mean is not either.
    groups : (time,) int, optional
        Mean into which each profile goes, from 0 (`time_groups`); negative for none. All go
        into one where not given.
    weights : (..., time) float, optional
        Number of shots of each profile; broadcast. A profile of weight 0 is a gap.
    shared_variance : (..., time, range) float, optional
        Of errors that the profiles have in common, such as that of a dark profile that was
        subtracted from all; broadcast. It does not average down.
    least_count : int
        Finite values that a mean must have.
    axis : int
        The axis of time; range need not be the last one then.

    Returns
    -------
    Averages
        (..., group, range), with the groups where time was; one group for every number from 0
        to the largest one. Bit-identical however the other axes are cut into chunks.

    Raises
    ------
    RetrievalInputError
        For arguments that do not fit each other, and negative weights or variances.
    """
    values = inputs.real_array(profiles, "profiles")
    if not -values.ndim <= axis < values.ndim:
        raise RetrievalInputError(
            f"is {axis}, but profiles have the shape {values.shape}", field="axis"
        )
    group = _checked_groups(groups, values.shape[axis])
    return _averaged(
        values,
        variance,
        0.0 if shared_variance is None else shared_variance,
        1.0 if weights is None else weights,
        _Cut(axis % values.ndim, group, int(group.max(initial=0)) + 1, _checked_least(least_count)),
    )


def range_mean(
    profiles: npt.ArrayLike,
    variance: npt.ArrayLike,
    factor: int,
    *,
    shared_variance: npt.ArrayLike | None = None,
    least_count: int | None = None,
) -> Averages:
    """Average neighbouring bins by `time_mean`'s formulas, with equal weights.

    Parameters
    ----------
    profiles : (..., range) float
        NaN is a gap.
    variance : (..., range) float
        Of the noise, independent from bin to bin; broadcast.
    factor : int
        Bins to a mean. What is left over at the far end is left out.
    shared_variance : (..., range) float, optional
        Of errors that neighbouring bins have in common, such as that of the background;
        broadcast. It does not average down.
    least_count : int, optional
        Finite values that a mean must have; `factor` where not given, because a gap in a
        falling signal shifts the mean.

    Returns
    -------
    Averages
        (..., range // factor). The range of a mean is the mean of the ranges
        (`range_mean(range, 0.0, factor).values`).

    Raises
    ------
    RetrievalInputError
        Where the factor is no whole number from 1 to the number of bins, and as for `time_mean`.
    """
    values = inputs.real_array(profiles, "profiles")
    bins = values.shape[-1] if values.ndim else 0
    if not 1 <= factor <= bins or factor != int(factor):
        raise RetrievalInputError(
            f"is {factor} with {bins} bins", field="factor", remedy=f"choose from 1 to {bins}"
        )
    group = np.arange(bins, dtype=np.intp) // int(factor)
    group[bins // int(factor) * int(factor) :] = LEFT_OUT
    least = int(factor) if least_count is None else least_count
    cut = _Cut(values.ndim - 1, group, bins // int(factor), _checked_least(least))
    shared = 0.0 if shared_variance is None else shared_variance
    return _averaged(values, variance, shared, 1.0, cut)


@dataclass(frozen=True, slots=True)
class _Cut:
    """How an axis is cut into means."""

    axis: int
    group: npt.NDArray[np.intp]
    number: int
    least_count: int


def _averaged(
    values: inputs.Floats,
    variance: npt.ArrayLike,
    shared: npt.ArrayLike,
    weights: npt.ArrayLike,
    cut: _Cut,
) -> Averages:
    before, after = values.shape[: cut.axis], values.shape[cut.axis + 1 :]
    outer, inner = math.prod(before), math.prod(after)
    shape = (outer, cut.group.size, inner)
    sums = np.zeros((4, outer, cut.number, inner))
    count = np.zeros((outer, cut.number, inner), dtype=np.int64)
    add = _weighted_sums.add_bins if inner == 1 else _weighted_sums.add_profiles
    add(
        frozen(values.reshape(shape)),
        _term(variance, "variance", values.shape, shape, cut.axis),
        _term(shared, "shared_variance", values.shape, shape, cut.axis),
        _term(weights, "weights", values.shape[: cut.axis + 1], shape[:2], cut.axis),
        frozen(cut.group),
        sums,
        count,
    )
    total, value, noise, systematic = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        value /= total
        noise /= total**2
        systematic /= total
        systematic **= 2
    for filled in (value, noise, systematic):
        filled[count < cut.least_count] = np.nan
    whole = (*before, cut.number, *after)
    return Averages(
        value.reshape(whole),
        noise.reshape(whole),
        systematic.reshape(whole),
        count.reshape(whole),
        total.reshape(whole),
    )


def _term(
    values: npt.ArrayLike, name: str, shape: tuple[int, ...], flat: tuple[int, ...], axis: int
) -> Array:
    """Return what broadcasts to `shape` as `flat`, with 1 for the axes along which it is alike."""
    array = inputs.real_array(values, name).astype(np.float64, copy=False)
    if np.any(array < 0):
        raise RetrievalInputError("is negative", field=name)
    given = (1,) * (len(shape) - array.ndim) + array.shape
    outer = 1 if math.prod(given[:axis]) == 1 else flat[0]
    length = 1 if given[axis] == 1 else flat[1]
    alike = (
        *((1,) * axis if outer == 1 else shape[:axis]),
        1 if length == 1 else shape[axis],
        *shape[axis + 1 :],
    )
    try:
        full = np.broadcast_to(array, alike)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, which does not broadcast to {shape}", field=name
        ) from None
    return frozen(full.reshape(outer, length, *flat[2:]))


def _checked_groups(groups: npt.ArrayLike | None, length: int) -> npt.NDArray[np.intp]:
    if groups is None:
        return np.zeros(length, dtype=np.intp)
    group = np.asarray(groups)
    if group.dtype.kind not in "iu" or group.shape != (length,):
        raise RetrievalInputError(
            f"hold {group.dtype} of the shape {group.shape}",
            field="groups",
            remedy=f"give one whole number for each of the {length} profiles",
        )
    return np.ascontiguousarray(group, dtype=np.intp)


def _checked_least(least_count: int) -> int:
    if least_count < 1:
        raise RetrievalInputError(
            f"is {least_count}", field="least_count", remedy="a mean needs at least 1 value"
        )
    return int(least_count)

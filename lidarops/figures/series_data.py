"""Quantities over time as plain arrays, compared with the simulated truth.

Also checks and reads variables of any product.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.time_axis import Times, segments

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SeriesEstimate:
    """One retrieved quantity over time, with its standard error and truth."""

    value: Floats
    """(time,)"""
    standard_error: Floats
    """(time,)"""
    truth: Floats
    """(time,) NaN where unknown."""
    units: str

    def at(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> SeriesEstimate:
        """Return the estimate at some times."""
        return replace(
            self,
            value=self.value[index],
            standard_error=self.standard_error[index],
            truth=self.truth[index],
        )


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """The quantities of one series over time."""

    time: Times
    """(time,) Middles of profiles, UTC, rising."""
    flag: NDArray[np.int64]
    """(time,) Bits of the kind."""
    rejecting: int
    """Union of the bits of the kind that reject a value."""
    estimates: Mapping[str, SeriesEstimate]
    """By name of the quantity."""

    label: str = ""
    """Name in legends."""
    key: tuple[float, ...] = ()
    """Identity and place among the series of a product: bounds in m, or a number."""

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(time,) Whether a quality bit rejects the value."""
        return np.asarray((self.flag & self.rejecting) != 0)

    def at(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> TimeSeries:
        """Return the series at some times."""
        estimates = {name: estimate.at(index) for name, estimate in self.estimates.items()}
        return replace(self, time=self.time[index], flag=self.flag[index], estimates=estimates)


class Verdict(StrEnum):
    """Verdict on the stated standard errors from a comparison with the truth."""

    AS_STATED = "as stated"
    BEYOND = "too many beyond 3"
    UNDERSTATED = "errors understated"
    OVERSTATED = "errors overstated"
    SHARED = "common error of all profiles"
    NO_ERROR = "values without standard error"

    @property
    def unsafe(self) -> bool:
        """Whether the stated errors are too small or missing."""
        return self in {Verdict.BEYOND, Verdict.UNDERSTATED, Verdict.NO_ERROR}


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of the unflagged values of one section with the truth."""

    quantity: str
    section: str
    count: int
    """Number of unflagged values with a standard error and a truth."""
    within_1: float
    """Share of them within 1 standard error of the truth; 0.683 for normal errors."""
    within_3: float
    """Share of them within 3 standard errors of the truth; 0.997 for normal errors."""
    bias: float
    """Mean of (retrieved - truth) / standard error."""
    spread: float
    """Root mean square of (retrieved - truth) / standard error; 1 for normal errors."""
    without_error: int
    """Number of unflagged values with a truth that are not finite or lack a positive error."""

    @property
    def verdict(self) -> Verdict:
        """Verdict on the stated standard errors.

        For `count` normal errors, chance allows: beyond 3 standard errors, the expected
        0.27 percent plus three times its Poisson spread, but at least one value; a spread
        within 4 / sqrt(2 count) of 1; a mean within 5 / sqrt(count) of 0.
        """
        if self.without_error > 0:
            return Verdict.NO_ERROR
        expected = 0.0027 * self.count
        beyond = round((1.0 - self.within_3) * self.count)
        chance = 4.0 / math.sqrt(2.0 * self.count)
        if beyond > max(1.0, expected + 3.0 * math.sqrt(expected)):
            return Verdict.BEYOND
        if self.spread > 1.0 + chance:
            return Verdict.UNDERSTATED
        if abs(self.bias) > 5.0 / math.sqrt(self.count):
            return Verdict.SHARED
        return Verdict.OVERSTATED if self.spread < 1.0 - chance else Verdict.AS_STATED


def join(series: Iterable[TimeSeries]) -> list[TimeSeries]:
    """Join series of the same key in time.

    Parameters
    ----------
    series : iterable of TimeSeries
        Of one instrument and channel, from any number of products.

    Returns
    -------
    list of TimeSeries
        One per key, sorted by key.
    """
    groups: dict[tuple[float, ...], list[TimeSeries]] = {}
    for part in series:
        groups.setdefault(part.key, []).append(part)
    return [_joined(group) for _, group in sorted(groups.items())]


def compare(section: TimeSeries, quantity: str) -> Comparison | None:
    """Compare the unflagged values of a section with the truth.

    Returns
    -------
    Comparison or None
        None if no unflagged value has a truth.
    """
    estimate = section.estimates[quantity]
    known = (section.flag == 0) & np.isfinite(estimate.truth)
    score = normalised_error(section, quantity)[known]
    usable = np.isfinite(score)
    if not known.any():
        return None
    size = np.abs(score[usable])
    any_usable = size.size > 0
    return Comparison(
        quantity=quantity,
        section=section.label,
        count=int(size.size),
        within_1=float((size <= 1.0).mean()) if any_usable else np.nan,
        within_3=float((size <= 3.0).mean()) if any_usable else np.nan,
        bias=float(score[usable].mean()) if any_usable else np.nan,
        spread=float(np.sqrt((size**2).mean())) if any_usable else np.nan,
        without_error=int((~usable).sum()),
    )


def normalised_error(section: TimeSeries, quantity: str) -> Floats:
    """Return (retrieved - truth) / standard error, shape (time,); NaN where undefined."""
    estimate = section.estimates[quantity]
    stated = np.isfinite(estimate.standard_error) & (estimate.standard_error > 0)
    error = np.where(stated, estimate.standard_error, np.nan)
    return np.asarray((estimate.value - estimate.truth) / error)


def thin(section: TimeSeries, points: int) -> TimeSeries:
    """Reduce the unflagged profiles of a section to about `points` block means for drawing.

    A block has the mean of its unflagged profiles, the standard error of that mean (as if errors
    were independent between profiles) and the mean truth of these profiles. Blocks do not extend
    across gaps.

    Parameters
    ----------
    section : TimeSeries
    points : int
        Each gap may add one block.

    Returns
    -------
    TimeSeries
        Unflagged profiles only; block means if there are more than `points`.
    """
    good = section.at(section.flag == 0)
    if good.time.size <= points:
        return good
    size = -(-good.time.size // points)
    edges = np.concatenate([np.arange(s.start, s.stop, size) for s in segments(section.time)])
    block = np.searchsorted(edges, np.flatnonzero(section.flag == 0), side="right")
    starts = np.flatnonzero(np.diff(block, prepend=0))
    elapsed = (good.time - good.time[0]) / np.timedelta64(1, "ns")
    return replace(
        good,
        time=good.time[0] + _block_mean(np.asarray(elapsed), starts).astype("timedelta64[ns]"),
        flag=np.zeros(starts.size, dtype=np.int64),
        estimates={
            name: SeriesEstimate(
                value=_block_mean(estimate.value, starts),
                standard_error=_block_error(estimate.standard_error, starts),
                truth=_block_mean(estimate.truth, starts),
                units=estimate.units,
            )
            for name, estimate in good.estimates.items()
        },
    )


def _block_mean(values: Floats, starts: NDArray[np.intp]) -> Floats:
    use = np.isfinite(values)
    counts = np.add.reduceat(use.astype(np.int64), starts)
    sums = np.add.reduceat(np.where(use, values, 0.0), starts)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _block_error(errors: Floats, starts: NDArray[np.intp]) -> Floats:
    # Error of a mean of n independent values: root mean square of their errors / sqrt(n).
    counts = np.add.reduceat(np.isfinite(errors).astype(np.int64), starts)
    return np.sqrt(_block_mean(errors**2, starts) / np.maximum(counts, 1))


def _joined(group: Sequence[TimeSeries]) -> TimeSeries:
    def joined(name: str) -> SeriesEstimate:
        parts = [series.estimates[name] for series in group]
        return SeriesEstimate(
            np.concatenate([part.value for part in parts]),
            np.concatenate([part.standard_error for part in parts]),
            np.concatenate([part.truth for part in parts]),
            parts[0].units,
        )

    whole = replace(
        group[0],
        time=np.concatenate([series.time for series in group]),
        flag=np.concatenate([series.flag for series in group]),
        estimates={name: joined(name) for name in group[0].estimates},
    )
    return whole.at(np.argsort(whole.time, kind="stable"))


def require(product: xr.Dataset, dims: Mapping[str, tuple[str, ...]]) -> None:
    """Refuse a product that lacks a variable, or has it with other dimensions.

    Raises
    ------
    ProductError
        Naming the variable and its dimensions.
    """
    for name, expected in dims.items():
        if name not in product.variables:
            raise ProductError("is missing from the product", field=name)
        if product[name].dims != expected:
            raise ProductError(f"has the dims {product[name].dims}, not {expected}", field=name)
    if not np.issubdtype(product["time"].dtype, np.datetime64):
        raise ProductError("does not hold CF times", field="time")


def float_values(product: xr.Dataset, name: str) -> Floats:
    """Return a variable in double precision."""
    return np.asarray(product[name].values, dtype=np.float64)

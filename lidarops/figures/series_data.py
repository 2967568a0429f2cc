"""Homogeneous products as plain arrays by section, with the simulated truth.

Also compares retrieved values with the truth, and checks and reads variables of any product.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.time_axis import Times, segments
from lidarops.flags import Quality

Floats = NDArray[np.float64]

QUANTITIES: Final = ("extinction", "background", "amplitude")
"""Retrieved quantities, as the names of their variables."""


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


@dataclass(frozen=True, slots=True)
class Section:
    """The quantities retrieved from one range section, over time."""

    near: float
    """m"""
    far: float
    """m"""
    time: Times
    """(time,) Middles of profiles, UTC, rising."""
    flag: NDArray[np.int64]
    """(time,) Bits of `Quality`."""
    estimates: Mapping[str, SeriesEstimate]
    """By name of the quantity."""

    @property
    def label(self) -> str:
        """Range of the section in km, for legends."""
        return f"{self.near / 1e3:g}\N{EN DASH}{self.far / 1e3:g} km"

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(time,) Whether a quality bit rejects the value."""
        return np.asarray((self.flag & int(Quality.rejecting())) != 0)


_ALONG_BOTH: Final = (
    *QUANTITIES,
    *(f"{name}_standard_error" for name in QUANTITIES),
    "quality_flag",
)
SECTION_VARIABLES: Final = ("time", *_ALONG_BOTH, "section_bounds")
"""Variables that `read_sections` needs."""


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


def read_sections(
    product: xr.Dataset,
    truth: xr.Dataset | None = None,
    *,
    instrument: str = "",
    channel: str = "",
    paths: Sequence[str] = (),
    dark_subtracted: bool = True,
) -> list[Section]:
    """Return the sections of a homogeneous product.

    Parameters
    ----------
    product : Dataset
        Kind ``homogeneous``, dims (time, section).
    truth : Dataset, optional
        Truth of a simulated campaign, dimension granule.
    instrument, channel : str, optional
        Select the truth; empty for any instrument.
    paths : sequence of str, optional
        Raw files of the profiles, in their order. If there is one per profile, the truth is
        matched by path, else by time.
    dark_subtracted : bool, optional
        Whether the dark signal was subtracted. If not, it is part of the retrieved background
        and of its truth.

    Returns
    -------
    list of Section
        Sorted by near end; truth is NaN where unknown.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions or units.
    """
    _check(product)
    order = np.argsort(product["time"].values, kind="stable")
    time = product["time"].values.astype("datetime64[ns]")[order]
    ordered = [paths[i] for i in order] if len(paths) == time.size else []
    true_values = {
        name: _truth(truth, time, instrument, ordered, variables)
        for name, variables in _true_variables(channel, dark_subtracted=dark_subtracted).items()
    }
    flags = quality_bits(product["quality_flag"])[order]
    bounds = product["section_bounds"].values.astype(np.float64)
    sections = []
    for k in np.argsort(bounds[:, 0], kind="stable"):
        estimates = {
            name: SeriesEstimate(
                value=float_values(product, name)[order, k],
                standard_error=float_values(product, f"{name}_standard_error")[order, k],
                truth=true_values[name],
                units=str(product[name].attrs.get("units", "")),
            )
            for name in QUANTITIES
        }
        near, far = float(bounds[k, 0]), float(bounds[k, 1])
        sections.append(Section(near, far, time, flags[:, k], estimates))
    return sections


def join(sections: Iterable[Section]) -> list[Section]:
    """Join sections with the same bounds in time.

    Parameters
    ----------
    sections : iterable of Section
        Of one instrument and channel, from any number of products.

    Returns
    -------
    list of Section
        One per pair of bounds, sorted by near end.
    """
    groups: dict[tuple[float, float], list[Section]] = {}
    for section in sections:
        groups.setdefault((section.near, section.far), []).append(section)
    return [_joined(group) for _, group in sorted(groups.items())]


def compare(section: Section, quantity: str) -> Comparison | None:
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


def normalised_error(section: Section, quantity: str) -> Floats:
    """Return (retrieved - truth) / standard error, shape (time,); NaN where undefined."""
    estimate = section.estimates[quantity]
    stated = np.isfinite(estimate.standard_error) & (estimate.standard_error > 0)
    error = np.where(stated, estimate.standard_error, np.nan)
    return np.asarray((estimate.value - estimate.truth) / error)


def thin(section: Section, points: int) -> Section:
    """Reduce the unflagged profiles of a section to about `points` block means for drawing.

    A block has the mean of its unflagged profiles, the standard error of that mean (as if errors
    were independent between profiles) and the mean truth of these profiles. Blocks do not extend
    across gaps.

    Parameters
    ----------
    section : Section
    points : int
        Each gap may add one block.

    Returns
    -------
    Section
        Unflagged profiles only; block means if there are more than `points`.
    """
    good = _where(section, section.flag == 0)
    if good.time.size <= points:
        return good
    size = -(-good.time.size // points)
    edges = np.concatenate([np.arange(s.start, s.stop, size) for s in segments(section.time)])
    block = np.searchsorted(edges, np.flatnonzero(section.flag == 0), side="right")
    starts = np.flatnonzero(np.diff(block, prepend=0))
    elapsed = (good.time - good.time[0]) / np.timedelta64(1, "ns")
    return Section(
        near=good.near,
        far=good.far,
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


def _where(section: Section, keep: NDArray[np.bool_]) -> Section:
    return Section(
        near=section.near,
        far=section.far,
        time=section.time[keep],
        flag=section.flag[keep],
        estimates={
            name: SeriesEstimate(
                value=estimate.value[keep],
                standard_error=estimate.standard_error[keep],
                truth=estimate.truth[keep],
                units=estimate.units,
            )
            for name, estimate in section.estimates.items()
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


def _joined(group: list[Section]) -> Section:
    if len(group) == 1:
        return group[0]
    time = np.concatenate([section.time for section in group])
    order = np.argsort(time, kind="stable")
    return Section(
        near=group[0].near,
        far=group[0].far,
        time=time[order],
        flag=np.concatenate([section.flag for section in group])[order],
        estimates=join_estimates(group, order),
    )


def join_estimates(
    sections: Sequence[Section], order: NDArray[np.intp]
) -> dict[str, SeriesEstimate]:
    """Concatenate the estimates of sections in time, then sort them by `order`."""
    return {
        name: SeriesEstimate(
            value=np.concatenate([s.estimates[name].value for s in sections])[order],
            standard_error=np.concatenate([s.estimates[name].standard_error for s in sections])[
                order
            ],
            truth=np.concatenate([s.estimates[name].truth for s in sections])[order],
            units=estimate.units,
        )
        for name, estimate in sections[0].estimates.items()
    }


def _check(product: xr.Dataset) -> None:
    require(product, {"time": ("time",)} | dict.fromkeys(_ALONG_BOTH, ("time", "section")))
    if "section_bounds" not in product or product["section_bounds"].shape[1:] != (2,):
        raise ProductError("has no section bounds", field="section_bounds")
    units = product["extinction"].attrs.get("units")
    if units != "m-1":
        raise ProductError(f"has the units {units!r}, not 'm-1'", field="extinction")


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


def quality_bits(flags: xr.DataArray) -> NDArray[np.int64]:
    """Return quality flags as integers; missing flags become `Quality.INPUT_MISSING`."""
    values = flags.values
    if values.dtype.kind == "f":
        # Where there are fill values, xarray decodes integers as floats with NaN.
        values = np.where(np.isfinite(values), values, float(Quality.INPUT_MISSING))
    return np.asarray(values, dtype=np.int64)


def _true_variables(channel: str, *, dark_subtracted: bool) -> Mapping[str, Sequence[str]]:
    """Return for each quantity the variables of the truth that add up to its true value."""
    offset = () if dark_subtracted else (f"dark_offset_{channel}",)
    return {
        "extinction": ("extinction",),
        "background": (f"background_{channel}", *offset),
        "amplitude": (f"amplitude_{channel}",),
    }


def _truth(
    truth: xr.Dataset | None,
    time: Times,
    instrument: str,
    paths: Sequence[str],
    variables: Sequence[str],
) -> Floats:
    if truth is None or variables[0] not in truth.variables or truth.sizes["granule"] == 0:
        return np.full(time.size, np.nan)
    # Photon counting has no dark offset.
    terms = [float_values(truth, name) for name in variables if name in truth.variables]
    index = _match(time, truth, instrument, paths)
    return np.where(index >= 0, np.sum(terms, axis=0)[index], np.nan)


def _match(
    time: Times, truth: xr.Dataset, instrument: str, paths: Sequence[str]
) -> NDArray[np.intp]:
    """Return the index of the truth of every profile, -1 without one."""
    granules = np.arange(truth.sizes["granule"])
    if instrument:
        granules = granules[_texts(truth["instrument"]) == instrument]
    if paths:
        index = {
            path: int(i) for i, path in zip(granules, _texts(truth["path"])[granules], strict=True)
        }
        matched = np.array([index.get(path, -1) for path in paths], dtype=np.intp)
        if (matched >= 0).all():
            return matched
    return _nearest(time, truth["time"].values.astype("datetime64[ns]")[granules], granules)


def _nearest(time: Times, known: Times, granules: NDArray[np.intp]) -> NDArray[np.intp]:
    if known.size == 0:
        return np.full(time.size, -1, dtype=np.intp)
    order = np.argsort(known, kind="stable")
    known, granules = known[order], granules[order]
    after = np.clip(np.searchsorted(known, time), 1, max(known.size - 1, 1))
    after = np.minimum(after, known.size - 1)
    before = np.maximum(after - 1, 0)
    to_before, to_after = np.abs(time - known[before]), np.abs(time - known[after])
    # The truth may state starts of granules, but profiles have middles: of two about equally
    # near neighbours, the earlier one is taken.
    step = np.median(np.diff(known)) if known.size > 1 else np.timedelta64(120, "s")
    earlier = to_before <= to_after + step * 0.1
    best = np.where(earlier, before, after)
    near = np.where(earlier, to_before, to_after) <= step * 0.6
    return np.where(near, granules[best], -1)


def _texts(strings: xr.DataArray) -> NDArray[np.str_]:
    values = strings.values
    if values.dtype.kind == "S":
        return np.char.decode(values, "utf-8")
    return np.asarray(values, dtype=np.str_)

"""What aggregates add to the variables of products, and what their means hold.

Every row here is new or follows from a row of `lidarops.products.layouts`; values are those of the
products, so that units and names stay what they are there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final

import numpy as np

from lidarops import __version__
from lidarops.netcdf.provenance import product_date
from lidarops.netcdf.variables import NO_NAME, TIME, Coverage, ErrorKind, Layout, Row
from lidarops.products.layouts import LAYOUTS
from lidarops.records import ProductKind

PRODUCT: Final = Row(
    name="product",
    dims=("product",),
    dtype="S1",
    long_name="identifier of the product, its global attribute id",
    coverage=Coverage.REFERENCE,
)
PRODUCT_INDEX: Final = Row(
    name="product_index",
    dims=("time",),
    dtype="i4",
    units="1",
    long_name="place along dimension product of the product that holds the profile",
    coverage=Coverage.REFERENCE,
)


class Period(StrEnum):
    """What a mean covers: a calendar day or month, UTC."""

    DAY = "day"
    MONTH = "month"

    @property
    def duration(self) -> str:
        """ISO 8601."""
        return {"day": "P1D", "month": "P1M"}[self.value]


class Weights(StrEnum):
    """What a profile counts in a mean."""

    PLAIN = "plain"
    """Each alike."""
    INVERSE_VARIANCE = "inverse-variance"
    """By the inverse square of its standard error."""

    @property
    def description(self) -> str:
        """For the attributes of a file."""
        return {
            "plain": "each usable profile counts alike",
            "inverse-variance": "each usable profile counts by 1 / standard_error^2",
        }[self.value]


@dataclass(frozen=True, slots=True)
class Budget:
    """How the standard error of a quantity divides into what is new in every profile and what not.

    The part that is new has the variance sum(random^2) x factor^2; the rest of the square of the
    standard error is one error that all profiles share.
    """

    random: tuple[str, ...]
    """Variables of the error budget that are independent from profile to profile."""
    shared: tuple[str, ...] = ()
    """Those that the profiles share, with signs; where there are none, what is left is shared."""
    times: str | None = None
    """Variable without time that `random` is multiplied by."""
    over: str | None = None
    """Variable without time that `random` is divided by."""


_RANDOM: Final = ("backscatter_error_noise", "backscatter_error_background")
_SHARED: Final = tuple(
    f"backscatter_error_{cause}" for cause in ("reference", "lidar_ratio", "molecular")
)
BUDGETS: Final = {
    (ProductKind.ELASTIC, "backscatter"): Budget(_RANDOM, shared=_SHARED),
    (ProductKind.ELASTIC, "extinction"): Budget(_RANDOM, times="lidar_ratio"),
    (ProductKind.ELASTIC, "scattering_ratio"): Budget(_RANDOM, over="molecular_backscatter"),
    # Nothing tells the noise of its calibration from that of its bins.
    (ProductKind.ELASTIC, "attenuated_backscatter"): Budget(()),
    # Nothing tells noise from what smoothness takes, which profiles of one sky share.
    (ProductKind.MULTIANGLE, "optical_depth"): Budget(()),
    (ProductKind.MULTIANGLE, "extinction"): Budget(()),
    (ProductKind.MULTIANGLE, "layer_optical_depth"): Budget(()),
    # What the prior allows, which all profiles share, is most of them.
    (ProductKind.VISIBILITY, "extinction"): Budget(()),
    (ProductKind.VISIBILITY, "visibility_in_air"): Budget(()),
}
"""Quantities whose errors are not all independent from profile to profile."""


def systematic(kind: ProductKind, name: str) -> str | None:
    """Return the error that stands apart from the standard error and that no mean makes smaller.

    Parameters
    ----------
    kind : ProductKind
    name : str
        Of the quantity.

    Returns
    -------
    str or None
        Such as ``extinction_model_error``; of products or, from `INTERVALS`, of means alone.
    """
    if name in INTERVALS:
        return f"{name}_systematic_error"
    names = (row.name for row in LAYOUTS[kind].data)
    found = (each for each in names if each.startswith(f"{name}_") and each.endswith("_error"))
    return next(found, None)


INTERVALS: Final = {"visibility_in_air": "visibility_in_air_lower"}
"""Quantities whose systematic error products tell by the lower end of an interval alone.

They are reciprocals: of a quantity with the relative random and systematic errors r and s, the
value over the lower end is 1 + sqrt(r^2 + s^2).
"""


_INDEPENDENT: Final = (
    "Standard errors of the profiles are taken as independent: that of the mean is"
    " sqrt(sum(weight^2 standard_error^2)) / sum(weight). What profiles of one scene share, such"
    " as the error of a dark signal, is not told apart and may make it too small."
)
_PARTLY: Final = (
    "Noise and background are independent from profile to profile; the errors of reference, lidar"
    " ratio and molecules are taken as shared by all profiles, so that they are averaged and do"
    " not shrink with their number."
)
_ALL_SHARED: Final = (
    "The errors of the profiles are taken as shared: they are averaged. What of them is noise,"
    " which their number makes smaller, is not told apart."
)


def error_comment(kind: ProductKind, name: str) -> str:
    """Say how the standard error of a mean was found."""
    found = budget_of(kind, name)
    if found is None:
        return _INDEPENDENT
    return _PARTLY if found.random else _ALL_SHARED


def budget_of(kind: ProductKind, name: str) -> Budget | None:
    """Return how the error of a quantity divides; None where it is new in every profile."""
    row = LAYOUTS[kind].row(name)
    independent = row.error_kind in (None, ErrorKind.RANDOM)
    return BUDGETS.get((kind, name), None if independent else Budget(()))


def averaged(kind: ProductKind) -> tuple[Row, ...]:
    """Return the rows of a kind of product that a mean is taken of: those with standard errors."""
    return tuple(row for row in LAYOUTS[kind].data if row.uncertain and row.dims[:1] == ("time",))


def layout(kind: ProductKind, period: Period, weights: Weights) -> Layout:
    """Return what the means of a kind of product hold.

    Parameters
    ----------
    kind : ProductKind
    period : Period
    weights : Weights

    Returns
    -------
    Layout
        ``<name>``, ``<name>_standard_error``, ``<name>_standard_deviation`` and
        ``<name>_observations`` for each quantity with standard errors; systematic errors;
        ``usable_share``, ``quality_flag`` and ``shots``.
    """
    source = LAYOUTS[kind]
    time = replace(TIME, long_name=f"middle of the {period.value}, UTC")
    return replace(
        source,
        title=f"{_ADJECTIVE[period]} means: {source.title}",
        summary=f"Means over the {period.value} of the usable values of products. {source.summary}",
        processing_level="L3: means over time of retrieved quantities",
        comment=f"Means over UTC {period.value}s: {weights.description}. Values that a quality"
        " bit rejects, and values that are missing or have no standard error, are left out;"
        " a profile belongs to the period that its middle lies in. A period covers all of its"
        f" time, whatever part of it was measured. Of the products: {source.comment}",
        coordinates=tuple(time if row.name == "time" else row for row in source.coordinates),
        data=tuple(_rows(source, kind, weights)),
    )


_ADJECTIVE: Final = {Period.DAY: "Daily", Period.MONTH: "Monthly"}


def _rows(source: Layout, kind: ProductKind, weights: Weights) -> Iterator[Row]:
    judged = source.row("quality_flag")
    for row in averaged(kind):
        apart = systematic(kind, row.name)
        yield from _of(row, kind, weights, apart)
        if apart:
            of = _of_interval(row, apart) if row.name in INTERVALS else source.row(apart)
            yield _averaged_error(of, row)
    yield Row(
        name="usable_share",
        dims=judged.dims,
        dtype="f4",
        units="1",
        long_name="share of the profiles of the period whose value no quality bit rejects",
        coverage=Coverage.QUALITY,
        valid_min=0.0,
        valid_max=1.0,
        comment=NO_NAME,
    )
    yield replace(
        judged,
        comment="Of a mean: the bits of the values that it was taken of; where there is no usable"
        " value, the bits of all values.",
    )
    shots = source.row("shots")
    yield replace(shots, dtype="f8", long_name="number of laser shots of all profiles")


def _of(row: Row, kind: ProductKind, weights: Weights, apart: str | None) -> Iterator[Row]:
    """Give the rows of the mean of a quantity."""
    weighed, errors = f"Weights: {weights.description}.", error_comment(kind, row.name)
    count, spread = f"{row.name}_observations", f"{row.name}_standard_deviation"
    ancillaries: tuple[str, ...] = (spread, count)
    if apart:
        ancillaries = (apart, *ancillaries)
    if len(row.dims) > 1:
        ancillaries = (*ancillaries, "usable_share", "quality_flag")
    yield replace(
        row,
        long_name=f"mean over time of {row.long_name}",
        cell_methods=_cell_methods(row, "mean"),
        ancillaries=ancillaries,
        comment=" ".join(text for text in (row.comment, weighed, errors) if text),
    )
    yield replace(
        row,
        name=spread,
        long_name=f"standard deviation over time of {row.long_name}",
        cell_methods=_cell_methods(row, "standard_deviation"),
        valid_min=0.0,
        valid_max=None,
        ancillaries=(),
        uncertain=False,
        error_kind=None,
        comment="Unweighted, of the values that the mean was taken of, with n - 1; missing of"
        f" fewer than two.{'' if row.standard_name else ' ' + NO_NAME}",
    )
    yield Row(
        name=count,
        dims=row.dims,
        dtype="i4",
        units="1",
        standard_name="number_of_observations",
        long_name=f"number of profiles of the mean of {row.name}",
        coverage=Coverage.QUALITY,
        valid_min=0.0,
    )


def _cell_methods(row: Row, method: str) -> str:
    """Return the cell methods of the products, then ours over time; CF lists them in that order."""
    told = row.cell_methods or ""
    rest = told.removeprefix("time: mean").strip()
    ours = f"time: {method} (of usable profiles)"
    return f"{ours} {rest}".strip()


def _of_interval(row: Row, name: str) -> Row:
    """Return the row of the systematic error that the interval of a quantity tells."""
    lower = INTERVALS[row.name]
    return replace(
        row,
        name=name,
        long_name=f"systematic error of {row.long_name} to allow for",
        coverage=Coverage.QUALITY,
        standard_name=None,
        valid_min=0.0,
        ancillaries=(),
        uncertain=False,
        error_kind=ErrorKind.SYSTEMATIC,
        comment=f"Apart from {row.name}_standard_error: {row.name} times the relative systematic"
        f" error of extinction, sqrt(({row.name} / {lower} - 1)^2 - ({row.name}_standard_error /"
        f" {row.name})^2) in each profile. {NO_NAME}",
    )


def _averaged_error(row: Row, of: Row) -> Row:
    return replace(
        row,
        long_name=f"mean over time of {row.long_name}",
        cell_methods=_cell_methods(of, "mean"),
        comment=f"{row.comment} Averaged with the weights of {of.name}: it does not shrink with"
        " the number of profiles.",
    )


def global_attributes(
    shared: Mapping[str, Any], found: Layout, about: About, kind: ProductKind
) -> dict[str, Any]:
    """Return the global attributes of means, in the order in which they are written.

    Parameters
    ----------
    shared : mapping
        What all products have alike and is true of more than one of them.
    found : Layout
        From `layout`.
    about : About
    kind : ProductKind

    Returns
    -------
    dict of str to str, float or numpy scalar
    """
    source = LAYOUTS[kind]
    # The last sentence of a product is on its dates; ours are on ours.
    comment = shared.get("comment", "").partition(" Dates of creation")[0]
    made, why = product_date(about.stop)
    stamp = _iso(made)
    program = f"lidarops {__version__} ({about.code_version})"
    texts = {
        "title": _replaced(shared.get("title", ""), source.title, found.title),
        "summary": _replaced(shared.get("summary", ""), source.summary, found.summary),
    }
    dates = ("date_created", "date_modified", "date_issued", "date_metadata_modified")
    return {
        **shared,
        **texts,
        "id": about.id,
        "processing_level": found.processing_level,
        "product_version": f"{__version__}+{about.code_version}",
        "history": f"{stamp} averaged {about.inputs} products over UTC {about.period.value}s,"
        f" weights {about.weights.value} [{program}]",
        "comment": f"{_replaced(comment, source.comment, found.comment)} Dates of creation and"
        f" change are {why}, so that equal inputs give equal files.",
        "time_coverage_start": _iso(about.start),
        "time_coverage_end": _iso(about.stop),
        "time_coverage_duration": f"P{(about.stop - about.start).days}D",
        "time_coverage_resolution": about.period.duration,
        **dict.fromkeys(dates, stamp),
        PERIOD: about.period.value,
        "lidarops_weights": about.weights.value,
        "lidarops_code_version": about.code_version,
        "lidarops_input_count": np.int32(about.inputs),
    }


PERIOD: Final = "lidarops_period"
"""The global attribute that tells means from products."""


@dataclass(frozen=True, slots=True)
class About:
    """What means are of, besides their numbers."""

    id: str
    period: Period
    weights: Weights
    start: datetime
    """Start of the first period."""
    stop: datetime
    inputs: int
    """Number of products."""
    code_version: str


def _replaced(text: str, old: str, new: str) -> str:
    """Return what a product says of itself with the words of its kind replaced by ours."""
    return text.replace(old, new) if old in text else new


def _iso(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")

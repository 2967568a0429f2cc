"""Variables that aggregates add to products, and the variables of means.

Variables of means follow from the rows of `lidarops.netcdf.variables`, with the same units and
names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lidarops import __version__
from lidarops.aggregate.facts import PERIOD, Facts
from lidarops.netcdf.context import UNUSED_INPUTS, iso
from lidarops.netcdf.provenance import identifier
from lidarops.netcdf.quantities import CLOUD_FRACTION
from lidarops.netcdf.variables import (
    Coverage,
    ErrorBudget,
    ErrorKind,
    Layout,
    Row,
    completed,
    count,
    layout_of,
)
from lidarops.system.code_version import code_version

PRODUCT: Final = Row(
    "product",
    ("product",),
    None,
    "identifier of the product, its global attribute id",
    Coverage.REFERENCE,
    dtype="S1",
)
PRODUCT_INDEX: Final = Row(
    "product_index",
    ("time",),
    "1",
    "index along dimension product of the product that contains the profile",
    Coverage.REFERENCE,
    comment="",
    dtype="i4",
)


class Period(StrEnum):
    """Period of a mean: a calendar day or month, UTC."""

    DAY = "day"
    MONTH = "month"

    @property
    def unit(self) -> str:
        """Unit of numpy and of durations in ISO 8601."""
        return self.value[0].upper()


class Weights(StrEnum):
    """Weights of profiles in a mean."""

    SHOTS = "shots"
    """Number of laser shots: a profile of a few shots counts less than a whole one."""
    PLAIN = "plain"
    """Equal weights."""
    INVERSE_VARIANCE = "inverse-variance"
    """Inverse squares of the standard errors."""

    @property
    def description(self) -> str:
        """Description for the attributes of a file."""
        return {
            "shots": "usable profiles are weighted by their number of laser shots",
            "plain": "usable profiles have equal weights",
            "inverse-variance": "usable profiles have the weights 1 / standard_error^2",
        }[self.value]


def systematic(kind: str, name: str) -> tuple[str, ...]:
    """Return the variables of the systematic errors that are not part of the standard error.

    Parameters
    ----------
    kind : str
    name : str
        Name of the quantity.

    Returns
    -------
    tuple of str
        Such as ``total_extinction_model_error``; variables of products or, for a quantity with an
        interval (`Row.lower_end`), of means only.
    """
    row = layout_of(kind).row(name)
    if row.lower_end:
        return (f"{name}_systematic_error",)
    return tuple(error.name(name) for error in row.errors if not error.part)


_INDEPENDENT: Final = (
    "Standard errors of the profiles are assumed to be independent: that of the mean is"
    " sqrt(sum(weight^2 standard_error^2)) / sum(weight). It may be too small, because errors that"
    " profiles of a scene share, such as that of a dark signal, are not stated separately."
)
_ALL_SHARED: Final = (
    "The errors of the profiles are assumed to be shared: they are averaged. Their noise, which"
    " would decrease with the number of profiles, is not stated separately."
)


def _error_comment(row: Row) -> str:
    """Return how the standard error of a mean is computed."""
    budget = budget_of(row)
    if budget is None:
        return _INDEPENDENT
    return budget.comment or _ALL_SHARED


def states_clouds(kind: str) -> bool:
    """Return whether products of a kind state the share of cloudy profiles of each value."""
    return any(row.name == CLOUD_FRACTION for row in layout_of(kind).data)


def budget_of(row: Row) -> ErrorBudget | None:
    """Return the error budget of a quantity; None if errors are independent between profiles."""
    independent = row.error_kind in (None, ErrorKind.RANDOM)
    return row.budget or (None if independent else ErrorBudget())


def averaged(kind: str) -> tuple[Row, ...]:
    """Return the rows of a product kind that are averaged: those with standard errors."""
    return tuple(row for row in layout_of(kind).data if row.uncertain and row.dims[:1] == ("time",))


def layout(kind: str, period: Period, weights: Weights) -> Layout:
    """Return the layout of the means of a product kind.

    Parameters
    ----------
    kind : str
    period : Period
    weights : Weights

    Returns
    -------
    Layout
        ``<name>``, ``<name>_standard_error``, ``<name>_standard_deviation`` and
        ``<name>_observations`` of each quantity with standard errors; systematic errors;
        ``usable_share``, ``good_share``, ``cloud_fraction`` where products have it,
        ``quality_flag`` and ``shots``.
    """
    source = layout_of(kind)
    time = replace(source.row("time"), long_name=f"middle of the {period.value}, UTC")
    return replace(
        source,
        title=f"{_ADJECTIVE[period]} means: {source.title}",
        summary=f"Means over the {period.value} of the usable values of products. {source.summary}",
        processing_level="L3: means over time of retrieved quantities",
        comment=f"Means over UTC {period.value}s: {weights.description}. Values that a quality"
        " bit rejects, and values that are missing or have no standard error, are left out."
        " A profile belongs to the period that contains its middle. The bounds of a period are"
        f" those of the {period.value}, even if only part of it was measured."
        " time_coverage_start and time_coverage_end are the first and the last time;"
        " time_coverage_duration is that from the first to the last bound. Comment of the"
        f" products: {source.comment}",
        coordinates=tuple(time if row.name == "time" else row for row in source.coordinates),
        data=tuple(map(completed, _rows(source, kind, weights))),
    )


_ADJECTIVE: Final = {Period.DAY: "Daily", Period.MONTH: "Monthly"}


def _rows(source: Layout, kind: str, weights: Weights) -> Iterator[Row]:
    flags = source.row("quality_flag")
    shares = tuple(_shares(source, flags, clouds=states_clouds(kind)))
    of_values = (*(row.name for row in shares), flags.name)
    for row in averaged(kind):
        names = systematic(kind, row.name)
        ancillaries = (*names, *of_values) if row.dims == flags.dims else names
        yield from _mean_rows(row, weights, ancillaries)
        for name in names:
            error = _interval_error(row, name) if row.lower_end else source.row(name)
            yield _averaged_error(error, row)
    yield from shares
    comment = (
        "Bits of the values in the mean; if there is no usable value, bits of all values."
        " low_signal_to_noise is that of the mean: it is smaller than its standard error."
    )
    if states_clouds(kind):
        comment += " cloud: all usable values have it; partly_cloudy: some have one of the two."
    yield replace(flags, comment=comment)
    shots = source.row("shots")
    yield replace(shots, dtype="f8", long_name="number of laser shots of all profiles")


def _shares(source: Layout, flags: Row, *, clouds: bool) -> Iterator[Row]:
    """Yield the rows that tell of which profiles a mean is made."""
    for name, words, comment in (
        ("usable_share", "no quality bit rejects", None),
        (
            "good_share",
            "has no quality bit",
            "The others of usable_share are to be used with care.",
        ),
    ):
        yield Row(
            name,
            flags.dims,
            "1",
            f"share of the profiles of the period whose value {words}",
            Coverage.QUALITY,
            comment,
            valid_min=0.0,
            valid_max=1.0,
        )
    if clouds:
        fraction = source.row(CLOUD_FRACTION)
        yield replace(
            fraction,
            long_name=f"mean over time of {fraction.long_name}",
            cell_methods=_cell_methods(fraction, "mean"),
            comment="Of the profiles whose value no quality bit rejects, weighted by shots where"
            " the weights of values are their variances, else as values. One of which only the"
            " mean shows a cloud is cloudy. Missing where no such profile was examined.",
        )


def _mean_rows(row: Row, weights: Weights, further: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of the mean of a quantity, with further ancillary variables."""
    weighting, errors = f"Weights: {weights.description}.", _error_comment(row)
    number, spread = f"{row.name}_observations", f"{row.name}_standard_deviation"
    yield replace(
        row,
        long_name=f"mean over time of {row.long_name}",
        cell_methods=_cell_methods(row, "mean"),
        ancillaries=(spread, number, *further),
        errors=(),
        comment=" ".join(text for text in (row.comment, weighting, errors) if text),
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
        errors=(),
        budget=None,
        error_kind=None,
        comment="Unweighted, over the values in the mean, with n - 1; missing for fewer than two"
        " values.",
    )
    words = f"number of profiles in the mean of {row.name}"
    yield count(number, row.dims, words, coverage=Coverage.QUALITY)


def _cell_methods(row: Row, method: str) -> str:
    """Return the cell methods of a mean over time, followed by other methods of the product."""
    rest = (row.cell_methods or "").removeprefix("time: mean").strip()
    return f"time: {method} (of usable profiles) {rest}".strip()


def _interval_error(row: Row, name: str) -> Row:
    """Return the row of the systematic error that follows from the interval of a quantity."""
    error = replace(
        row,
        name=name,
        long_name=f"model (systematic) uncertainty of {row.long_name}",
        coverage=Coverage.QUALITY,
        standard_name=None,
        valid_min=0.0,
        ancillaries=(),
        uncertain=False,
        errors=(),
        error_kind=ErrorKind.SYSTEMATIC,
        comment=f"Not part of {row.name}_standard_error: {row.name} times the relative systematic"
        f" error of extinction, sqrt(({row.name} / {row.lower_end} - 1)^2 -"
        f" ({row.name}_standard_error / {row.name})^2) in each profile.",
    )
    return completed(error)


def _averaged_error(row: Row, quantity: Row) -> Row:
    return replace(
        row,
        long_name=f"mean over time of {row.long_name}",
        cell_methods=_cell_methods(quantity, "mean"),
        comment=f"{row.comment} Averaged with the weights of {quantity.name}: it does not decrease"
        " with the number of profiles.",
    )


@dataclass(frozen=True, slots=True)
class MeansDescription:
    """Inputs, settings and periods of means: what their attributes and provenance state."""

    inputs: tuple[Facts, ...]
    period: Period
    weights: Weights
    bounds: NDArray[np.datetime64]
    """(time, 2), start and end of each period."""
    partial: int
    """Number of products that lack raw files of their scenes."""
    modified: str
    """``date_modified`` of the newest product."""
    version: int
    """Sum of the versions of the products."""

    @property
    def kind(self) -> str:
        """Kind of the products."""
        return self.inputs[0].kind

    @property
    def start(self) -> datetime:
        """Start of the first period."""
        return _datetime(self.bounds[0, 0])

    @property
    def stop(self) -> datetime:
        """End of the last period."""
        return _datetime(self.bounds[-1, 1])

    @property
    def code_version(self) -> str:
        """Digest of the code that makes products of the kind and their means."""
        return code_version(self.kind, "lidarops.aggregate.means")

    @property
    def id(self) -> str:
        """UUID version 5 of the inputs' sha256, period, weights, time and code version."""
        return identifier(
            {
                "means": {"period": self.period.value, "weights": self.weights.value},
                "inputs": sorted(facts.sha256 for facts in self.inputs),
                "time": [self.start.isoformat(), self.stop.isoformat()],
                "code_version": self.code_version,
            }
        )


def _datetime(moment: np.datetime64) -> datetime:
    plain: datetime = moment.astype("datetime64[us]").item()
    return plain.replace(tzinfo=UTC)


def global_attributes(
    shared: Mapping[str, Any], table: Layout, about: MeansDescription
) -> dict[str, Any]:
    """Return the global attributes of means, in the order in which they are written.

    Parameters
    ----------
    shared : mapping
        Global attributes that are equal in all products and apply to all.
    table : Layout
        From `layout`.
    about : MeansDescription

    Returns
    -------
    dict of str to str, float or numpy scalar
    """
    source = layout_of(about.kind)
    # The comment of a product ends with a sentence on its dates, which is replaced.
    comment = shared.get("comment", "").partition(" Dates of creation")[0]
    program = f"lidarops {__version__} ({about.code_version})"
    count = len(about.inputs)
    first, last = (_datetime(pair[0] + (pair[1] - pair[0]) // 2) for pair in about.bounds[[0, -1]])
    dates = ("date_created", "date_modified", "date_issued", "date_metadata_modified")
    attributes = {
        **shared,
        "title": _replaced(shared.get("title", ""), source.title, table.title),
        "summary": _replaced(shared.get("summary", ""), source.summary, table.summary),
        "id": about.id,
        "processing_level": table.processing_level,
        "product_version": str(about.version),
        "history": f"{about.modified} averaged {count} products over UTC"
        f" {about.period.value}s, weights {about.weights.value} [{program}]",
        "comment": f"{_replaced(comment, source.comment, table.comment)} Dates of creation and"
        " change are those of the newest product, and product_version is the sum of those of the"
        " products, so that equal inputs give equal files: it grows with each product that is added"
        " or replaced.",
        # As ACDD has it: the times of the first and last value, which are middles of periods.
        "time_coverage_start": iso(first),
        "time_coverage_end": iso(last),
        "time_coverage_duration": f"P{(about.stop - about.start).days}D",
        "time_coverage_resolution": f"P1{about.period.unit}",
        **dict.fromkeys(dates, about.modified),
        PERIOD: about.period.value,
        "lidarops_weights": about.weights.value,
        "lidarops_code_version": about.code_version,
        "lidarops_input_count": np.int32(count),
    }
    if about.partial:
        words = f"{about.partial} of {count} products lack raw files, and name them"
        attributes[UNUSED_INPUTS] = words
    return attributes


def _replaced(text: str, old: str, new: str) -> str:
    """Return a text with the text of the product kind replaced by that of means."""
    return text.replace(old, new) if old in text else new

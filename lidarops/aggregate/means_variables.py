"""Variables that aggregates add to products, and the variables of means.

Variables of means follow from the rows of `lidarops.netcdf.variables`, with the same units and
names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

from lidarops.aggregate.facts import Period, Weights
from lidarops.netcdf.quantities import CLOUD_FRACTION
from lidarops.netcdf.variables import (
    QUALITY_FLAG,
    Coverage,
    ErrorBudget,
    ErrorKind,
    Layout,
    Row,
    completed,
    count,
    judging,
    layout_of,
)

PRODUCT: Final = Row(
    "product",
    "identifier of the product, its global attribute id",
    dims=("product",),
    units=None,
    coverage=Coverage.REFERENCE,
    dtype="S1",
)
PRODUCT_INDEX: Final = Row(
    "product_index",
    "index along dimension product of the product that contains the profile",
    "",
    dims=("time",),
    coverage=Coverage.REFERENCE,
    dtype="i4",
)


_INDEPENDENT: Final = (
    "Standard errors of the profiles are assumed to be independent: that of the mean is"
    " sqrt(sum(weight^2 standard_error^2)) / sum(weight). It may be too small, because errors that"
    " profiles of a scene share, such as that of a dark signal, are not stated separately."
)
_ALL_SHARED: Final = (
    "The errors of the profiles are assumed to be shared: they are averaged. Their noise, which"
    " would decrease with the number of profiles, is not stated separately."
)


def systematic(row: Row) -> tuple[str, ...]:
    """Return the variables of the systematic errors that are not part of the standard error.

    Such as ``total_extinction_model_error``; variables of products or, for a quantity with an
    interval (`Row.lower_end`), of means only.
    """
    if row.lower_end:
        return (f"{row.name}_systematic_error",)
    return tuple(error.name(row.name) for error in row.errors if not error.part)


def budget_of(row: Row) -> ErrorBudget | None:
    """Return the error budget of a quantity; None if errors are independent between profiles."""
    independent = row.error_kind in (None, ErrorKind.RANDOM)
    return row.budget or (None if independent else ErrorBudget())


def averaged(source: Layout) -> tuple[Row, ...]:
    """Return the rows of a product kind that are averaged: those with standard errors."""
    return tuple(row for row in source.data if row.uncertain and row.dims[:1] == ("time",))


def layout(kind: str, period: Period, weights: Weights) -> Layout:
    """Return the layout of the means of a product kind.

    Returns
    -------
    Layout
        ``<name>``, ``<name>_standard_error``, ``<name>_standard_deviation`` and
        ``<name>_observations`` of each quantity with standard errors; systematic errors;
        ``usable_share``, ``good_share``, ``cloud_fraction`` where products have it,
        ``quality_flag`` and ``shots``.
    """
    source = layout_of(kind)
    time = replace(source.rows["time"], long_name=f"middle of the {period.value}, UTC")
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
        data=tuple(map(completed, _rows(source, weights))),
    )


_ADJECTIVE: Final = {Period.DAY: "Daily", Period.MONTH: "Monthly"}
_FLAG_COMMENT: Final = (
    "Bits of the values in the mean; if there is no usable value, bits of all values."
    " low_signal_to_noise is that of the mean: it is smaller than its standard error."
)
_CLOUD_COMMENT: Final = (
    " cloud: all usable values have it; partly_cloudy: some have one of the two."
)


def _rows(source: Layout, weights: Weights) -> Iterator[Row]:
    judges = {row.name: row for row in source.judges}
    cloudy = (CLOUD_FRACTION,) if CLOUD_FRACTION in source.rows else ()
    for row in averaged(source):
        names = systematic(row)
        flags = judges[judging(row.name, judges)]
        of_values = *share_names(flags.name), *cloudy, QUALITY_FLAG
        ancillaries = (*names, *of_values) if row.dims == flags.dims else names
        yield from _mean_rows(row, weights, ancillaries)
        for name in names:
            error = _interval_error(row, name) if row.lower_end else source.rows[name]
            yield _averaged(
                error,
                row,
                comment=f"{error.comment} Averaged with the weights of {row.name}: it does not"
                " decrease with the number of profiles.",
            )
    for flags in source.judges:
        yield from _shares(flags)
        yield replace(flags, comment=_FLAG_COMMENT + (_CLOUD_COMMENT if cloudy else ""))
    for name in cloudy:
        fraction = source.rows[name]
        yield _averaged(
            fraction,
            fraction,
            comment="Of the profiles whose value no bit of quality_flag rejects, weighted by shots"
            " where the weights of values are their variances, else as values. One of which only"
            " the mean shows a cloud is cloudy. Missing where no such profile was examined.",
        )
    shots = source.rows["shots"]
    yield replace(shots, dtype="f8", long_name="number of laser shots of all profiles")


def share_names(flags: str) -> tuple[str, str]:
    """Return the names of the shares of usable and of good values, by a variable of flags."""
    whose = flags.removesuffix(QUALITY_FLAG)
    return f"{whose}usable_share", f"{whose}good_share"


def _shares(flags: Row) -> Iterator[Row]:
    """Yield the rows that tell of which profiles a mean is made."""
    usable, good = share_names(flags.name)
    for name, words, comment in (
        (usable, f"no bit of {flags.name} rejects", None),
        (
            good,
            f"has no bit in {flags.name}",
            f"The others of {usable} are to be used with care.",
        ),
    ):
        yield Row(
            name,
            f"share of the profiles of the period whose value {words}",
            comment,
            dims=flags.dims,
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            valid_max=1.0,
            optional=flags.optional,
        )


def _mean_rows(row: Row, weights: Weights, further: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of the mean of a quantity, with further ancillary variables."""
    number, spread = f"{row.name}_observations", f"{row.name}_standard_deviation"
    budget = budget_of(row)
    errors = _INDEPENDENT if budget is None else budget.comment or _ALL_SHARED
    weighting = f"Weights: {weights.description}."
    yield _averaged(
        row,
        row,
        ancillaries=(spread, number, *further),
        errors=(),
        comment=" ".join(text for text in (row.comment, weighting, errors) if text),
    )
    yield _averaged(
        replace(row, **_ALONE),
        row,
        "standard deviation",
        name=spread,
        valid_min=0.0,
        valid_max=None,
        comment="Unweighted, over the values in the mean, with n - 1; missing for fewer than two"
        " values.",
    )
    words = f"number of profiles in the mean of {row.name}"
    yield count(number, words, dims=row.dims, coverage=Coverage.QUALITY)


_ALONE: Final[dict[str, Any]] = {
    "ancillaries": (), "errors": (), "uncertain": False, "budget": None, "error_kind": None,
}  # fmt: skip
"""Fields of a row without errors of its own."""


def _averaged(row: Row, quantity: Row, method: str = "mean", **changes: Any) -> Row:
    """Return the row of what is formed over time of a variable, by the method of a quantity."""
    # Other methods of the product follow.
    rest = (quantity.cell_methods or "").removeprefix("time: mean").strip()
    methods = f"time: {method.replace(' ', '_')} (of usable profiles) {rest}".strip()
    words = f"{method} over time of {row.long_name}"
    return replace(row, **{"long_name": words, "cell_methods": methods, **changes})


def _interval_error(row: Row, name: str) -> Row:
    """Return the row of the systematic error that follows from the interval of a quantity."""
    error = replace(
        row,
        **{**_ALONE, "error_kind": ErrorKind.SYSTEMATIC},
        name=name,
        long_name=f"model (systematic) uncertainty of {row.long_name}",
        coverage=Coverage.QUALITY,
        standard_name=None,
        valid_min=0.0,
        comment=f"Not part of {row.name}_standard_error: {row.name} times the relative systematic"
        f" error of extinction, sqrt(({row.name} / {row.lower_end} - 1)^2 -"
        f" ({row.name}_standard_error / {row.name})^2) in each profile.",
    )
    return completed(error)

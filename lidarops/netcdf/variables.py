"""Describe the variables of a product: one `Row` a quantity, one `Layout` a kind of product.

The CF and ACDD attributes of a variable follow from its row, and the rows of all its errors from
that of their quantity. `lidarops/products/KIND/variables.py` holds the rows of a kind, where a
variable gets its CF standard name, long name and comment, `lidarops.netcdf.quantities` those that
some kinds share; this module holds those of all: time, place, quality, counts, background.
Standard names are those of the CF table v93. A quantity without an entry there has no standard
name, because none is better than a wrong one (`cf111`, section 3.3).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from enum import IntFlag, StrEnum
from functools import cache, cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarops import __version__
from lidarops.errors import ProductError
from lidarops.flags import Flags, Severity
from lidarops.kinds import kinds
from lidarops.records import SIGNAL_UNITS, DetectionMode

CONVENTIONS: Final = "CF-1.11, ACDD-1.3"
STANDARD_NAME_TABLE: Final = "CF Standard Name Table v93"
FILL_VALUE: Final = np.float32(9.969209968386869e36)
"""The netCDF default fill value of floats, on float data only."""
TIME_UNITS: Final = "seconds since 1970-01-01 00:00:00"
"""All files share one epoch, so that tools that do not decode time can join them."""
BOUNDS_DIM: Final = "nv"

_ERROR_BITS: Final = 8
"""Significant bits of the standard error of a rounded quantity: 0.2 percent at worst."""
NO_STANDARD_NAME: Final = f"The {STANDARD_NAME_TABLE} has no name for this quantity."
MEASURED_SHARES: Final = (
    "The results in the documentation state the share of such values in simulated scenes."
)
QUALITY_FLAG: Final = "quality_flag"
USABLE: Final = "usable"
FLAG_LAYOUT: Final = "lidarops_flag_layout"
"""Attribute of ``quality_flag`` with the name of the places of its bits (`Flags.layout`)."""
RECORDERS: Final = "lidarops_recorder"
"""Global attribute with the recorders of the channels."""


class ErrorKind(StrEnum):
    """Correlation of an error between profiles: attribute ``error_kind``."""

    RANDOM = "random"
    """Independent from profile to profile: a mean over time reduces it."""
    SYSTEMATIC = "systematic"
    """Common to all profiles: a mean does not reduce it."""
    BOTH = "random and systematic"


class Coverage(StrEnum):
    """ISO 19115-1 coverage content types (`acdd13`)."""

    PHYSICAL = "physicalMeasurement"
    QUALITY = "qualityInformation"
    AUXILIARY = "auxiliaryInformation"
    REFERENCE = "referenceInformation"
    COORDINATE = "coordinate"


class Error(NamedTuple):
    """An error of a quantity by one cause, which has a variable of its own.

    Its name, dimensions and unit follow from the quantity, for whose name ``{quantity}`` stands.
    """

    cause: str
    long_name: str
    kind: ErrorKind = ErrorKind.SYSTEMATIC
    comment: str = ""
    part: bool = False
    """Whether it is part of the standard error: ``<quantity>_error_<cause>``, and signed; else it
    is separate: ``<quantity>_<cause>_error``."""
    signed: bool = False
    """Whether it is the change of the quantity, which may be negative."""
    optional: bool = False
    """Whether a product with the quantity may lack it. Such errors are no ancillary variables."""

    def name(self, quantity: str) -> str:
        """Return the name of the variable."""
        return f"{quantity}_error_{self.cause}" if self.part else f"{quantity}_{self.cause}_error"


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Division of a standard error into a part independent between profiles and shared parts.

    The independent part has the variance sum(random^2) x factor^2. The rest of the squared standard
    error is an error that all profiles share.
    """

    random: tuple[str, ...] = ()
    """Variables of the error budget that are independent between profiles."""
    shared: tuple[str, ...] = ()
    """Signed variables that all profiles share; if empty, the rest of the error is shared."""
    times: str | None = None
    """Variable without time that `random` is multiplied by."""
    over: str | None = None
    """Variable without time that `random` is divided by."""
    comment: str = ""
    """How the standard error of a mean follows; empty where all profiles share the error."""


def divided(quantity: str, errors: tuple[Error, ...], comment: str) -> ErrorBudget:
    """Return the budget of a quantity by those of its errors that are part of its standard error.

    Parameters
    ----------
    quantity : str
        Name of the variable.
    errors : tuple of Error
    comment : str
        How the standard error of a mean follows.
    """
    random, shared = (
        tuple(error.name(quantity) for error in errors if error.part and error.kind is kind)
        for kind in (ErrorKind.RANDOM, ErrorKind.SYSTEMATIC)
    )
    return ErrorBudget(random, shared, comment=comment)


@dataclass(frozen=True, slots=True)
class Row:
    """Description of one variable of a product, and of its errors."""

    name: str
    long_name: str
    comment: str | None = None
    """Without standard name, `NO_STANDARD_NAME` is added; not to coordinates or an empty text."""
    _: KW_ONLY
    dims: tuple[str, ...] = ("time", "{sampled}")
    """By default the values of a kind of product: over time and `Layout.sampled`."""
    units: str | None = "1"
    """``{signal}`` stands for mV in analog detection and MHz in photon counting."""
    coverage: Coverage | None = None
    """By default that of a coordinate or, in `Layout.data`, of a measurement."""
    dtype: str = ""
    """numpy type code as stored, ``S1`` for text; by default ``f8`` of coordinates, else ``f4``."""
    standard_name: str | None = None
    axis: str | None = None
    positive: str | None = None
    bounds: str | None = None
    """Name of the variable with the cell bounds; it has one more dimension and no attributes."""
    cell_methods: str | None = None
    """By default the mean over time and range of measured quantities."""
    valid_min: float | None = None
    valid_max: float | None = None
    ancillaries: tuple[str, ...] = ()
    """Besides the variables of its errors."""
    bits: int | None = None
    """Bits of the mantissa that are stored; None stores all."""
    uncertain: bool = False
    """Whether the product also holds ``<name>_standard_error``."""
    errors: tuple[Error, ...] = ()
    """Further errors, with a variable each."""
    optional: bool = False
    """Whether a product may lack it."""
    follows_beam: bool = False
    """Whether the variable gets ``time`` as first dimension where the beam moves."""
    flags: Flags | None = None
    """The bits that a flag variable can carry."""
    reasons: type[IntFlag] | None = None
    """Bits of a variable that states reasons, and judges no value."""
    states: tuple[str, ...] = ()
    """Words of a variable whose values are 0, 1, ..."""
    error_kind: ErrorKind | None = None
    """Kind of the error that it holds, or of its standard error; both by default with a budget."""
    budget: ErrorBudget | None = None
    """How the standard error averages over time. None: by its kind, which is independent between
    profiles if random, else shared by all."""
    lower_end: str | None = None
    """Variable with the lower end of the interval that the systematic error follows from. The
    quantity is the reciprocal of one with the relative random and systematic errors r and s; the
    value divided by the lower end is 1 + sqrt(r^2 + s^2)."""
    cf_role: str | None = None
    algorithm: str | None = None

    def code(self, state: str) -> int:
        """Return the number by which a variable with `states` holds one of them."""
        return self.states.index(state)


def completed(row: Row, coverage: Coverage = Coverage.PHYSICAL, sampled: str = "") -> Row:
    """Return a row with what follows from its other fields and from its place in a layout."""
    coverage = row.coverage or coverage
    coordinate = coverage is Coverage.COORDINATE
    dims = tuple(dim.format(sampled=sampled) for dim in row.dims)
    dtype = row.dtype or ("f8" if coordinate else "f4")
    derived: dict[str, Any] = {"coverage": coverage, "dims": dims, "dtype": dtype}
    known = row.standard_name or coordinate or row.comment == ""
    if row.units and not known and NO_STANDARD_NAME not in (row.comment or ""):
        derived["comment"] = f"{row.comment or ''} {NO_STANDARD_NAME}".strip()
    if coverage is Coverage.PHYSICAL and row.cell_methods is None:
        methods = (f"{dim}: mean" for dim in dims if dim in ("time", "range"))
        derived["cell_methods"] = " ".join(methods)
    if row.budget is not None and row.error_kind is None:
        derived["error_kind"] = ErrorKind.BOTH
    return replace(row, **derived)


def _variables(row: Row, flags: Collection[str]) -> Iterator[Row]:
    """Yield a row with all its ancillary variables, then the rows that follow from it.

    These are its standard error, its further errors, and the summary of flags. Of `flags`, the
    variables of flags of the layout, one stands in the place of ``quality_flag``.
    """
    derived = [_error(row, error) for error in row.errors]
    if row.uncertain:
        random = _error(row, Error("standard", f"standard error of {row.long_name}"))
        name = row.standard_name and f"{row.standard_name} standard_error"
        comment = None if name else NO_STANDARD_NAME
        kind = row.error_kind or ErrorKind.RANDOM
        standard = replace(random, standard_name=name, comment=comment, error_kind=kind)
        derived.insert(0, standard)
    certain = (error.name for error in derived if row.optional or not error.optional)
    ancillaries = (*certain, *row.ancillaries)
    if QUALITY_FLAG in ancillaries:
        place, judge = ancillaries.index(QUALITY_FLAG), judging(row.name, flags)
        named = judge, summary_of(judge)
        ancillaries = (*ancillaries[:place], *named, *ancillaries[place + 1 :])
    yield replace(row, ancillaries=ancillaries)
    yield from derived
    if row.flags is not None:
        yield _usable(row)


def _error(row: Row, error: Error) -> Row:
    """Return the row of one of the errors of a quantity."""
    comment = f"{error.comment.format(quantity=row.name)} {NO_STANDARD_NAME}".strip()
    return Row(
        error.name(row.name),
        error.long_name.format(quantity=row.name),
        comment,
        dims=row.dims,
        units=row.units,
        coverage=Coverage.QUALITY,
        dtype=row.dtype,
        valid_min=None if error.part or error.signed else 0.0,
        bits=row.bits and _ERROR_BITS,
        optional=row.optional or error.optional,
        error_kind=error.kind,
    )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Variables and global texts of one kind of product."""

    title: str
    summary: str
    keywords: tuple[str, ...]
    processing_level: str = "L2: retrieved quantities"
    references: tuple[str, ...]
    comment: str
    sampled: str
    """The dimension besides time."""
    coordinates: tuple[Row, ...]
    data: tuple[Row, ...]
    feature_type: str | None = None
    """CF ``featureType`` (discrete sampling geometry, chapter 9), unless it depends on the beam."""
    weighed: tuple[str, ...] = ()
    """Variables that raise LOW_SIGNAL_TO_NOISE where they are small against their error."""

    @cached_property
    def variables(self) -> tuple[Row, ...]:
        """Data rows, each followed by the rows that follow from it: errors, summary of flags."""
        flags = [row.name for row in self.judges]
        return tuple(variable for row in self.data for variable in _variables(row, flags))

    @cached_property
    def judges(self) -> tuple[Row, ...]:
        """Rows of the variables of flags: ``quality_flag`` and those of single quantities."""
        return tuple(row for row in self.data if row.flags is not None)

    @cached_property
    def flags(self) -> Flags:
        """Bits that a variable of flags can carry.

        Raises
        ------
        ProductError
            If no row states any.
        """
        stated = [row.flags for row in self.judges if row.flags is not None]
        if not stated:
            raise ProductError("states no flags", field=QUALITY_FLAG, remedy="use `quality`")
        first, *more = stated
        return first.only({bit for flags in stated for bit in flags}) if more else first

    @cached_property
    def rows(self) -> dict[str, Row]:
        """Variables and coordinates by name."""
        return {row.name: row for row in (*self.coordinates, *self.variables)}


@cache
def layout_of(kind: str) -> Layout:
    """Return the layout of a kind of product, by the name of the kind.

    Raises
    ------
    LidarOpsError
        If there is no such kind, or it has no ``variables``.
    """
    layout: Layout = kinds()[kind].part("variables", "LAYOUT")
    coordinates = tuple(completed(row, Coverage.COORDINATE) for row in layout.coordinates)
    data = tuple(completed(row, sampled=layout.sampled) for row in layout.data)
    return replace(layout, coordinates=coordinates, data=data)


def is_retrieved(kind: str) -> bool:
    """Return whether a kind of product holds retrieved quantities, not signals.

    An unknown kind is taken to be retrieved.
    """
    return kind not in kinds() or not layout_of(kind).processing_level.startswith("L1")


def judging(quantity: str, names: Iterable[str]) -> str:
    """Return the name of the flags that judge a quantity, or an error of it.

    Its own where `names` hold such, as ``lidar_ratio_quality_flag``; else ``quality_flag``.
    """
    owners = (
        name
        for name in names
        if name.endswith(f"_{QUALITY_FLAG}")
        and f"{quantity}_".startswith(name.removesuffix(QUALITY_FLAG))
    )
    return next(owners, QUALITY_FLAG)


def possible_judges(quantity: str) -> list[str]:
    """Return the names of all flags that might judge a quantity, or an error of it."""
    words = quantity.split("_")
    owners = ("_".join(words[:count]) for count in range(1, len(words) + 1))
    return [QUALITY_FLAG, *(f"{owner}_{QUALITY_FLAG}" for owner in owners)]


def summary_of(flags: str) -> str:
    """Return the name of the summary of a variable of flags: ``usable``, ``lidar_ratio_usable``."""
    return f"{flags.removesuffix(QUALITY_FLAG)}{USABLE}"


def _usable(flags: Row) -> Row:
    """Return the row of the severity of the worst bit of flags.

    It is computed from the flags and never passed in, so that it cannot contradict them.
    """
    return Row(
        summary_of(flags.name),
        f"usability of the value, from the bits of {flags.name}",
        f"do_not_use: {flags.name} has a bit that its flag_assessments call Bad. use_with_care: it"
        " has Indeterminate bits only. good: no test failed.",
        dims=flags.dims,
        coverage=Coverage.QUALITY,
        dtype="i1",
        standard_name="aggregate_quality_flag",
        states=("good", "use_with_care", "do_not_use"),
        optional=flags.optional,
    )


def summarize_flags(values: NDArray[np.int32], flags: Flags) -> NDArray[np.int8]:
    """Return the values of ``usable``: the severity of the worst bit, 0 without any bit.

    Parameters
    ----------
    values : ndarray of int32
        Values of ``quality_flag``.
    flags : Flags
        Bits of the kind of product.

    Returns
    -------
    ndarray of int8
        0 good, 1 use with care, 2 do not use.
    """
    severity = np.where(values == 0, 0, int(Severity.CARE)).astype(np.int8)
    severity[(values & np.int32(flags.rejecting)) != 0] = int(Severity.REJECT)
    return severity


def attributes(
    row: Row, *, mode: DetectionMode, coordinates: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return the attributes of a variable, in the order in which they are written.

    Parameters
    ----------
    row : Row
    mode : DetectionMode
        Determines the unit of the signal.
    coordinates : tuple of str
        Names of the variable's auxiliary coordinates.
    """
    stored = np.dtype(row.dtype)
    limits = {"valid_min": row.valid_min, "valid_max": row.valid_max}
    filled = stored.kind == "f" and row.coverage is not Coverage.COORDINATE
    attrs: dict[str, Any] = {
        "standard_name": row.standard_name,
        "long_name": row.long_name,
        "units": row.units and row.units.format(signal=SIGNAL_UNITS[mode]),
        "axis": row.axis,
        "positive": row.positive,
        "bounds": row.bounds,
        "cell_methods": row.cell_methods,
        **{name: stored.type(limit) for name, limit in limits.items() if limit is not None},
        "coverage_content_type": row.coverage and row.coverage.value,
        "ancillary_variables": " ".join(row.ancillaries) or None,
        "coordinates": " ".join(coordinates) or None,
        "cf_role": row.cf_role,
        "algorithm": row.algorithm,
        "implementation": row.algorithm and f"lidarops {__version__} (numpy)",
        "_FillValue": FILL_VALUE if filled else None,
        "_Encoding": "utf-8" if stored.kind == "S" else None,
    }
    if row.bits is not None:
        attrs["quantization"] = QUANTIZATION.name
        attrs["quantization_nsb"] = np.int32(row.bits)
    if row.error_kind is not None and not row.uncertain:
        attrs["error_kind"] = row.error_kind.value
    comment = row.comment
    if row.flags is not None:
        bits = row.flags.bits
        texts = (f"{bit.word}: {bit.description}" for bit in bits)
        attrs[FLAG_LAYOUT] = row.flags.layout
        attrs["flag_masks"] = np.array(bits, dtype=stored)
        attrs["flag_meanings"] = " ".join(bit.word for bit in bits)
        attrs["flag_assessments"] = " ".join(bit.severity.assessment for bit in bits)
        comment = (
            f"0: no test failed. {'; '.join(texts)}. Bad: do not use the value; Indeterminate:"
            " the value is valid, but its stated uncertainty may be too small, or as large as the"
            " value."
            f" {row.comment or ''}"
        ).strip()
    if row.reasons is not None:
        attrs["flag_masks"] = np.array([*row.reasons], dtype=stored)
        attrs["flag_meanings"] = " ".join(str(reason.name).lower() for reason in row.reasons)
    if row.states:
        attrs["flag_values"] = np.arange(len(row.states), dtype=stored)
        attrs["flag_meanings"] = " ".join(row.states)
    attrs["comment"] = comment or None
    return {key: value for key, value in attrs.items() if value is not None}


TIME: Final = Row(
    "time",
    "midpoint of the averaging interval, UTC",
    dims=("time",),
    units=TIME_UNITS,
    standard_name="time",
    axis="T",
    bounds="time_bnds",
)
RANGE: Final = Row(
    "range",
    "distance from the lidar along the beam, centre of the range bin",
    dims=("range",),
    units="m",
    bounds="range_bnds",
)


def numbered(name: str, long_name: str, comment: str | None = None, **more: Any) -> Row:
    """Return the row of the coordinate of a dimension whose places have numbers."""
    return replace(Row(name, long_name, comment, dims=(name,), dtype="i4"), **more)


def altitude(along: str, bounds: str | None = None) -> Row:
    """Return the row of the altitude of values along a dimension."""
    return Row(
        "altitude",
        "altitude of the sounded air above the geoid",
        "Station altitude + range x cos(zenith angle), for a straight beam over a flat"
        " Earth. Curvature of the Earth adds (range x sin(zenith angle))^2 / 12742 km.",
        dims=(along,),
        units="m",
        dtype="f4",
        standard_name="altitude",
        axis="Z",
        positive="up",
        bounds=bounds,
        follows_beam=True,
    )


PLACE: Final = (
    Row(
        "zenith_angle",
        "zenith angle of the beam, 0 = up",
        dims=(),
        units="degree",
        standard_name="zenith_angle",
        valid_min=0.0,
        valid_max=180.0,
        follows_beam=True,
    ),
    Row(
        "azimuth",
        "azimuth of the beam, clockwise from north",
        dims=(),
        units="degree",
        standard_name="direction_of_radial_vector_away_from_instrument",
        follows_beam=True,
    ),
    Row(
        "latitude",
        "latitude of the station",
        dims=(),
        units="degrees_north",
        standard_name="latitude",
        valid_min=-90.0,
        valid_max=90.0,
    ),
    Row(
        "longitude",
        "longitude of the station",
        dims=(),
        units="degrees_east",
        standard_name="longitude",
        valid_min=-180.0,
        valid_max=180.0,
    ),
    Row(
        "station_altitude",
        "altitude of the station above the geoid",
        dims=(),
        units="m",
        standard_name="surface_altitude",
    ),
    Row(
        "wavelength",
        "wavelength of the channel",
        dims=(),
        units="nm",
        standard_name="radiation_wavelength",
        valid_min=0.0,
    ),
)


def place(name: str, /, **changes: Any) -> Row:
    """Return the row of a part of `PLACE`, with some fields changed."""
    row = next(row for row in PLACE if row.name == name)
    return replace(row, **{"dtype": "f8", **changes})


SOUNDED: Final = tuple(
    place(
        name,
        name=f"bin_{name}",
        long_name=f"{name} of the sounded air",
        dtype="f4",
        follows_beam=True,
        comment="For a straight beam, on the WGS 84 ellipsoid.",
    )
    for name in ("latitude", "longitude")
)
"""Position of the sounded air along a slant beam of known azimuth; `coordinates` sets `dims`."""


def coordinates(along: tuple[Row, ...], altitude: Row) -> tuple[Row, ...]:
    """Return the coordinates of a kind of product: time, along the beam, position."""
    sounded = (replace(row, dims=altitude.dims) for row in SOUNDED)
    return (TIME, *along, altitude, *sounded, *PLACE)


ALONG_BEAM: Final = coordinates((RANGE,), altitude("range"))
"""Coordinates of kinds whose values are those of range bins."""


def deployment(row: Row) -> Row:
    """Return the row of a station's latitude or longitude where the sounded air lies elsewhere.

    Generic readers identify the latitude of the values by its standard name or unit, which the
    station's must therefore not carry.
    """
    direction = "north" if row.name == "latitude" else "east"
    return replace(
        row,
        standard_name=f"deployment_{row.name}",
        units="degree",
        comment=f"Positive {direction}. bin_{row.name} is the {row.name} of the sounded air.",
    )


STATION: Final = Row(
    "station",
    "name of the station, or of the network of lidars",
    dims=("station_strlen",),
    units=None,
    coverage=Coverage.REFERENCE,
    dtype="S1",
    standard_name="platform_name",
)
QUANTIZATION: Final = Row(
    "quantization_info",
    "rounding of values to fewer significant bits",
    dims=(),
    units=None,
    coverage=Coverage.REFERENCE,
    dtype="i4",
    algorithm="bitround",
)
"""Container variable of CF-1.12, section 8.4; its value has no meaning."""
PROVENANCE: Final = Row(
    "provenance",
    "inputs, plan, settings and software of this product as W3C PROV-JSON",
    dims=("provenance_strlen",),
    units=None,
    coverage=Coverage.REFERENCE,
    dtype="S1",
)


def quality(flags: Flags, quantity: str = "", **more: Any) -> Row:
    """Return the row of the quality bits of a kind of product.

    With `quantity` of this one alone, else of all that have none of their own.
    """
    return Row(
        f"{quantity}_{QUALITY_FLAG}" if quantity else QUALITY_FLAG,
        f"quality bits of {quantity or 'the value'}, one for each failed test",
        coverage=Coverage.QUALITY,
        dtype="i4",
        standard_name="quality_flag",
        flags=flags,
        **more,
    )


def per_profile(name: str, long_name: str, comment: str | None = None, **more: Any) -> Row:
    """Return the row of a number of each profile, besides its values."""
    row = Row(name, long_name, comment, dims=("time",), coverage=Coverage.AUXILIARY)
    return replace(row, **more)


def count(name: str, long_name: str, **more: Any) -> Row:
    """Return the row of a number of things in a profile, such as of those in a mean."""
    number = {"dtype": "i4", "standard_name": "number_of_observations", "valid_min": 0.0}
    return per_profile(name, long_name, **{**number, **more})


def shots(*, of: str) -> Row:
    """Return the row of the number of laser shots."""
    return count("shots", f"number of laser shots of {of}", cell_methods="time: sum")


def coded(name: str, long_name: str, states: tuple[str, ...], comment: str) -> Row:
    """Return the row of a number that stands for one of several states of the whole product."""
    return per_profile(name, long_name, comment, dims=(), dtype="i1", states=states)


def retrieval_method(states: tuple[str, ...], comment: str) -> Row:
    """Return the row of the method by which a product was retrieved."""
    return coded("retrieval_method", "method of the retrieval", states, comment)


MOLECULAR_SOURCE: Final = coded(
    "atmospheric_molecular_calculation_source",
    "data source of the atmospheric molecular calculations",
    ("US_standard_atmosphere", "radiosounding", "ecmwf", "icon-iglo-12-23", "gdas"),
    "As in files of EARLINET. radiosounding: also any file that molecular_profile names."
    " icon-iglo-12-23: any run of ICON. provenance names the files.",
)
_SOURCES: Final = "Age and distance are missing where no source of the campaign gives the air."
MOLECULES: Final = (
    MOLECULAR_SOURCE,
    *(
        per_profile(f"molecular_{name}", words, _SOURCES, dims=(), units=units)
        for name, words, units in (
            ("profile_age", "time from the middle of the scene to the nearest profile of air", "s"),
            ("profile_distance", "distance of the farthest profile of air from the station", "m"),
            ("density_relative_error", "relative standard error of the density of molecules", "1"),
        )
    ),
)
"""Variables of the air of a scene."""
BACKGROUND_METHOD: Final = coded(
    "background_method",
    "method by which the background is estimated",
    ("tail_mean", "cubic", "known_shape", "before_pulse"),
    "before_pulse: mean of the bins of the record before the pulse. tail_mean: mean of the far"
    " range. cubic: from the cubic of a homogeneous section."
    " known_shape: fitted to the far range with the shape of the signal of clean air; the mean of"
    " the far range where the fit fails. Haze that falls with height nearly as air does leaves no"
    " trace in that fit: backgrounds in simulated haze with a scale height of 3 km deviate by more"
    f" than 4 standard errors. {MEASURED_SHARES}",
)
SUBTRACTED_BACKGROUND: Final = Row(
    "background",
    "subtracted background: sky light, dark current and offset",
    "Not calibrated. Missing where a glued signal is analog alone, less its unknown offset.",
    dims=("time",),
    units="{signal}",
    ancillaries=("shots",),
    uncertain=True,
)
"""Background that was subtracted from the signal of a channel."""

ENDS: Final = (("bottom", "begins"), ("top", "ends"))
GLUING: Final = (
    per_profile(
        "glue_lag",
        "lag of the analog record behind the photon-counting record in range bins",
        "The analog signal is shifted by this lag before gluing. The standard error is missing"
        " where the lag is not estimated from the noise common to both records, or where their"
        " correlation is not significant.",
        optional=True,
        uncertain=True,
    ),
    per_profile(
        "glue_slope",
        "slope of the photon-counting rate over the analog signal in the gluing window",
        "Of analog alone that of the scene. Missing where none is known or used.",
        units="MHz mV-1",
        optional=True,
        uncertain=True,
    ),
    *(
        per_profile(
            f"glue_{end}",
            f"range at which the gluing window {verb}",
            "The glued signal is analog at shorter and photon counting at longer ranges. Both ends"
            " are that of the bins for analog alone, and 0 for photon counting alone.",
            units="m",
            optional=True,
        )
        for end, verb in ENDS
    ),
)
"""Variables of a channel that is glued from an analog and a photon-counting one."""

_SYSTEMATIC: Final = ("dead_time_error", "baseline_error")
"""Of the signal; those of other causes are limits, or part of the standard error."""


def whole_error(rows: Mapping[Any, Any], name: str) -> Any:
    """Return the standard error of a variable with its errors by dead time and baseline."""
    square = rows[f"{name}_standard_error"] ** 2
    for cause in _SYSTEMATIC:
        if f"{name}_{cause}" in rows:
            square = square + np.nan_to_num(rows[f"{name}_{cause}"]) ** 2
    return square**0.5

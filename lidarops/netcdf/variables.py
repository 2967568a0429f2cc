"""Describe the variables of a product: one `Row` a variable, one `Layout` a kind of product.

The CF and ACDD attributes of a variable follow from its row, and the row of a standard error from
that of its quantity. `lidarops/products/KIND/variables.py` holds the rows of a kind, where a
variable gets its CF standard name, long name and comment; this module holds what all kinds share.
Standard names are those of the CF table v93. A quantity without an entry there has no standard
name, because none is better than a wrong one (`cf111`, section 3.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntFlag, StrEnum
from functools import cache, cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lidarops import __version__
from lidarops.errors import LidarOpsError, ProductError
from lidarops.flags import Flags, Severity
from lidarops.kinds import flags_of, kind_of, kinds
from lidarops.records import DetectionMode
from lidarops.retrieve.air.reference_window import Rejection

CONVENTIONS: Final = "CF-1.11, ACDD-1.3"
STANDARD_NAME_TABLE: Final = "CF Standard Name Table v93"
FILL_VALUE: Final = np.float32(9.969209968386869e36)
"""The netCDF default fill value of floats, on float data only."""
TIME_UNITS: Final = "seconds since 1970-01-01 00:00:00"
"""All files share one epoch, so that tools that do not decode time can join them."""
BOUNDS_DIM: Final = "nv"

_SIGNAL_UNITS: Final = {DetectionMode.ANALOG: "mV", DetectionMode.PHOTON: "MHz"}
_ERROR_BITS: Final = 8
"""Significant bits of the standard error of a rounded quantity: 0.2 percent at worst."""
NO_STANDARD_NAME: Final = f"The {STANDARD_NAME_TABLE} has no name for this quantity."
MEASURED_SHARES: Final = (
    "The results in the documentation state the share of such values in simulated scenes."
)
AEROSOL_EXTINCTION: Final = (
    "volume_extinction_coefficient_of_radiative_flux_in_air_due_to_ambient_aerosol_particles"
)
AEROSOL_BACKSCATTER: Final = (
    "volume_backwards_scattering_coefficient_of_radiative_flux_by_ranging_instrument_in_air_due_to"
    "_ambient_aerosol_particles"
)
AEROSOL_LIDAR_RATIO: Final = (
    "ratio_of_volume_extinction_coefficient_to_volume_backwards_scattering_coefficient_by_ranging"
    "_instrument_in_air_due_to_ambient_aerosol_particles"
)
"""Standard names of what several kinds retrieve."""

QUALITY_FLAG: Final = "quality_flag"
USABLE: Final = "usable"
FLAG_LAYOUT: Final = "lidarops_flag_layout"
"""Attribute of ``quality_flag`` with the name of the places of its bits (`Flags.layout`)."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Description of one variable of a product."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    """numpy type code as stored; ``S1`` for text."""
    long_name: str
    coverage: Coverage
    units: str | None = None
    """``{signal}`` stands for mV in analog detection and MHz in photon counting."""
    standard_name: str | None = None
    axis: str | None = None
    positive: str | None = None
    bounds: str | None = None
    """Name of the variable with the cell bounds; it has one more dimension and no attributes."""
    cell_methods: str | None = None
    valid_min: float | None = None
    valid_max: float | None = None
    ancillaries: tuple[str, ...] = ()
    significant_bits: int | None = None
    """Bits of the mantissa that are stored; None stores all."""
    uncertain: bool = False
    """Whether the product also holds ``<name>_standard_error``."""
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
    summary: bool = False
    """Whether it is `usable`, which is computed from the flags and never passed in."""
    error_kind: ErrorKind | None = None
    """Kind of the error that the variable holds, or else of the variable's standard error."""
    budget: ErrorBudget | None = None
    """How the standard error averages over time. None: by its kind, which is independent between
    profiles if random, else shared by all."""
    lower_end: str | None = None
    """Variable with the lower end of the interval that the systematic error follows from. The
    quantity is the reciprocal of one with the relative random and systematic errors r and s; the
    value divided by the lower end is 1 + sqrt(r^2 + s^2)."""
    cf_role: str | None = None
    algorithm: str | None = None
    comment: str | None = None

    def code(self, state: str) -> int:
        """Return the number by which a variable with `states` holds one of them."""
        return self.states.index(state)

    def standard_error(self) -> Row:
        """Return the row of this quantity's standard error."""
        return replace(
            self,
            name=f"{self.name}_standard_error",
            long_name=f"standard error of {self.long_name}",
            coverage=Coverage.QUALITY,
            standard_name=self.standard_name and f"{self.standard_name} standard_error",
            cell_methods=None,
            valid_min=0.0,
            valid_max=None,
            ancillaries=(),
            significant_bits=self.significant_bits and _ERROR_BITS,
            uncertain=False,
            error_kind=self.error_kind or ErrorKind.RANDOM,
            budget=None,
            lower_end=None,
            comment=None if self.standard_name else NO_STANDARD_NAME,
        )


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Variables and global texts of one kind of product."""

    title: str
    summary: str
    keywords: tuple[str, ...]
    processing_level: str
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
        """Data rows, each followed by its derived rows: standard error, summary of flags."""
        return tuple(_with_derived(self.data))

    @property
    def flags(self) -> Flags:
        """Bits that ``quality_flag`` can carry.

        Raises
        ------
        ProductError
            If its row states none.
        """
        flags = self.row(QUALITY_FLAG).flags
        if flags is None:
            raise ProductError("states no flags", field=QUALITY_FLAG, remedy="use `quality`")
        return flags

    @property
    def rounded(self) -> bool:
        """Whether any variable is stored with a shortened mantissa."""
        return any(row.significant_bits for row in self.variables)

    @cached_property
    def _rows(self) -> dict[str, Row]:
        return {row.name: row for row in (*self.coordinates, *self.variables)}

    def row(self, name: str) -> Row:
        """Return the row of a variable or coordinate.

        Raises
        ------
        ProductError
            If the layout has no such variable.
        """
        if name not in self._rows:
            raise ProductError(
                "is not a variable of this kind of product",
                field=name,
                remedy=f"its variables are {', '.join(self._rows)}",
            )
        return self._rows[name]


@cache
def layout_of(kind: str) -> Layout:
    """Return the layout of a kind of product, by the name of the kind.

    Raises
    ------
    LidarOpsError
        If there is no such kind, or its ``variables`` and ``flags`` state different bits.
    """
    layout: Layout = kind_of(kind).part("variables", "LAYOUT")
    if layout.flags != flags_of(kind):
        package = kind_of(kind).package
        raise LidarOpsError(
            f"kind of product {kind!r}: quality_flag has the bits {layout.flags.layout!r}, not"
            f" those of {package}.flags",
            remedy=f"write quality(dims, FLAGS) in {package}.variables",
        )
    return layout


def is_retrieved(kind: str) -> bool:
    """Return whether a kind of product holds retrieved quantities, not signals.

    An unknown kind is taken to be retrieved.
    """
    return kind not in kinds() or not layout_of(kind).processing_level.startswith("L1")


def _with_derived(rows: tuple[Row, ...]) -> Iterator[Row]:
    for row in rows:
        ancillaries = tuple(_with_summary(row.ancillaries))
        if row.uncertain:
            error = row.standard_error()
            yield replace(row, ancillaries=(error.name, *ancillaries))
            yield error
        else:
            yield replace(row, ancillaries=ancillaries)
        if row.flags is not None:
            yield usable(row)


def _with_summary(names: tuple[str, ...]) -> Iterator[str]:
    for name in names:
        yield name
        if name == QUALITY_FLAG:
            yield USABLE


def usable(flags: Row) -> Row:
    """Return the row of ``usable``, which summarizes the bits of ``quality_flag``."""
    return Row(
        name=USABLE,
        dims=flags.dims,
        dtype="i1",
        units="1",
        standard_name="aggregate_quality_flag",
        long_name="usability of the value, from the bits of quality_flag",
        coverage=Coverage.QUALITY,
        summary=True,
        comment="do_not_use: quality_flag has a bit of severity reject. use_with_care: it has bits"
        " of severity care only. good: no test failed. The comment of quality_flag states the"
        " severity of each bit.",
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
    limit = stored.type if stored.kind in "if" else None
    attrs: dict[str, Any] = {
        "standard_name": row.standard_name,
        "long_name": row.long_name,
        "units": units(row, mode),
        "axis": row.axis,
        "positive": row.positive,
        "bounds": row.bounds,
        "cell_methods": row.cell_methods,
        "valid_min": None if row.valid_min is None or limit is None else limit(row.valid_min),
        "valid_max": None if row.valid_max is None or limit is None else limit(row.valid_max),
        "coverage_content_type": row.coverage.value,
        "ancillary_variables": " ".join(row.ancillaries) or None,
        "coordinates": " ".join(coordinates) or None,
        "cf_role": row.cf_role,
        "algorithm": row.algorithm,
        "implementation": row.algorithm and f"lidarops {__version__} (numpy)",
        "_FillValue": FILL_VALUE if _has_fill(row) else None,
        "_Encoding": "utf-8" if stored.kind == "S" else None,
    }
    if row.significant_bits is not None:
        attrs["quantization"] = QUANTIZATION.name
        attrs["quantization_nsb"] = np.int32(row.significant_bits)
    if row.error_kind is not None and not row.uncertain:
        attrs["error_kind"] = row.error_kind.value
    if row.summary:
        attrs["flag_values"] = np.array([0, *Severity], dtype=stored)
        attrs["flag_meanings"] = "good use_with_care do_not_use"
    if row.flags is not None:
        attrs |= _flag_attributes(row.flags, stored)
    if row.reasons is not None:
        attrs["flag_masks"] = np.array([int(reason) for reason in row.reasons], dtype=stored)
        attrs["flag_meanings"] = " ".join(str(reason.name).lower() for reason in row.reasons)
    if row.states:
        attrs["flag_values"] = np.arange(len(row.states), dtype=stored)
        attrs["flag_meanings"] = " ".join(row.states)
    attrs["comment"] = (
        " ".join(text for text in (attrs.get("comment"), row.comment) if text) or None
    )
    return {key: value for key, value in attrs.items() if value is not None}


def units(row: Row, mode: DetectionMode) -> str | None:
    """Return the unit of a variable in a channel of the given mode."""
    return row.units and row.units.format(signal=_SIGNAL_UNITS[mode])


def _has_fill(row: Row) -> bool:
    return np.dtype(row.dtype).kind == "f" and row.coverage is not Coverage.COORDINATE


def _flag_attributes(flags: Flags, stored: np.dtype[Any]) -> dict[str, Any]:
    return {
        FLAG_LAYOUT: flags.layout,
        "flag_masks": np.array([int(bit) for bit in flags], dtype=stored),
        "flag_meanings": " ".join(bit.word for bit in flags),
        "comment": "0: no test failed. "
        + "; ".join(f"{bit.word} ({bit.severity.name.lower()}): {bit.description}" for bit in flags)
        + ". reject: do not use the value; care: the value is valid, but its stated uncertainty"
        " may be too small, or as large as the value.",
    }


TIME = Row(
    name="time",
    dims=("time",),
    dtype="f8",
    units=TIME_UNITS,
    standard_name="time",
    long_name="midpoint of the averaging interval, UTC",
    coverage=Coverage.COORDINATE,
    axis="T",
    bounds="time_bnds",
)
RANGE = Row(
    name="range",
    dims=("range",),
    dtype="f8",
    units="m",
    long_name="distance from the lidar along the beam, centre of the range bin",
    coverage=Coverage.COORDINATE,
    bounds="range_bnds",
)
SECTION = Row(
    name="section",
    dims=("section",),
    dtype="i4",
    units="1",
    long_name="number of the range section",
    coverage=Coverage.COORDINATE,
)
SECTION_RANGE = Row(
    name="section_range",
    dims=("section",),
    dtype="f8",
    units="m",
    long_name="distance from the lidar along the beam, midpoint of the range section",
    coverage=Coverage.COORDINATE,
    bounds="section_bounds",
)


def altitude(along: str, bounds: str | None = None) -> Row:
    """Return the row of the altitude of values along a dimension."""
    return Row(
        name="altitude",
        dims=(along,),
        dtype="f4",
        units="m",
        standard_name="altitude",
        long_name="altitude of the sounded air above the geoid",
        coverage=Coverage.COORDINATE,
        axis="Z",
        positive="up",
        bounds=bounds,
        follows_beam=True,
        comment="Station altitude + range x cos(zenith angle), for a straight beam over a flat"
        " Earth. Curvature of the Earth adds (range x sin(zenith angle))^2 / 12742 km.",
    )


PLACE = (
    Row(
        name="zenith_angle",
        dims=(),
        dtype="f8",
        units="degree",
        standard_name="zenith_angle",
        long_name="zenith angle of the beam, 0 = up",
        coverage=Coverage.COORDINATE,
        valid_min=0.0,
        valid_max=180.0,
        follows_beam=True,
    ),
    Row(
        name="azimuth",
        dims=(),
        dtype="f8",
        units="degree",
        standard_name="direction_of_radial_vector_away_from_instrument",
        long_name="azimuth of the beam, clockwise from north",
        coverage=Coverage.COORDINATE,
        follows_beam=True,
    ),
    Row(
        name="latitude",
        dims=(),
        dtype="f8",
        units="degrees_north",
        standard_name="latitude",
        long_name="latitude of the station",
        coverage=Coverage.COORDINATE,
        valid_min=-90.0,
        valid_max=90.0,
    ),
    Row(
        name="longitude",
        dims=(),
        dtype="f8",
        units="degrees_east",
        standard_name="longitude",
        long_name="longitude of the station",
        coverage=Coverage.COORDINATE,
        valid_min=-180.0,
        valid_max=180.0,
    ),
    Row(
        name="station_altitude",
        dims=(),
        dtype="f8",
        units="m",
        standard_name="surface_altitude",
        long_name="altitude of the station above the geoid",
        coverage=Coverage.COORDINATE,
    ),
    Row(
        name="wavelength",
        dims=(),
        dtype="f8",
        units="nm",
        standard_name="radiation_wavelength",
        long_name="wavelength of the channel",
        coverage=Coverage.COORDINATE,
        valid_min=0.0,
    ),
)
SOUNDED = tuple(
    Row(
        name=f"bin_{name}",
        dims=(),
        dtype="f4",
        units=units,
        standard_name=name,
        long_name=f"{name} of the sounded air",
        coverage=Coverage.COORDINATE,
        valid_min=-limit,
        valid_max=limit,
        follows_beam=True,
        comment="For a straight beam, on the WGS 84 ellipsoid.",
    )
    for name, units, limit in (
        ("latitude", "degrees_north", 90.0),
        ("longitude", "degrees_east", 180.0),
    )
)
"""Position of the sounded air along a slant beam of known azimuth; `coordinates` sets `dims`."""


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


_STATION = Row(
    name="station",
    dims=("station_strlen",),
    dtype="S1",
    standard_name="platform_name",
    long_name="name of the station, or of the network of lidars",
    coverage=Coverage.REFERENCE,
)
QUANTIZATION: Final = Row(
    name="quantization_info",
    dims=(),
    dtype="i4",
    long_name="rounding of values to fewer significant bits",
    coverage=Coverage.REFERENCE,
    algorithm="bitround",
)
"""Container variable of CF-1.12, section 8.4; its value has no meaning."""
PROVENANCE: Final = Row(
    name="provenance",
    dims=("provenance_strlen",),
    dtype="S1",
    long_name="inputs, plan, settings and software of this product as W3C PROV-JSON",
    coverage=Coverage.REFERENCE,
)


SUBTRACTED_BACKGROUND: Final = Row(
    name="background",
    dims=("time",),
    dtype="f4",
    units="{signal}",
    long_name="subtracted background: sky light, dark current and offset",
    coverage=Coverage.PHYSICAL,
    cell_methods="time: mean",
    ancillaries=("shots",),
    uncertain=True,
    comment="Not calibrated. Missing where a glued signal is analog alone, less its unknown offset."
    f" {NO_STANDARD_NAME}",
)
"""Background that was subtracted from the signal of a channel."""

GLUING: Final = (
    Row(
        name="glue_lag",
        dims=("time",),
        dtype="f4",
        units="1",
        long_name="lag of the analog record behind the photon-counting record in range bins",
        coverage=Coverage.AUXILIARY,
        optional=True,
        uncertain=True,
        comment="The analog signal is shifted by this lag before gluing. The standard error is"
        " missing where the lag is not estimated from the noise common to both records, or where"
        f" their correlation is not significant. {NO_STANDARD_NAME}",
    ),
    Row(
        name="glue_slope",
        dims=("time",),
        dtype="f4",
        units="MHz mV-1",
        long_name="slope of the photon-counting rate over the analog signal in the gluing window",
        coverage=Coverage.AUXILIARY,
        optional=True,
        uncertain=True,
        comment="Of analog alone that of the scene. Missing where none is known or used."
        f" {NO_STANDARD_NAME}",
    ),
    *(
        Row(
            name=f"glue_{end}",
            dims=("time",),
            dtype="f4",
            units="m",
            long_name=f"range at which the gluing window {verb}",
            coverage=Coverage.AUXILIARY,
            optional=True,
            comment="The glued signal is analog at shorter and photon counting at longer ranges."
            " Both ends are that of the bins for analog alone, and 0 for photon counting alone."
            f" {NO_STANDARD_NAME}",
        )
        for end, verb in (("bottom", "begins"), ("top", "ends"))
    ),
)
"""Variables of a channel that is glued from an analog and a photon-counting one."""


MOLECULAR_BACKSCATTER: Final = Row(
    name="molecular_backscatter",
    dims=("range",),
    dtype="f4",
    units="m-1 sr-1",
    long_name="backscatter coefficient of molecules",
    coverage=Coverage.REFERENCE,
    comment=f"Rayleigh scattering including rotational Raman lines. {NO_STANDARD_NAME}",
)

REFERENCE_WINDOW: Final = (
    *(
        Row(
            name=f"reference_{end}{ending}",
            dims=("time",),
            dtype="f4",
            units="m",
            long_name=f"{place} at which the reference window {verb}",
            coverage=Coverage.AUXILIARY,
            comment=f"Missing where no window passed the tests. {NO_STANDARD_NAME}",
        )
        for ending, place in (("", "range"), ("_altitude", "altitude above the geoid"))
        for end, verb in (("bottom", "begins"), ("top", "ends"))
    ),
    Row(
        name="reference_scattering_ratio",
        dims=(),
        dtype="f4",
        units="1",
        long_name="assumed ratio of backscatter of particles and molecules to that of molecules in"
        " the reference window",
        coverage=Coverage.REFERENCE,
        uncertain=True,
        error_kind=ErrorKind.SYSTEMATIC,
        comment="Set by the campaign, as its standard error is: the value by which profiles are"
        f" calibrated. {NO_STANDARD_NAME}",
    ),
    Row(
        name="reference_detection_limit",
        dims=("time",),
        dtype="f4",
        units="1",
        long_name="least ratio of backscatter of particles to that of molecules that is"
        " detected in the reference window with a probability of 0.95",
        coverage=Coverage.AUXILIARY,
        comment="By comparison with other windows. Fewer particles may remain undetected:"
        " aerosol_backscatter_error_reference includes the noise of this comparison, and the ratio"
        " of the window to air in excess of the lowest ratio. Missing where no window passed the"
        f" tests, or none beside it is comparable. {NO_STANDARD_NAME}",
    ),
)
"""Where a profile was compared with clean air, and how clean the air is taken to be."""


def _coded(name: str, long_name: str, states: tuple[str, ...], comment: str) -> Row:
    """Return the row of a number that stands for one of several states of the whole product."""
    return Row(
        name=name,
        dims=(),
        dtype="i1",
        units="1",
        long_name=long_name,
        coverage=Coverage.AUXILIARY,
        states=states,
        comment=f"{comment} {NO_STANDARD_NAME}",
    )


MOLECULAR_SOURCE: Final = _coded(
    "molecular_source",
    "source of pressure and temperature of the molecular atmosphere",
    ("standard_atmosphere", "sounding"),
    "standard_atmosphere: US Standard Atmosphere 1976. sounding: the file of a sounding or model"
    " that the campaign gives; provenance names it.",
)

BACKGROUND_METHOD: Final = _coded(
    "background_method",
    "method by which the background is estimated",
    ("tail_mean", "cubic", "known_shape"),
    "tail_mean: mean of the far range. cubic: from the cubic of a homogeneous section."
    " known_shape: fitted to the far range with the shape of the signal of clean air; the mean of"
    " the far range where the fit fails. Haze that falls with height nearly as air does leaves no"
    " trace in that fit: backgrounds in simulated haze with a scale height of 3 km deviate by more"
    f" than 4 standard errors. {MEASURED_SHARES}",
)

AVERAGED_PROFILES: Final = Row(
    name="profiles",
    dims=("time",),
    dtype="i4",
    units="1",
    standard_name="number_of_observations",
    long_name="number of raw profiles in the mean",
    coverage=Coverage.AUXILIARY,
    cell_methods="time: sum",
    valid_min=0.0,
)

LEFT_OUT_PROFILES: Final = Row(
    name="profiles_left_out",
    dims=("time",),
    dtype="i4",
    units="1",
    standard_name="number_of_observations",
    long_name="number of raw profiles that are left out of the mean as outlying",
    coverage=Coverage.AUXILIARY,
    cell_methods="time: sum",
    valid_min=0.0,
    comment="Profiles are left out where their signal, in any channel, exceeds that of all others"
    " of the interval at some range by more than the contrast of a cloud and noise allow, or lies"
    " below zero unlike that of all others, if they are at most a fifth of the interval: a"
    " short cloud, a bird, an aircraft, interference.",
)


def retrieval_method(states: tuple[str, ...], comment: str) -> Row:
    """Return the row of the method by which a product was retrieved."""
    return _coded("retrieval_method", "method of the retrieval", states, comment)


def reference_rejections(comment: str) -> Row:
    """Return the row of the reasons for which candidates of the reference window failed."""
    return Row(
        name="reference_rejections",
        dims=("time",),
        dtype="i4",
        units="1",
        standard_name="status_flag",
        long_name="reasons for which candidates of the reference window were rejected",
        coverage=Coverage.AUXILIARY,
        reasons=Rejection,
        comment="Of all candidates together; where none passed, no_reference is raised in"
        f" quality_flag. {comment}",
    )


def shots(*, of: str) -> Row:
    """Return the row of the number of laser shots."""
    return Row(
        name="shots",
        dims=("time",),
        dtype="i4",
        units="1",
        standard_name="number_of_observations",
        long_name=f"number of laser shots of {of}",
        coverage=Coverage.AUXILIARY,
        cell_methods="time: sum",
        valid_min=0.0,
    )


def quality(dims: tuple[str, ...], flags: Flags) -> Row:
    """Return the row of the quality bits of a kind of product."""
    return Row(
        name=QUALITY_FLAG,
        dims=dims,
        dtype="i4",
        units="1",
        standard_name="quality_flag",
        long_name="quality bits of the value, one for each failed test",
        coverage=Coverage.QUALITY,
        flags=flags,
    )


def coordinates(along: tuple[Row, ...], altitude: Row) -> tuple[Row, ...]:
    """Return the coordinates of a kind of product: time, along the beam, position."""
    sounded = (replace(row, dims=altitude.dims) for row in SOUNDED)
    return (TIME, *along, altitude, *sounded, *PLACE)


def station(*, profiles: bool) -> Row:
    """Return the row of the station's name; with `profiles` it identifies the time series."""
    return replace(_STATION, cf_role="timeseries_id") if profiles else _STATION


_SYSTEMATIC: Final = ("dead_time_error", "baseline_error")
"""Of the signal; those of other causes are limits, or part of the standard error."""


def whole_error(rows: Mapping[Any, Any], name: str) -> Any:
    """Return the standard error of a variable with its errors by dead time and baseline."""
    square = rows[f"{name}_standard_error"] ** 2
    for cause in _SYSTEMATIC:
        if f"{name}_{cause}" in rows:
            square = square + np.nan_to_num(rows[f"{name}_{cause}"]) ** 2
    return square**0.5

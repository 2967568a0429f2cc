"""The variables of the ``visibility`` product."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from lidarops.flags import Quality
from lidarops.netcdf.variables import (
    NO_NAME,
    PLACE,
    TIME,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    deployment,
    quality,
    shots,
)
from lidarops.products.visibility_variables import visibility

_SERIES: Final = ("time", "crossing")
_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""

FLAGS: Final = (
    Quality.INPUT_MISSING
    | Quality.PILE_UP
    | Quality.LOW_SIGNAL
    | Quality.POORLY_DETERMINED
    | Quality.POOR_FIT
    | Quality.NOT_HOMOGENEOUS
    | Quality.OUTLIER
    | Quality.NO_REAL_SOLUTION
    | Quality.BACKGROUND_UNCERTAIN
    | Quality.UNSTABLE_INVERSION
    | Quality.PRIOR_DOMINATED
    | Quality.EXTRAPOLATED
    | Quality.LOW_LEVERAGE
)

_OF_VALUE: Final = ("condition", "quality_flag", "optical_depth", "reduced_chi2", "shots")


def _place(name: str) -> Row:
    return next(row for row in PLACE if row.name == name)


def _of_crossing(name: str) -> Row:
    """Return the row of where the crossings lie, in place of where a station stands."""
    row = _place(name)
    return replace(row, dims=("crossing",), long_name=f"{name} of the point where beams meet")


def _of_beam(name: str, source: str, called: str) -> Row:
    row = _place(source)
    if name in ("latitude", "longitude"):
        # As of a station whose values lie elsewhere: one latitude is that of the values.
        row = replace(deployment(row), comment=None)
    return replace(
        row,
        name=f"beam_{name}",
        dims=("beam",),
        long_name=called,
        follows_beam=False,
        coverage=Coverage.REFERENCE,
    )


_ALTITUDE: Final = Row(
    name="altitude",
    dims=("crossing",),
    dtype="f8",
    units="m",
    standard_name="altitude",
    long_name="altitude of the point where beams meet, above the geoid",
    coverage=Coverage.COORDINATE,
    axis="Z",
    positive="up",
    comment="Beams are straight, on the WGS 84 ellipsoid, of which the geoid is taken for a"
    " parallel.",
)
_CROSSING: Final = Row(
    name="crossing_id",
    dims=("crossing",),
    dtype="i4",
    units="1",
    long_name="number of the point in the network of beams",
    coverage=Coverage.COORDINATE,
    cf_role="timeseries_id",
    comment="In order of the nearest range. Points that are the farthest on all of their beams"
    " have a number too, but no value: nothing tells the attenuation beyond them.",
)
_BEAM: Final = Row(
    name="beam",
    dims=("beam",),
    dtype="i4",
    units="1",
    long_name="number of the beam",
    coverage=Coverage.COORDINATE,
    comment="lidarops_steps names the instrument of each beam, and the points that lie on it.",
)


def _per_time(name: str, called: str, comment: str) -> Row:
    return Row(
        name=name,
        dims=("time",),
        dtype="f4",
        units="1",
        long_name=called,
        coverage=Coverage.QUALITY,
        valid_min=0.0,
        significant_bits=8,
        comment=f"{comment} {NO_NAME}",
    )


VISIBILITY: Final = Layout(
    title="Visibility and extinction where beams of several lidars meet",
    summary="Extinction of air and aerosol together, and visibility, at the points where the beams"
    " of several lidars meet, without calibration, lidar ratio or reference, with standard errors.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AIR QUALITY > VISIBILITY",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Drabenko, V. A. et al. (2021): Multi-position sensing of visibility.",
        "Yegorov, A. D. et al. (2008): Multi-position lidar sounding of the atmosphere.",
        "Koschmieder, H. (1924), Beitr. Phys. freien Atmos. 12, 33-53.",
    ),
    comment="Model: along a beam, a = (P r^2 / overlap)^m is proportional to extinction times"
    " exp(-2 m optical depth), with m the exponent of backscatter ~ extinction^(1/m); where two"
    " beams meet, both see the same extinction. Signals were averaged before they were solved."
    " Stations stand where beam_latitude, beam_longitude and beam_altitude say. A gradient over the"
    " whole network looks like attenuation where air is thin or noise is high, and no test tells"
    " it there: extinction_standard_error counts with twice the gradient that is typical, and"
    " with a bend where the mean of a block's profiles allows it. In simulated random networks"
    " 0.01(1) percent of the values that no flag rejects were off by more than 4 standard errors,"
    " 0.005(3) in plumes that drift within a block. More profiles in a block and more beams tell"
    " more. All profiles share what the prior allows, so"
    " that a mean over time does not make it smaller.",
    sampled="crossing",
    feature_type="timeSeries",
    unused_steps=frozenset({"molecular", "known_shape", "reference"}),
    coordinates=(
        TIME,
        _CROSSING,
        _of_crossing("latitude"),
        _of_crossing("longitude"),
        _ALTITUDE,
        _BEAM,
        _of_beam("latitude", "latitude", "latitude of the lidar of the beam"),
        _of_beam("longitude", "longitude", "longitude of the lidar of the beam"),
        _of_beam(
            "altitude", "station_altitude", "altitude of the lidar of the beam above the geoid"
        ),
        _of_beam("zenith_angle", "zenith_angle", "zenith angle of the beam, 0 = up"),
        _of_beam("azimuth", "azimuth", "azimuth of the beam, clockwise from north"),
        _place("wavelength"),
    ),
    data=(
        *(
            # What the prior allows is most of the error, and the same for all profiles.
            replace(row, error_kind=ErrorKind.BOTH) if row.uncertain else row
            for row in visibility(
                _SERIES,
                called="at the point where beams meet",
                ancillaries=("extinction_systematic_error", *_OF_VALUE),
                optional=False,
            )
        ),
        Row(
            name="extinction",
            dims=_SERIES,
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of air and aerosol together",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("extinction_systematic_error", *_OF_VALUE),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            comment="Molecules and particles together, at the wavelength of the channel."
            f" {NO_NAME}",
        ),
        Row(
            name="extinction_systematic_error",
            dims=_SERIES,
            dtype="f4",
            units="m-1",
            long_name="systematic error of the extinction coefficient to allow for",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            significant_bits=8,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Apart from extinction_standard_error, of noise and prior: what the errors of"
            " exponent, lidar ratio and overlap that the settings declare would do, and the signal"
            f" that may be left in the background. {NO_NAME}",
        ),
        Row(
            name="condition",
            dims=_SERIES,
            dtype="f4",
            units="1",
            long_name="relative change of extinction over that of signals at near ends of beams",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            significant_bits=8,
            comment="Root of the sum of squares over beams. The more, the more an error of the"
            f" overlap counts. {NO_NAME}",
        ),
        replace(
            quality(_SERIES, FLAGS),
            comment="In this kind of product poorly_determined means a standard error above a third"
            " of extinction, of the value or as the median of its block, before the doubt in the"
            " prior is added, or beams too few to tell a field that is not as the prior has it;"
            " low_leverage a beam that is too weak, or of a variance of zero, to be used beside"
            " the others; poor_fit beams that disagree by more than"
            " their noise allows, or a beam that ends before the point at bins that lie off their"
            " neighbours; outlier a beam with bins that lie more than 6 standard errors off their"
            " neighbours: these took the place of single ones, while several together, which may be"
            " the edges of a layer, were left, and what they and the bins between two edges change"
            " is part of the standard error. The value stands.",
        ),
        _per_time(
            "optical_depth",
            "optical depth of the longest stretch between points of a beam",
            "Of the mean extinction at the points.",
        ),
        _per_time(
            "reduced_chi2",
            "reduced chi-square of the network",
            "Of the beams alone, free of the prior. Missing for methods that see one cycle, and"
            " where nothing is left over.",
        ),
        _per_time(
            "degrees_of_freedom",
            "equations of the network beyond its unknowns",
            "Missing for methods that see one cycle, and where unknowns are more than equations.",
        ),
        _per_time(
            "prior_deviation",
            "standard deviation of ln extinction about the mean field, told beforehand",
            "Found as the likeliest of the block of profiles. Missing where nothing is told.",
        ),
        Row(
            name="beam_range",
            dims=("beam", "crossing"),
            dtype="f4",
            units="m",
            long_name="distance of the point from the lidar along the beam",
            coverage=Coverage.REFERENCE,
            valid_min=0.0,
            comment=f"Missing where the point does not lie on the beam. {NO_NAME}",
        ),
        shots(of="all beams of the interval"),
    ),
)

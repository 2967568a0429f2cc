"""The variables of the ``visibility`` product."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from lidarops.constants import MULTIPOSITION_PAPER
from lidarops.netcdf.variables import (
    MEASURED_SHARES,
    NO_STANDARD_NAME,
    PLACE,
    TIME,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    deployment,
    quality,
    retrieval_method,
    shots,
)
from lidarops.netcdf.visibility_rows import visibility_rows
from lidarops.products.visibility.flags import FLAGS

_SERIES: Final = ("time", "crossing")
_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""

_METHODS: Final = ("beams_with_prior", "beams_without_prior", "triangles")
_OF_VALUE: Final = ("condition", "quality_flag", "path_optical_depth", "reduced_chi2", "shots")


def _place(name: str) -> Row:
    return next(row for row in PLACE if row.name == name)


def _crossing_position(name: str) -> Row:
    """Return the row of the latitude or longitude of the crossings."""
    return replace(_place(name), dims=("crossing",), long_name=f"{name} of the crossing of beams")


def _beam_row(name: str, source: str, long_name: str) -> Row:
    """Return the row of a coordinate of the lidars, one value a beam."""
    row = _place(source)
    if name in ("latitude", "longitude"):
        # The latitude of the values is that of the crossings.
        row = replace(deployment(row), comment=None)
    return replace(
        row,
        name=f"beam_{name}",
        dims=("beam",),
        long_name=long_name,
        follows_beam=False,
        coverage=Coverage.REFERENCE,
    )


_ALTITUDE: Final = Row(
    name="altitude",
    dims=("crossing",),
    dtype="f8",
    units="m",
    standard_name="altitude",
    long_name="altitude of the crossing of beams above the geoid",
    coverage=Coverage.COORDINATE,
    axis="Z",
    positive="up",
    comment="For straight beams on the WGS 84 ellipsoid, to which the geoid is taken as parallel.",
)
_CROSSING: Final = Row(
    name="crossing_id",
    dims=("crossing",),
    dtype="i4",
    units="1",
    long_name="number of the crossing in the network of beams",
    coverage=Coverage.COORDINATE,
    cf_role="timeseries_id",
    comment="Ordered by the nearest range. A crossing that is the farthest one on all of its beams"
    " has a number but no value, because nothing constrains the attenuation beyond it.",
)
_BEAM: Final = Row(
    name="beam",
    dims=("beam",),
    dtype="i4",
    units="1",
    long_name="number of the beam",
    coverage=Coverage.COORDINATE,
    comment="lidarops_steps names the instrument of each beam and the crossings on it.",
)


def _time_series(name: str, long_name: str, comment: str) -> Row:
    return Row(
        name=name,
        dims=("time",),
        dtype="f4",
        units="1",
        long_name=long_name,
        coverage=Coverage.QUALITY,
        valid_min=0.0,
        significant_bits=8,
        comment=f"{comment} {NO_STANDARD_NAME}",
    )


LAYOUT: Final = Layout(
    title="Visibility and extinction at crossings of the beams of several lidars",
    summary="Extinction of molecules and particles together, and visibility, at the crossings of"
    " the beams of several lidars, without calibration, lidar ratio or reference value, with"
    " standard errors.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AIR QUALITY > VISIBILITY",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        MULTIPOSITION_PAPER,
        "Yegorov, A. D. et al. (2008), Int. J. Remote Sensing 29, 2449-2468.",
        "Koschmieder, H. (1924), Beitr. Phys. freien Atmos. 12, 33-53.",
    ),
    comment="Model: along a beam, a = (P r^2 / overlap)^m is proportional to extinction times"
    " exp(-2 m optical depth), where m is the exponent in backscatter ~ extinction^(1/m); at a"
    " crossing, both beams see the same extinction. Signals were averaged before the retrieval."
    " beam_latitude, beam_longitude and beam_altitude are the positions of the lidars. A gradient"
    " over the whole network mimics attenuation where the air is optically thin or the noise is"
    " high, and no test detects it there: total_extinction_standard_error allows for twice the"
    " typical gradient. More profiles in a block and more beams constrain the field better. In"
    " blocks of one profile, some simulated values without a flag deviate by more than 4 standard"
    " errors with a plume, or where extinction changes with height by a factor of e in 300 to"
    f" 3000 m: noise hides the field. {MEASURED_SHARES}"
    " The error that the prior leaves is common to all profiles, so that a mean over"
    " time does not reduce it. total_extinction_systematic_error includes a lidar ratio that varies"
    " over the network as declared, by 2 percent if not stated: where it varies by 10 percent"
    " (rms), values without a flag deviate by more than 4 standard errors unless 10 percent are"
    " declared.",
    sampled="crossing",
    feature_type="timeSeries",
    coordinates=(
        TIME,
        _CROSSING,
        _crossing_position("latitude"),
        _crossing_position("longitude"),
        _ALTITUDE,
        _BEAM,
        _beam_row("latitude", "latitude", "latitude of the lidar of the beam"),
        _beam_row("longitude", "longitude", "longitude of the lidar of the beam"),
        _beam_row(
            "altitude", "station_altitude", "altitude of the lidar of the beam above the geoid"
        ),
        _beam_row("zenith_angle", "zenith_angle", "zenith angle of the beam, 0 = up"),
        _beam_row("azimuth", "azimuth", "azimuth of the beam, clockwise from north"),
        _place("wavelength"),
    ),
    data=(
        *(
            # Most of the error comes from the prior, which all profiles share.
            replace(row, error_kind=ErrorKind.BOTH) if row.uncertain else row
            for row in visibility_rows(
                _SERIES,
                place="at the crossing of beams",
                ancillaries=("total_extinction_systematic_error", *_OF_VALUE),
                optional=False,
            )
        ),
        Row(
            name="total_extinction",
            dims=_SERIES,
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of molecules and particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("total_extinction_systematic_error", *_OF_VALUE),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            comment=f"At the wavelength of the channel. {NO_STANDARD_NAME}",
        ),
        Row(
            name="total_extinction_systematic_error",
            dims=_SERIES,
            dtype="f4",
            units="m-1",
            long_name="model (systematic) uncertainty of extinction",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            significant_bits=8,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Separate from total_extinction_standard_error, which covers noise and prior."
            " Effect of the errors of exponent, lidar ratio and overlap declared in the settings,"
            " of signal that may remain in the background, and of the multiplier where one is"
            f" requested. {NO_STANDARD_NAME}",
        ),
        Row(
            name="condition",
            dims=_SERIES,
            dtype="f4",
            units="1",
            long_name="relative change of extinction over that of the signals at the near ends of"
            " the beams",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            significant_bits=8,
            comment="Root of the sum of squares over the beams. Larger values mean higher"
            f" sensitivity to overlap errors. {NO_STANDARD_NAME}",
        ),
        Row(
            name="multiplier",
            dims=_SERIES,
            dtype="f4",
            units="1",
            long_name="multiplier lambda of the equations of a triangle of beams",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
            optional=True,
            comment="Row j of a cycle of three beams is multiplied by its power j - 1. 1 is exact;"
            " a smaller one limits noise, and its bias in homogeneous air is part of"
            f" total_extinction_systematic_error. {NO_STANDARD_NAME}",
        ),
        retrieval_method(
            _METHODS,
            "beams_with_prior: all beams, with a prior that the profiles of a block share."
            " beams_without_prior: all beams alone. triangles: one triangle of beams at each"
            " crossing, with a multiplier.",
        ),
        replace(
            quality(_SERIES, FLAGS),
            comment="In this kind of product, poorly_determined means that the standard error,"
            " without the uncertainty of the prior, exceeds a third of extinction, for the value or"
            " as the median of its block, or that there are too few beams to determine a field that"
            " departs from the prior. low_leverage: a beam is too noisy, or states a variance of"
            " zero, and was left out; the value comes from the other beams. poor_fit: the beams"
            " disagree by more than their noise explains, or a beam ends before the crossing at"
            " bins that deviate from their neighbours. outlier: a beam has bins that deviate by"
            " more than 6 standard errors from their neighbours. Single bins were replaced from"
            " their neighbours. Several adjacent bins, which may be the edges of a layer, were"
            " kept; the effect of these and of the bins between two edges is part of the standard"
            " error. The value is valid.",
        ),
        _time_series(
            "path_optical_depth",
            "optical depth along the longest beam section between crossings",
            "From the mean extinction at the crossings.",
        ),
        _time_series(
            "reduced_chi2",
            "reduced chi-square of the network",
            "From the beams alone, without the prior. Missing without degrees of freedom.",
        ),
        _time_series(
            "degrees_of_freedom",
            "number of equations of the network minus number of unknowns",
            "Missing where unknowns outnumber equations.",
        ),
        _time_series(
            "prior_deviation",
            "prior standard deviation of ln(extinction) about a linear field",
            "Most likely value for the block of profiles. Missing where there is no prior.",
        ),
        Row(
            name="beam_range",
            dims=("beam", "crossing"),
            dtype="f4",
            units="m",
            long_name="distance of the crossing from the lidar along the beam",
            coverage=Coverage.REFERENCE,
            valid_min=0.0,
            comment=f"Missing where the crossing does not lie on the beam. {NO_STANDARD_NAME}",
        ),
        shots(of="all beams of the interval"),
    ),
)

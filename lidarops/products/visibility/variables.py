"""The variables and quality bits of the ``visibility`` product."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from lidarops.constants import MULTIPOSITION_PAPER
from lidarops.flags import Flags, Quality
from lidarops.netcdf.quantities import VALUE_BITS, total_extinction, visibility
from lidarops.netcdf.variables import (
    MEASURED_SHARES,
    TIME,
    Coverage,
    Error,
    ErrorKind,
    Layout,
    Row,
    altitude,
    deployment,
    numbered,
    place,
    quality,
    retrieval_method,
    shots,
)
from lidarops.retrieve.network.flags import NetworkQuality

FLAGS: Final = Flags(
    kind="visibility",
    version=2,
    bits=(
        Quality.INPUT_MISSING,
        Quality.PILE_UP,
        Quality.NO_SIGNAL,
        Quality.LOW_SIGNAL,
        Quality.SINGLE_RECORD,
        Quality.OUTLIER,
        Quality.NO_REAL_SOLUTION,
        Quality.BACKGROUND_UNCERTAIN,
        *NetworkQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

_METHODS: Final = ("beams_with_prior", "beams_without_prior", "triangles")
_OF_VALUE: Final = ("condition", "quality_flag", "path_optical_depth", "reduced_chi2", "shots")


def _crossing(name: str) -> Row:
    """Return the row of the latitude or longitude of the crossings."""
    return place(name, dims=("crossing",), long_name=f"{name} of the crossing of beams")


def _of_beams(row: Row, name: str, long_name: str) -> Row:
    """Return the row of a coordinate of the lidars, one value a beam."""
    return replace(
        row,
        name=f"beam_{name}",
        dims=("beam",),
        long_name=long_name,
        follows_beam=False,
        coverage=Coverage.REFERENCE,
    )


def _lidar(name: str) -> Row:
    """Return the row of the latitude or longitude of the lidars: that of values is the crossing."""
    station = replace(deployment(place(name)), comment=None)
    return _of_beams(station, name, f"{name} of the lidar of the beam")


_COORDINATES: Final = (
    TIME,
    numbered(
        "crossing_id",
        "number of the crossing in the network of beams",
        "Ordered by the nearest range. A crossing that is the farthest one on all of its beams has"
        " a number but no value, because nothing constrains the attenuation beyond it.",
        dims=("crossing",),
        cf_role="timeseries_id",
    ),
    _crossing("latitude"),
    _crossing("longitude"),
    replace(
        altitude("crossing"),
        dtype="f8",
        long_name="altitude of the crossing of beams above the geoid",
        follows_beam=False,
        comment="For straight beams on the WGS 84 ellipsoid, to which the geoid is taken as"
        " parallel.",
    ),
    numbered(
        "beam",
        "number of the beam",
        "lidarops_steps names the instrument of each beam and the crossings on it.",
    ),
    _lidar("latitude"),
    _lidar("longitude"),
    _of_beams(
        place("station_altitude"), "altitude", "altitude of the lidar of the beam above the geoid"
    ),
    _of_beams(place("zenith_angle"), "zenith_angle", "zenith angle of the beam, 0 = up"),
    _of_beams(place("azimuth"), "azimuth", "azimuth of the beam, clockwise from north"),
    place("wavelength"),
)


def _tested(name: str, long_name: str, comment: str, **changes: Any) -> Row:
    """Return the row of what tells how well a network, or a value, is determined."""
    coverage = Coverage.QUALITY
    row = Row(name, long_name, comment, dims=("time",), coverage=coverage, valid_min=0.0, bits=8)
    return replace(row, **changes)


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
    " high, and no test detects it there: total_extinction_standard_error allows for typical"
    " gradients. More profiles in a block and more beams constrain the field better. In"
    " blocks of one profile, some simulated values without a flag deviate by more than 4 standard"
    " errors with a plume, or where extinction changes with height by a factor of e in 300 to"
    f" 3000 m: noise hides the field. {MEASURED_SHARES}"
    " The profiles of a block share most of their error, so that a mean over time does not reduce"
    " it. total_extinction_systematic_error includes a lidar ratio that varies over the network as"
    " declared, by default by 7 percent (rms). Where it varies by more, some values without a flag"
    " deviate by more than 4 standard errors.",
    sampled="crossing",
    feature_type="timeSeries",
    coordinates=_COORDINATES,
    data=(
        *visibility(
            "at the crossing of beams",
            ("total_extinction_systematic_error", *_OF_VALUE),
            # Most of the error comes from the prior, which all profiles share.
            error_kind=ErrorKind.BOTH,
        ),
        total_extinction(
            ancillaries=_OF_VALUE,
            bits=VALUE_BITS,
            uncertain=True,
            errors=(
                Error(
                    "systematic",
                    "model (systematic) uncertainty of extinction",
                    comment="Separate from {quantity}_standard_error, which covers noise and prior."
                    " Effect of the errors of exponent, lidar ratio and overlap declared in the"
                    " settings, of signal that may remain in the background, and of the multiplier"
                    " where one is requested.",
                ),
            ),
            error_kind=ErrorKind.BOTH,
        ),
        _tested(
            "condition",
            "relative change of extinction over that of the signals at the near ends of the beams",
            "Root of the sum of squares over the beams. Larger values mean higher sensitivity to"
            " overlap errors.",
            dims=("time", "crossing"),
        ),
        Row(
            "multiplier",
            "multiplier lambda of the equations of a triangle of beams",
            "Row j of a cycle of three beams is multiplied by its power j - 1. 1 is exact; a"
            " smaller one limits noise, and its bias in homogeneous air is part of"
            " total_extinction_systematic_error.",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
            optional=True,
        ),
        retrieval_method(
            _METHODS,
            "beams_with_prior: all beams, the profiles of a block as one field that changes slowly."
            " beams_without_prior: all beams alone. triangles: one triangle of beams at each"
            " crossing, with a multiplier.",
        ),
        replace(
            quality(FLAGS),
            comment="In this kind of product, poorly_determined means that the standard error,"
            " alone or with the systematic one, exceeds a third of extinction. low_leverage: a beam"
            " is too noisy, or states a variance of zero, and was left out; the value comes from"
            " the other beams. poor_fit: the beams disagree by more than their noise explains, or"
            " with the other profiles of the block, or a beam ends before the crossing at bins that"
            " deviate from their neighbours. outlier: a beam has bins that deviate by"
            " more than 6 standard errors from their neighbours. Single bins were replaced from"
            " their neighbours. Several adjacent bins, which may be the edges of a layer, were"
            " kept; the effect of these and of the bins between two edges is part of the standard"
            " error. The value is valid.",
        ),
        _tested(
            "path_optical_depth",
            "optical depth along the longest beam section between crossings",
            "From the mean extinction at the crossings.",
        ),
        _tested(
            "reduced_chi2",
            "reduced chi-square of the network",
            "From the beams alone, without the prior. Missing without degrees of freedom.",
        ),
        _tested(
            "degrees_of_freedom",
            "number of equations of the network minus number of unknowns",
            "Missing where unknowns outnumber equations.",
        ),
        Row(
            "beam_range",
            "distance of the crossing from the lidar along the beam",
            "Missing where the crossing does not lie on the beam.",
            dims=("beam", "crossing"),
            units="m",
            coverage=Coverage.REFERENCE,
            valid_min=0.0,
        ),
        shots(of="all beams of the interval"),
    ),
)

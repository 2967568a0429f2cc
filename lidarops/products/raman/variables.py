"""The variables of the ``raman`` product."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from lidarops.netcdf.cloud_rows import CLOUDS
from lidarops.netcdf.variables import (
    AEROSOL_BACKSCATTER,
    AEROSOL_EXTINCTION,
    AEROSOL_LIDAR_RATIO,
    AVERAGED_PROFILES,
    BACKGROUND_METHOD,
    LEFT_OUT_PROFILES,
    MOLECULAR_BACKSCATTER,
    MOLECULAR_SOURCE,
    NO_STANDARD_NAME,
    RANGE,
    REFERENCE_WINDOW,
    SUBTRACTED_BACKGROUND,
    Coverage,
    ErrorBudget,
    ErrorKind,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    reference_rejections,
    shots,
)
from lidarops.products.raman.flags import FLAGS
from lidarops.retrieve.raman.errors import BACKSCATTER_CAUSES, EXTINCTION_CAUSES, RANDOM
from lidarops.retrieve.raman.thresholds import THRESHOLDS

_BINS: Final = ("time", "range")
_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""
_FACTOR: Final = math.exp(THRESHOLDS.lidar_ratio_spread)
"""Of the typical lidar ratio, within which are 68 percent of them."""
_WORDS: Final = {
    "noise": "the signal noise",
    "resolution": "the difference between the weights of the value and a mean over"
    " vertical_resolution",
    "background": "the backgrounds",
    "dead_time": "the dead times",
    "baseline": "the analog baselines",
    "reference": "the scattering ratio in the reference window",
    "angstrom": "the Angstrom exponent",
    "molecular": "the density of the air",
    "overlap": "the overlap function",
}
_PARTS: Final = ("quality_flag", "profiles", "shots")
_COMMENT_OF_MEANS: Final = (
    "Noise, resolution and background are independent from profile to profile; errors by all other"
    " causes are shared by all profiles, so that they are averaged and do not decrease with the"
    " number of profiles."
)


def _budget(name: str, units: str, causes: tuple[str, ...]) -> Iterator[Row]:
    """Yield the rows of the error budget of a quantity."""
    for cause in causes:
        kind = ErrorKind.RANDOM if cause in RANDOM else ErrorKind.SYSTEMATIC
        yield Row(
            name=f"{name}_error_{cause}",
            dims=_BINS,
            dtype="f4",
            units=units,
            long_name=f"error of {name} for one standard error of {_WORDS[cause]}"
            if cause != "resolution"
            else f"standard error of {name} by {_WORDS[cause]}",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            error_kind=kind,
            comment=f"{name}_standard_error is the root of the sum of squares of the error budget."
            f" {NO_STANDARD_NAME}",
        )


def _terms(name: str, causes: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{name}_error_{cause}" for cause in causes)


def _means(name: str, causes: tuple[str, ...]) -> ErrorBudget:
    random = tuple(f"{name}_error_{cause}" for cause in causes if cause in RANDOM)
    shared = tuple(f"{name}_error_{cause}" for cause in causes if cause not in RANDOM)
    return ErrorBudget(random=random, shared=shared, comment=_COMMENT_OF_MEANS)


def _of_two_parts(name: str) -> ErrorBudget:
    return ErrorBudget(
        random=(f"{name}_error_random",),
        shared=(f"{name}_error_systematic",),
        comment=_COMMENT_OF_MEANS,
    )


def _part(name: str, units: str, words: str, kind: ErrorKind, *, optional: bool = False) -> Row:
    """Return the row of the random or systematic error of a quantity."""
    return Row(
        name=f"{name}_error_{kind.value}",
        dims=_BINS,
        dtype="f4",
        units=units,
        long_name=f"{kind.value} standard error of {words}",
        coverage=Coverage.QUALITY,
        significant_bits=8,
        error_kind=kind,
        optional=optional,
        comment=NO_STANDARD_NAME,
    )


LAYOUT: Final = Layout(
    title="Extinction, backscatter and lidar ratio of aerosol from Raman signals",
    summary="Extinction, backscatter and lidar ratio of aerosol from an elastic and a nitrogen"
    " Raman signal, without an assumed lidar ratio, with error budgets and vertical resolution.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL BACKSCATTER",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Ansmann, A. et al. (1990), Opt. Lett. 15, 746-748, doi:10.1364/OL.15.000746.",
        "Ansmann, A. et al. (1992), Appl. Opt. 31, 7113-7131, doi:10.1364/AO.31.007113.",
        "Pappalardo, G. et al. (2004), Appl. Opt. 43, 5370-5385, doi:10.1364/AO.43.005370.",
    ),
    comment="Profiles are means over time; range is along the beam. Extinction and lidar ratio are"
    " means over vertical_resolution, which follows from the signal; backscatter is that of the"
    " bin. Below full overlap there is no extinction; backscatter is right there where both"
    " channels have the same overlap. Particles in the reference window that decrease with height"
    " nearly as molecules do look like aerosol-free air: only the error of the scattering ratio"
    " declared in the settings covers them.",
    sampled="range",
    weighed=(
        "aerosol_extinction",
        "aerosol_backscatter",
        "lidar_ratio",
        "water_vapour_mixing_ratio",
    ),
    coordinates=coordinates((RANGE,), altitude("range")),
    data=(
        Row(
            name="aerosol_extinction",
            dims=_BINS,
            dtype="f4",
            units="m-1",
            standard_name=AEROSOL_EXTINCTION,
            long_name="extinction coefficient of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=(
                *_terms("aerosol_extinction", EXTINCTION_CAUSES),
                "aerosol_extinction_smoothing_error",
                "vertical_resolution",
                *_PARTS,
            ),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            budget=_means("aerosol_extinction", EXTINCTION_CAUSES),
            comment="Mean over vertical_resolution.",
        ),
        *_budget("aerosol_extinction", "m-1", EXTINCTION_CAUSES),
        Row(
            name="aerosol_extinction_smoothing_error",
            dims=_BINS,
            dtype="f4",
            units="m-1",
            long_name="standard error of extinction as that of the bin instead of its mean over"
            " vertical_resolution",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Not part of aerosol_extinction_standard_error; from the smoothness of the"
            f" profile, and too small at edges of layers. {NO_STANDARD_NAME}",
        ),
        Row(
            name="aerosol_backscatter",
            dims=_BINS,
            dtype="f4",
            units="m-1 sr-1",
            standard_name=AEROSOL_BACKSCATTER,
            long_name="backscatter coefficient of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=(*_terms("aerosol_backscatter", BACKSCATTER_CAUSES), *_PARTS),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            budget=_means("aerosol_backscatter", BACKSCATTER_CAUSES),
        ),
        *_budget("aerosol_backscatter", "m-1 sr-1", BACKSCATTER_CAUSES),
        Row(
            name="lidar_ratio",
            dims=_BINS,
            dtype="f4",
            units="sr",
            standard_name=AEROSOL_LIDAR_RATIO,
            long_name="ratio of extinction to backscatter of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=(
                "lidar_ratio_error_random",
                "lidar_ratio_error_systematic",
                "vertical_resolution",
                *_PARTS,
            ),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            budget=_of_two_parts("lidar_ratio"),
            comment="Measured: extinction over backscatter, which is smoothed as extinction is."
            " Missing where backscatter exceeds zero by too few standard errors. The error allows"
            " for noise that made the value too small; of uncertain values, it expects most lidar"
            f" ratios within a factor of {_FACTOR:.1f} of {THRESHOLDS.typical_lidar_ratio:g} sr.",
        ),
        _part("lidar_ratio", "sr", "lidar_ratio", ErrorKind.RANDOM),
        _part("lidar_ratio", "sr", "lidar_ratio", ErrorKind.SYSTEMATIC),
        Row(
            name="vertical_resolution",
            dims=_BINS,
            dtype="f4",
            units="m",
            long_name="effective resolution of extinction and lidar ratio along the beam",
            coverage=Coverage.AUXILIARY,
            significant_bits=8,
            comment=f"Length over which a mean has the noise of the value. {NO_STANDARD_NAME}",
        ),
        Row(
            name="water_vapour_mixing_ratio",
            dims=_BINS,
            dtype="f4",
            units="kg kg-1",
            standard_name="humidity_mixing_ratio",
            long_name="mass of water vapour over mass of dry air",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=(
                "water_vapour_mixing_ratio_error_random",
                "water_vapour_mixing_ratio_error_systematic",
                *_PARTS,
            ),
            significant_bits=_BITS,
            uncertain=True,
            optional=True,
            error_kind=ErrorKind.BOTH,
            budget=_of_two_parts("water_vapour_mixing_ratio"),
            comment="With the calibration constant of the campaign.",
        ),
        *(
            _part(
                "water_vapour_mixing_ratio",
                "kg kg-1",
                "water_vapour_mixing_ratio",
                kind,
                optional=True,
            )
            for kind in (ErrorKind.RANDOM, ErrorKind.SYSTEMATIC)
        ),
        Row(
            name="overlap",
            dims=_BINS,
            dtype="f4",
            units="1",
            long_name="overlap of laser beam and field of view of the Raman channel",
            coverage=Coverage.AUXILIARY,
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            comment="Below the range of full overlap, from the lidar ratio measured above it;"
            " beyond, as the campaign states it, and missing where it states none."
            f" {NO_STANDARD_NAME}",
        ),
        MOLECULAR_SOURCE,
        MOLECULAR_BACKSCATTER,
        *REFERENCE_WINDOW,
        reference_rejections(
            "The elastic signal is corrected for the measured attenuation before it is compared"
            " with air."
        ),
        *CLOUDS,
        BACKGROUND_METHOD,
        SUBTRACTED_BACKGROUND,
        quality(_BINS, FLAGS),
        AVERAGED_PROFILES,
        LEFT_OUT_PROFILES,
        shots(of="all profiles in the mean"),
    ),
)

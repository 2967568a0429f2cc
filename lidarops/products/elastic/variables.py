"""The variables of the ``elastic`` product."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final

from lidarops.netcdf.cloud_rows import CLOUDS
from lidarops.netcdf.variables import (
    AEROSOL_BACKSCATTER,
    AEROSOL_EXTINCTION,
    AEROSOL_LIDAR_RATIO,
    AVERAGED_PROFILES,
    BACKGROUND_METHOD,
    GLUING,
    LEFT_OUT_PROFILES,
    MEASURED_SHARES,
    MOLECULAR_BACKSCATTER,
    MOLECULAR_SOURCE,
    NO_STANDARD_NAME,
    RANGE,
    REFERENCE_WINDOW,
    STANDARD_NAME_TABLE,
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
from lidarops.products.elastic.flags import FLAGS

_BINS: Final = ("time", "range")
_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""
_BUDGET: Final = {
    "noise": (
        "the signal noise",
        ErrorKind.RANDOM,
        "Random: independent from profile to profile.",
    ),
    "background": (
        "the background",
        ErrorKind.RANDOM,
        "Random in time, but common to all ranges of a profile.",
    ),
    "reference": (
        "the reference value",
        ErrorKind.SYSTEMATIC,
        "Systematic: from the aerosol assumed in the reference window and the noise there.",
    ),
    "lidar_ratio": (
        "the lidar ratio",
        ErrorKind.SYSTEMATIC,
        "Systematic: from the assumed lidar ratio.",
    ),
    "molecular": (
        "the molecular backscatter",
        ErrorKind.SYSTEMATIC,
        "Systematic: from the molecular atmosphere.",
    ),
    "dead_time": (
        "the dead time",
        ErrorKind.SYSTEMATIC,
        "Systematic: from the dead time of photon counting; 0 for analog signals.",
    ),
    "baseline": (
        "the baseline",
        ErrorKind.SYSTEMATIC,
        "Systematic: from the baseline of analog signals; 0 for photon counting.",
    ),
}
"""Source of error -> its name in texts, its kind and a comment, in the order of
`lidarops.retrieve.elastic.inversion.ErrorBudget`."""


def _error_budget() -> Iterator[Row]:
    """Yield the rows of the error budget of backscatter."""
    for source, (words, kind, comment) in _BUDGET.items():
        yield Row(
            name=f"aerosol_backscatter_error_{source}",
            dims=_BINS,
            dtype="f4",
            units="m-1 sr-1",
            long_name=f"error of backscatter for one standard error of {words}",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            error_kind=kind,
            comment=f"{comment} aerosol_backscatter_standard_error is the root of the sum of"
            f" squares of the error budget. {NO_STANDARD_NAME}",
        )


def sources(kind: ErrorKind) -> tuple[str, ...]:
    """Return the sources of error of this kind, fields of the error budget of the inversion."""
    return tuple(source for source, (_, of_source, _) in _BUDGET.items() if of_source is kind)


def _terms(names: Iterable[str]) -> tuple[str, ...]:
    """Return the variables of the error budget of these sources."""
    return tuple(f"aerosol_backscatter_error_{source}" for source in names)


_BUDGET_TERMS: Final = _terms(_BUDGET)
_SHARED: Final = _terms(sources(ErrorKind.SYSTEMATIC))
_MEANS: Final = ErrorBudget(
    random=_terms(sources(ErrorKind.RANDOM)),
    comment="Errors from noise and background are independent between profiles. Errors from"
    " reference, lidar ratio, molecules and dead time are assumed to be shared by all profiles, so"
    " that they are averaged and do not decrease with the number of profiles.",
)

LAYOUT: Final = Layout(
    title="Aerosol backscatter and extinction from elastic signals",
    summary="Backscatter and extinction of aerosol from elastic lidar signals by the"
    " two-component inversion of Klett, Fernald and Sasano, with an error budget.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL BACKSCATTER",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Klett, J. D. (1981), Appl. Opt. 20, 211-220, doi:10.1364/AO.20.000211.",
        "Fernald, F. G. (1984), Appl. Opt. 23, 652-653, doi:10.1364/AO.23.000652.",
        "Sasano, Y. et al. (1985), Appl. Opt. 24, 3929-3932, doi:10.1364/AO.24.003929.",
    ),
    comment="aerosol_extinction is aerosol_backscatter times the assumed lidar ratio, not an"
    " independent measurement. Profiles are means over time; range is along the beam. Particles in"
    " the reference window that decrease with height nearly as molecules do look like aerosol-free"
    " air, and no test of the signal detects them: only the error of the scattering ratio declared"
    " in the settings covers them. Declare a larger error where the air is hazy at all heights:"
    " where simulated haze exceeds it, values without a flag deviate by more than 4 of their"
    f" standard errors. {MEASURED_SHARES} An elastic"
    " signal does not determine the lidar ratio either; its declared error has to cover"
    " that. Values flagged outlier are taken from neighbouring ranges, because the signal of the"
    " bin deviates from theirs by more than noise explains.",
    sampled="range",
    weighed=("aerosol_backscatter",),
    coordinates=coordinates((RANGE,), altitude("range")),
    data=(
        Row(
            name="aerosol_backscatter",
            dims=_BINS,
            dtype="f4",
            units="m-1 sr-1",
            standard_name=AEROSOL_BACKSCATTER,
            long_name="backscatter coefficient of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=(*_BUDGET_TERMS, "quality_flag", "profiles", "shots"),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            budget=replace(_MEANS, shared=_SHARED),
        ),
        *_error_budget(),
        Row(
            name="aerosol_extinction",
            dims=_BINS,
            dtype="f4",
            units="m-1",
            standard_name=AEROSOL_EXTINCTION,
            long_name="extinction coefficient of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            # Readers do not follow the ancillaries of an ancillary: list the error here too.
            ancillaries=(
                "lidar_ratio",
                "lidar_ratio_standard_error",
                "quality_flag",
                "profiles",
                "shots",
            ),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            budget=replace(_MEANS, times="lidar_ratio"),
            comment="aerosol_backscatter times lidar_ratio.",
        ),
        Row(
            name="scattering_ratio",
            dims=_BINS,
            dtype="f4",
            units="1",
            long_name="ratio of backscatter of particles and molecules to that of molecules",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=("quality_flag", "profiles", "shots"),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            budget=replace(_MEANS, over="molecular_backscatter"),
            comment="Free of attenuation, unlike backscattering_ratio_in_air of the"
            f" {STANDARD_NAME_TABLE}. {NO_STANDARD_NAME}",
        ),
        Row(
            name="attenuated_backscatter",
            dims=_BINS,
            dtype="f4",
            units="m-1 sr-1",
            standard_name="volume_attenuated_backwards_scattering_coefficient_of_radiative_flux"
            "_in_air",
            long_name="attenuated backscatter coefficient of particles and molecules",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=("quality_flag", "profiles", "shots"),
            significant_bits=_BITS,
            uncertain=True,
            # Noise of the calibration and noise of the bins are not stated separately.
            error_kind=ErrorKind.BOTH,
            comment="Calibrated in the reference window.",
        ),
        Row(
            name="vertical_resolution",
            dims=(),
            dtype="f4",
            units="m",
            long_name="effective resolution of all profiles along the beam",
            coverage=Coverage.AUXILIARY,
            comment=f"The width of a range bin: profiles are not smoothed. {NO_STANDARD_NAME}",
        ),
        MOLECULAR_SOURCE,
        MOLECULAR_BACKSCATTER,
        Row(
            name="molecular_extinction",
            dims=("range",),
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of molecules",
            coverage=Coverage.REFERENCE,
            comment=NO_STANDARD_NAME,
        ),
        Row(
            name="lidar_ratio",
            dims=("range",),
            dtype="f4",
            units="sr",
            standard_name=AEROSOL_LIDAR_RATIO,
            long_name="assumed ratio of extinction to backscatter of aerosol particles",
            coverage=Coverage.REFERENCE,
            uncertain=True,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Set by the campaign: a number, a profile, or the mean over time of a raman"
            " product without values in clouds, which the provenance names. Its errors at all"
            " ranges are one error.",
        ),
        *REFERENCE_WINDOW,
        reference_rejections(
            "too_few_bins: data in less than half of the bins; excluded: a cloud; low_signal: the"
            " signal does not exceed zero by 3 standard errors; slope, curvature, scatter: it"
            " departs from the shape of clean air; more_particles: another window has a lower ratio"
            " to air."
        ),
        *CLOUDS,
        BACKGROUND_METHOD,
        SUBTRACTED_BACKGROUND,
        *GLUING,
        quality(_BINS, FLAGS),
        AVERAGED_PROFILES,
        LEFT_OUT_PROFILES,
        shots(of="all profiles in the mean"),
    ),
)

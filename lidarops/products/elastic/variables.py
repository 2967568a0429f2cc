"""The variables and quality bits of the ``elastic`` product."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from lidarops.flags import SIGNAL_BITS, Flags
from lidarops.netcdf.quantities import (
    AEROSOL_LIDAR_RATIO,
    AVERAGED,
    CLOUDS,
    MOLECULAR_BACKSCATTER,
    SUM_OF_SQUARES,
    aerosol_backscatter,
    aerosol_extinction,
    mean_value,
    reference_window,
)
from lidarops.netcdf.variables import (
    ALONG_BEAM,
    BACKGROUND_METHOD,
    GLUING,
    MEASURED_SHARES,
    MOLECULES,
    STANDARD_NAME_TABLE,
    SUBTRACTED_BACKGROUND,
    Coverage,
    Error,
    ErrorKind,
    Layout,
    Row,
    divided,
    quality,
)
from lidarops.retrieve.elastic.flags import ElasticQuality

FLAGS: Final = Flags(kind="elastic", version=3, bits=(*SIGNAL_BITS, *ElasticQuality))
"""Published places are in `tests/products/test_flags.py`."""

_BY_CAUSE: Final = {
    ErrorKind.RANDOM: {
        "noise": ("signal noise", "Random: independent from profile to profile."),
        "background": ("background", "Random in time, but common to all ranges of a profile."),
    },
    ErrorKind.SYSTEMATIC: {
        "reference": (
            "reference value",
            "Systematic: from the aerosol assumed in the reference window and the noise there.",
        ),
        "lidar_ratio": ("lidar ratio", "Systematic: from the assumed lidar ratio."),
        "molecular": ("molecular backscatter", "Systematic: from the molecular atmosphere."),
        "dead_time": (
            "dead time",
            "Systematic: from the dead time of photon counting; 0 for analog signals.",
        ),
        "baseline": (
            "baseline",
            "Systematic: from the baseline of analog signals; 0 for photon counting.",
        ),
    },
}
"""In the order of `lidarops.retrieve.elastic.inversion.CAUSES`."""
_ERRORS: Final = tuple(
    Error(
        cause,
        f"error of backscatter for one standard error of the {words}",
        kind,
        f"{comment} {SUM_OF_SQUARES}",
        part=True,
    )
    for kind, causes in _BY_CAUSE.items()
    for cause, (words, comment) in causes.items()
)
_BUDGET: Final = divided(
    "aerosol_backscatter",
    _ERRORS,
    "Errors from noise and background are independent between profiles. Errors from reference,"
    " lidar ratio, molecules and dead time are assumed to be shared by all profiles, so that they"
    " are averaged and do not decrease with the number of profiles.",
)


def sources(kind: ErrorKind) -> tuple[str, ...]:
    """Return the sources of error of this kind, fields of the error budget of the inversion."""
    return tuple(_BY_CAUSE[kind])


LAYOUT: Final = Layout(
    title="Aerosol backscatter and extinction from elastic signals",
    summary="Backscatter and extinction of aerosol from elastic lidar signals by the"
    " two-component inversion of Klett, Fernald and Sasano, with an error budget.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL BACKSCATTER",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
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
    coordinates=ALONG_BEAM,
    data=(
        aerosol_backscatter(errors=_ERRORS, budget=_BUDGET),
        aerosol_extinction(
            "aerosol_backscatter times lidar_ratio.",
            # Readers do not follow the ancillaries of an ancillary: list the error here too.
            ("lidar_ratio", "lidar_ratio_standard_error"),
            budget=replace(_BUDGET, shared=(), times="lidar_ratio"),
        ),
        mean_value(
            "scattering_ratio",
            "1",
            "ratio of backscatter of particles and molecules to that of molecules",
            "Free of attenuation, unlike backscattering_ratio_in_air of the"
            f" {STANDARD_NAME_TABLE}.",
            budget=replace(_BUDGET, shared=(), over="molecular_backscatter"),
        ),
        mean_value(
            "attenuated_backscatter",
            "m-1 sr-1",
            "attenuated backscatter coefficient of particles and molecules",
            "Calibrated in the reference window.",
            standard_name="volume_attenuated_backwards_scattering_coefficient_of_radiative_flux"
            "_in_air",
            # Noise of the calibration and noise of the bins are not stated separately.
            error_kind=ErrorKind.BOTH,
        ),
        Row(
            "vertical_resolution",
            "effective resolution of all profiles along the beam",
            "The width of a range bin: profiles are not smoothed.",
            dims=(),
            units="m",
            coverage=Coverage.AUXILIARY,
        ),
        *MOLECULES,
        MOLECULAR_BACKSCATTER,
        Row(
            "molecular_extinction",
            "extinction coefficient of molecules",
            dims=("range",),
            units="m-1",
            coverage=Coverage.REFERENCE,
        ),
        Row(
            "lidar_ratio",
            "assumed ratio of extinction to backscatter of aerosol particles",
            "Set by the campaign: a number, a profile, or the mean over time of a raman product"
            " without values in clouds, which the provenance names. Its errors at all ranges are"
            " one error.",
            dims=("range",),
            units="sr",
            coverage=Coverage.REFERENCE,
            standard_name=AEROSOL_LIDAR_RATIO,
            uncertain=True,
            error_kind=ErrorKind.SYSTEMATIC,
        ),
        *reference_window(
            "too_few_bins: data in less than half of the bins; excluded: a cloud; low_signal: the"
            " signal does not exceed zero by 3 standard errors; slope, curvature, scatter: it"
            " departs from the shape of clean air; more_particles: another window has a lower ratio"
            " to air."
        ),
        *CLOUDS,
        BACKGROUND_METHOD,
        SUBTRACTED_BACKGROUND,
        *GLUING,
        quality(FLAGS),
        *AVERAGED,
    ),
)

"""The variables and quality bits of the ``raman`` product."""

from __future__ import annotations

import math
from typing import Any, Final

from lidarops.flags import RAW_BITS, Flags, Quality
from lidarops.netcdf.quantities import (
    AEROSOL_LIDAR_RATIO,
    AVERAGED,
    CLOUDS,
    MOLECULAR_BACKSCATTER,
    SUM_OF_SQUARES,
    VALUE_BITS,
    aerosol_backscatter,
    aerosol_extinction,
    mean_value,
    reference_window,
)
from lidarops.netcdf.variables import (
    ALONG_BEAM,
    BACKGROUND_METHOD,
    MOLECULES,
    SUBTRACTED_BACKGROUND,
    Coverage,
    Error,
    ErrorKind,
    Layout,
    Row,
    divided,
    quality,
)
from lidarops.retrieve.raman.errors import BACKSCATTER_CAUSES, EXTINCTION_CAUSES, RANDOM
from lidarops.retrieve.raman.flags import CONCERNING, RamanQuality
from lidarops.retrieve.raman.thresholds import THRESHOLDS

FLAGS: Final = Flags(
    kind="raman",
    version=1,
    bits=(
        *RAW_BITS,
        Quality.SINGLE_RECORD,
        Quality.LOW_SIGNAL_TO_NOISE,
        Quality.BACKGROUND_UNCERTAIN,
        Quality.NO_GLUING,
        *RamanQuality,
    ),
)
"""Of all quantities. Published places are in `tests/products/test_flags.py`."""


def _quality(quantity: str, own: str = "", **more: Any) -> Row:
    """Return the row of the flags of a quantity; with `own` they have its name."""
    return quality(FLAGS.only(CONCERNING[quantity]), own, **more)


_WATER: Final = "water_vapour_mixing_ratio"
_FACTOR: Final = math.exp(THRESHOLDS.lidar_ratio_spread)
"""Of the typical lidar ratio, within which are 68 percent of them."""
_ONE_ERROR: Final = "error of {quantity} for one standard error of the"
_WORDS: Final = {
    "noise": f"{_ONE_ERROR} signal noise",
    "resolution": "standard error of {quantity} by the difference between the weights of the value"
    " and a mean over vertical_resolution",
    "background": f"{_ONE_ERROR} backgrounds",
    "dead_time": f"{_ONE_ERROR} dead times",
    "baseline": f"{_ONE_ERROR} analog baselines",
    "reference": f"{_ONE_ERROR} scattering ratio in the reference window",
    "angstrom": f"{_ONE_ERROR} Angstrom exponent",
    "molecular": f"{_ONE_ERROR} density of the air",
    "overlap": f"{_ONE_ERROR} overlap function",
}
_MEANS: Final = (
    "Noise, resolution and background are independent from profile to profile; errors by all other"
    " causes are shared by all profiles, so that they are averaged and do not decrease with the"
    " number of profiles."
)


def _by_cause(causes: tuple[str, ...]) -> tuple[Error, ...]:
    kinds = (ErrorKind.RANDOM if cause in RANDOM else ErrorKind.SYSTEMATIC for cause in causes)
    return tuple(
        Error(cause, _WORDS[cause], kind, SUM_OF_SQUARES, part=True)
        for cause, kind in zip(causes, kinds, strict=True)
    )


_OF_EXTINCTION: Final = _by_cause(EXTINCTION_CAUSES)
_OF_BACKSCATTER: Final = _by_cause(BACKSCATTER_CAUSES)
_BY_KIND: Final = tuple(
    Error(kind, f"{kind} standard error of {{quantity}}", kind, part=True)
    for kind in (ErrorKind.RANDOM, ErrorKind.SYSTEMATIC)
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
    references=(
        "Ansmann, A. et al. (1990), Opt. Lett. 15, 746-748, doi:10.1364/OL.15.000746.",
        "Ansmann, A. et al. (1992), Appl. Opt. 31, 7113-7131, doi:10.1364/AO.31.007113.",
        "Pappalardo, G. et al. (2004), Appl. Opt. 43, 5370-5385, doi:10.1364/AO.43.005370.",
    ),
    comment="Profiles are means over time; range is along the beam. Extinction and lidar ratio are"
    " means over vertical_resolution, which follows from the signal; backscatter is that of the"
    " bin. Each quantity has flags of its own, which its ancillary_variables name; quality_flag is"
    " that of extinction. Below full overlap there is no extinction; backscatter is right there"
    " where both channels have the same overlap. Particles in the reference window that decrease"
    " with height nearly as molecules do look like aerosol-free air: only the error of the"
    " scattering ratio declared in the settings covers them.",
    sampled="range",
    weighed=(
        "aerosol_extinction",
        "aerosol_backscatter",
        "lidar_ratio",
        _WATER,
    ),
    coordinates=ALONG_BEAM,
    data=(
        aerosol_extinction(
            "Mean over vertical_resolution.",
            ("vertical_resolution",),
            errors=(
                *_OF_EXTINCTION,
                Error(
                    "smoothing",
                    "standard error of extinction as that of the bin instead of its mean over"
                    " vertical_resolution",
                    comment="Not part of {quantity}_standard_error; from the smoothness of the"
                    " profile, and too small at edges of layers.",
                    signed=True,
                ),
            ),
            budget=divided("aerosol_extinction", _OF_EXTINCTION, _MEANS),
        ),
        aerosol_backscatter(
            errors=_OF_BACKSCATTER, budget=divided("aerosol_backscatter", _OF_BACKSCATTER, _MEANS)
        ),
        mean_value(
            "lidar_ratio",
            "sr",
            "ratio of extinction to backscatter of aerosol particles",
            "Measured: extinction over backscatter, which is smoothed as extinction is. Missing"
            " where backscatter exceeds zero by too few standard errors, or extinction is not above"
            " zero. The error allows for noise"
            " that made the value too small; of uncertain values, it expects most lidar ratios"
            f" within a factor of {_FACTOR:.1f} of {THRESHOLDS.typical_lidar_ratio:g} sr.",
            ("vertical_resolution",),
            standard_name=AEROSOL_LIDAR_RATIO,
            errors=_BY_KIND,
            budget=divided("lidar_ratio", _BY_KIND, _MEANS),
        ),
        Row(
            "vertical_resolution",
            "effective resolution of extinction and lidar ratio along the beam",
            "Length over which a mean has the noise of the value. The mean is centred on the bin,"
            " but begins at the first one with extinction where it would reach before it.",
            units="m",
            coverage=Coverage.AUXILIARY,
            bits=8,
        ),
        mean_value(
            _WATER,
            "kg kg-1",
            "mass of water vapour over mass of dry air",
            "With the calibration constant of the campaign.",
            standard_name="humidity_mixing_ratio",
            errors=_BY_KIND,
            optional=True,
            budget=divided(_WATER, _BY_KIND, _MEANS),
        ),
        Row(
            "overlap",
            "overlap of laser beam and field of view of the Raman channel",
            "Below the range of full overlap, from the lidar ratio measured above it; beyond, as"
            " the campaign states it, and missing where it states none.",
            coverage=Coverage.AUXILIARY,
            bits=VALUE_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
        ),
        *MOLECULES,
        MOLECULAR_BACKSCATTER,
        *reference_window(
            "The elastic signal is corrected for the measured attenuation before it is compared"
            " with air."
        ),
        *CLOUDS,
        BACKGROUND_METHOD,
        SUBTRACTED_BACKGROUND,
        _quality("aerosol_extinction"),
        *(_quality(name, name) for name in ("aerosol_backscatter", "lidar_ratio")),
        _quality(_WATER, _WATER, optional=True),
        *AVERAGED,
    ),
)

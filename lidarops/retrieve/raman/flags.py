"""Quality bits of Raman retrievals, beside those of `lidarops.flags.Quality`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from lidarops.flags import FIRST_OWN, STANDARD_AIR, FlagBit, Quality, care, reject
from lidarops.retrieve.clouds.thresholds import THRESHOLDS
from lidarops.retrieve.common.arrays import Flags

_MARGIN: Final = f"{THRESHOLDS.cloud_margin:g} m"


class RamanQuality(FlagBit):
    """Own bits. A place is never given to another bit."""

    NO_REFERENCE = care(
        FIRST_OWN,
        "no range window passes the tests for aerosol-free air, so that backscatter and lidar"
        " ratio are missing; extinction needs none",
    )
    WEAK_SIGNAL = reject(
        FIRST_OWN + 1,
        "the smoothed Raman signal is less than 5 times its standard error, or jumps so that no"
        " smooth one follows it",
    )
    NO_LIDAR_RATIO = care(
        FIRST_OWN + 2,
        "the lidar ratio is missing: backscatter exceeds zero by too few standard errors, or"
        " extinction is not above zero",
    )
    NEGATIVE_EXTINCTION = reject(
        FIRST_OWN + 3,
        "beyond, the Raman signal falls less than in air without particles, by more than its"
        " error: the overlap may not be full where stated, a background is wrong, or the air is"
        " not that of atmospheric_molecular_calculation_source",
    )
    PARTLY_CLOUDY = care(
        FIRST_OWN + 4,
        f"some of the averaged profiles, not all, show a cloud within {_MARGIN} or, of extinction"
        " and lidar ratio, in the mean over vertical_resolution: the value is that of cloudy and"
        " clear air",
    )
    CLOUD = care(
        FIRST_OWN + 5,
        f"the mean of the profiles shows a cloud within {_MARGIN} or, of extinction and lidar"
        " ratio, in the mean over vertical_resolution: multiple scattering makes extinction too"
        " small, by more than its error states",
    )
    DOUBTFUL_WATER_VAPOUR = care(
        FIRST_OWN + 6,
        "water vapour is missing or may be wrong: its channel has no data, is saturated, counts"
        " too fast or has an uncertain background; other values are not concerned",
    )
    COMMON_OVERLAP = care(
        FIRST_OWN + 7,
        "the overlap is not full: the value holds where both channels have the same overlap,"
        " which its error does not cover",
    )
    STANDARD_AIR = care(FIRST_OWN + 8, STANDARD_AIR)


_OF_SIGNALS: Final = (
    Quality.INPUT_MISSING,
    Quality.SATURATED,
    Quality.PILE_UP,
    Quality.NO_SIGNAL,
    Quality.SINGLE_RECORD,
    Quality.LOW_SIGNAL_TO_NOISE,
    Quality.BACKGROUND_UNCERTAIN,
    Quality.NO_GLUING,
    RamanQuality.WEAK_SIGNAL,
    RamanQuality.PARTLY_CLOUDY,
    RamanQuality.CLOUD,
    RamanQuality.STANDARD_AIR,
)
_OF_SLOPE: Final = (Quality.INCOMPLETE_OVERLAP, RamanQuality.NEGATIVE_EXTINCTION)
CONCERNING: Final[Mapping[str, tuple[FlagBit, ...]]] = MappingProxyType(
    {
        "aerosol_extinction": (*_OF_SIGNALS, *_OF_SLOPE),
        "aerosol_backscatter": (
            *_OF_SIGNALS,
            RamanQuality.NO_REFERENCE,
            RamanQuality.COMMON_OVERLAP,
        ),
        "lidar_ratio": (
            *_OF_SIGNALS,
            *_OF_SLOPE,
            RamanQuality.NO_REFERENCE,
            RamanQuality.NO_LIDAR_RATIO,
        ),
        "water_vapour_mixing_ratio": (
            *_OF_SIGNALS,
            RamanQuality.DOUBTFUL_WATER_VAPOUR,
            RamanQuality.COMMON_OVERLAP,
        ),
    }
)
"""Quantity -> the bits that say something of it."""
OF_MEANS: Final = ("aerosol_extinction", "lidar_ratio")
"""Quantities that are means over ``vertical_resolution``; others are those of the cell."""
_OF_ELASTIC: Final = ("aerosol_backscatter", "lidar_ratio")
"""Quantities that are made of the elastic signal too."""


def concerning(quantity: str, found: Flags, of_elastic: Flags) -> Flags:
    """Return the bits of a quantity.

    Parameters
    ----------
    quantity : str
        One of `CONCERNING`.
    found, of_elastic : (...) int32
        Bits of the Raman signal and of the retrieval; those of the elastic signal.
    """
    bits = found | of_elastic if quantity in _OF_ELASTIC else found
    return bits & np.int32(sum(CONCERNING[quantity]))

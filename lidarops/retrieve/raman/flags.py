"""Quality bits of Raman retrievals, beside those of `lidarops.flags.Quality`."""

from __future__ import annotations

from typing import Final

from lidarops.flags import FIRST_OWN, FlagBit, Severity
from lidarops.retrieve.clouds.thresholds import THRESHOLDS

_MARGIN: Final = f"{THRESHOLDS.cloud_margin:g} m"


class RamanQuality(FlagBit):
    """Own bits. A place is never given to another bit."""

    NO_REFERENCE = (
        FIRST_OWN,
        Severity.CARE,
        (
            "no range window passes the tests for aerosol-free air, so that backscatter and lidar"
            " ratio are missing; extinction needs none"
        ),
    )
    WEAK_SIGNAL = (
        FIRST_OWN + 1,
        Severity.REJECT,
        (
            "the smoothed Raman signal is less than 5 times its standard error, or jumps so that no"
            " smooth one follows it"
        ),
    )
    NO_LIDAR_RATIO = (
        FIRST_OWN + 2,
        Severity.CARE,
        (
            "backscatter exceeds zero by too few standard errors for a lidar ratio, so that it is"
            " missing; other values are not concerned"
        ),
    )
    NEGATIVE_EXTINCTION = (
        FIRST_OWN + 3,
        Severity.REJECT,
        (
            "beyond, the Raman signal falls less than in air without particles, by more than its"
            " error: the overlap may not be full where stated, a background is wrong, or the air is"
            " not that of molecular_source"
        ),
    )
    PARTLY_CLOUDY = (
        FIRST_OWN + 4,
        Severity.CARE,
        (
            f"some of the averaged profiles, not all, show a cloud within {_MARGIN} or within the"
            " vertical resolution: the mean is that of cloudy and clear air"
        ),
    )
    CLOUD = (
        FIRST_OWN + 5,
        Severity.CARE,
        (
            f"the mean of the profiles shows a cloud within {_MARGIN} or within the vertical"
            " resolution:"
            " multiple scattering makes extinction too small, by more than its error states"
        ),
    )
    DOUBTFUL_WATER_VAPOUR = (
        FIRST_OWN + 6,
        Severity.CARE,
        (
            "water vapour is missing or may be wrong: its channel has no data, is saturated, counts"
            " too fast or has an uncertain background; other values are not concerned"
        ),
    )

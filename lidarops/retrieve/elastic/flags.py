"""Quality bits of elastic inversions, beside those of `lidarops.flags.Quality`."""

from __future__ import annotations

from typing import Final

from lidarops.flags import FIRST_OWN, STANDARD_AIR, FlagBit, care, reject
from lidarops.retrieve.clouds.thresholds import THRESHOLDS

_MARGIN: Final = f"{THRESHOLDS.cloud_margin:g} m"


class ElasticQuality(FlagBit):
    """Own bits. A place is never given to another bit."""

    CLOUD = care(
        FIRST_OWN,
        f"within {_MARGIN} of a cloud, or behind one as seen from the start of the inversion,"
        " where the lidar ratio of aerosol does not hold",
    )
    NO_REFERENCE = reject(
        FIRST_OWN + 1,
        "no range window passes the tests for aerosol-free air, so the profile is not calibrated",
    )
    UNSTABLE_INVERSION = reject(
        FIRST_OWN + 2,
        "numerically unstable (near-zero denominator), or beyond the range that the boundary"
        " value constrains",
    )
    NEGATIVE_BACKSCATTER = reject(
        FIRST_OWN + 3,
        "backscatter is below zero by several standard errors, here or between here and the"
        " start of the inversion: the signal is not as assumed (overlap, baseline, gluing)",
    )
    UNKNOWN_OVERLAP = care(
        FIRST_OWN + 4,
        "the signal shows incomplete overlap nearer than here, where it was stated to be full"
        " or not stated: it may be incomplete here too",
    )
    PARTLY_CLOUDY = care(
        FIRST_OWN + 5,
        f"some of the averaged profiles, not all, show a cloud within {_MARGIN}, or between"
        " here and the start of the inversion: the mean is that of cloudy and clear air",
    )
    STANDARD_AIR = care(FIRST_OWN + 6, STANDARD_AIR)

"""Quality bits of fits of homogeneous paths, beside those of `lidarops.flags.Quality`."""

from __future__ import annotations

from lidarops import flags
from lidarops.flags import FIRST_OWN, FlagBit, care, reject


class HomogeneousQuality(FlagBit):
    """Own bits. A place is never given to another bit."""

    POORLY_DETERMINED = FIRST_OWN, *flags.POORLY_DETERMINED
    POOR_FIT = FIRST_OWN + 1, *flags.POOR_FIT
    AT_BOUND = reject(FIRST_OWN + 2, "the extinction lies at a bound of its physical range")
    NOT_LEVEL = reject(
        FIRST_OWN + 3,
        "the altitude of the path changes by more than 100 m along the section, so a vertical"
        " gradient of backscatter would mimic extinction",
    )
    NOISE_UNCERTAIN = care(
        FIRST_OWN + 4,
        "the noise is estimated from fewer than 32 bins: more than 1 in 1000 values may differ"
        " by more than 4 standard errors, while 1.96 of them hold 95 percent",
    )

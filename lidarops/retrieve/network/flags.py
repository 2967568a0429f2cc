"""Quality bits of retrievals from beams that cross, beside those of `lidarops.flags.Quality`."""

from __future__ import annotations

from typing import Final

from lidarops import flags
from lidarops.flags import FIRST_OWN, FlagBit, Quality, rejecting


class NetworkQuality(FlagBit):
    """Own bits. A place is never given to another bit."""

    POORLY_DETERMINED = FIRST_OWN, *flags.POORLY_DETERMINED
    POOR_FIT = FIRST_OWN + 1, *flags.POOR_FIT
    PRIOR_DOMINATED = FIRST_OWN + 5, *flags.PRIOR_DOMINATED
    LOW_LEVERAGE = FIRST_OWN + 9, *flags.LOW_LEVERAGE


REJECTING: Final = rejecting((*Quality, *NetworkQuality))
"""Union of the bits that reject a value."""

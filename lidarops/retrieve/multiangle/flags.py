"""Quality bits of scans over zenith angle, beside those of `lidarops.flags.Quality`."""

from __future__ import annotations

from typing import Final

from lidarops import flags
from lidarops.flags import FIRST_OWN, FlagBit, Quality, care, reject, rejecting


class MultiAngleQuality(FlagBit):
    """Own bits. A place is never given to another bit."""

    NEGATIVE_OPTICAL_DEPTH = care(
        FIRST_OWN + 2,
        "the optical depth is below zero, or falls with altitude, by more than 2 standard"
        " errors: keep it in means, which would be biased without such values",
    )
    NO_LEVERAGE = reject(
        FIRST_OWN + 3, "the zenith angles are too few or too similar to determine an optical depth"
    )
    POOR_STRATIFICATION = reject(
        FIRST_OWN + 4,
        "the signals of the slant paths differ by more than level layers allow: by the air, or"
        " by distorted signals of near ranges, of an analog channel or of a dead time that is"
        " wrong or stated too exactly",
    )
    PRIOR_DOMINATED = FIRST_OWN + 5, *flags.PRIOR_DOMINATED
    EXTRAPOLATED = reject(
        FIRST_OWN + 6,
        "beyond the reach of the signals, where only the prior would determine the value",
    )
    INTERPOLATED = care(
        FIRST_OWN + 7, "in a gap of the data, interpolated from the altitudes above and below"
    )
    NO_RESIDUAL = care(
        FIRST_OWN + 10, "there are as many unknowns as angles, so no residual tests the result"
    )


CARE: Final = Quality.PILE_UP | Quality.SINGLE_RECORD | Quality.BACKGROUND_UNCERTAIN
"""Bits that a bin passes on to every result that uses it."""
REJECTING: Final = rejecting((*Quality, *MultiAngleQuality))
"""Union of the bits that reject a value."""

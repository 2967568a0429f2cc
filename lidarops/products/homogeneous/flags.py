"""Quality bits that products of kind ``homogeneous`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Flags, Quality
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

FLAGS: Final = Flags(
    kind="homogeneous",
    version=2,
    bits=(
        Quality.INPUT_MISSING,
        Quality.SATURATED,
        Quality.PILE_UP,
        Quality.INCOMPLETE_OVERLAP,
        Quality.TOO_FEW_BINS,
        Quality.NO_SIGNAL,
        Quality.LOW_SIGNAL,
        Quality.NEGATIVE_AMPLITUDE,
        Quality.NOT_HOMOGENEOUS,
        Quality.OUTLIER,
        Quality.NO_REAL_SOLUTION,
        Quality.BACKGROUND_UNCERTAIN,
        *HomogeneousQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

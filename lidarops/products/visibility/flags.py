"""Quality bits that products of kind ``visibility`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Flags, Quality
from lidarops.retrieve.network.flags import NetworkQuality

FLAGS: Final = Flags(
    kind="visibility",
    version=2,
    bits=(
        Quality.INPUT_MISSING,
        Quality.PILE_UP,
        Quality.LOW_SIGNAL,
        Quality.SINGLE_RECORD,
        Quality.OUTLIER,
        Quality.NO_REAL_SOLUTION,
        Quality.BACKGROUND_UNCERTAIN,
        *NetworkQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

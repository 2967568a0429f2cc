"""Quality bits that products of kind ``raman`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Flags, Quality
from lidarops.retrieve.raman.flags import RamanQuality

FLAGS: Final = Flags(
    kind="raman",
    version=1,
    bits=(
        Quality.INPUT_MISSING,
        Quality.SATURATED,
        Quality.PILE_UP,
        Quality.INCOMPLETE_OVERLAP,
        Quality.SINGLE_RECORD,
        Quality.LOW_SIGNAL_TO_NOISE,
        Quality.BACKGROUND_UNCERTAIN,
        Quality.NO_GLUING,
        *RamanQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

"""Quality bits that products of kind ``signal`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Flags, Quality

FLAGS: Final = Flags(
    kind="signal",
    version=2,
    bits=(
        Quality.INPUT_MISSING,
        Quality.SATURATED,
        Quality.PILE_UP,
        Quality.INCOMPLETE_OVERLAP,
        Quality.SINGLE_RECORD,
        Quality.NO_REAL_SOLUTION,
        Quality.LOW_SIGNAL_TO_NOISE,
        Quality.BACKGROUND_UNCERTAIN,
        Quality.NO_GLUING,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

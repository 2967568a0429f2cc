"""Quality bits that products of kind ``multiangle`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import COMPARED_BITS, SIGNAL_BITS, Flags
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

FLAGS: Final = Flags(
    kind="multiangle",
    version=3,
    bits=(*sorted(SIGNAL_BITS + COMPARED_BITS), *MultiAngleQuality),
)
"""Published places are in `tests/products/test_flags.py`."""

"""Quality bits that products of kind ``elastic`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import SIGNAL_BITS, Flags
from lidarops.retrieve.elastic.flags import ElasticQuality

FLAGS: Final = Flags(kind="elastic", version=3, bits=(*SIGNAL_BITS, *ElasticQuality))
"""Published places are in `tests/products/test_flags.py`."""

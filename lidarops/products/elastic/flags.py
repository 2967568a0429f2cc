"""Quality bits that products of kind ``elastic`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Flags, Quality
from lidarops.retrieve.elastic.flags import ElasticQuality

FLAGS: Final = Flags(
    kind="elastic",
    version=2,
    bits=(
        Quality.INPUT_MISSING,
        Quality.SATURATED,
        Quality.PILE_UP,
        Quality.INCOMPLETE_OVERLAP,
        Quality.OUTLIER,
        Quality.BACKGROUND_UNCERTAIN,
        Quality.NO_GLUING,
        *ElasticQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

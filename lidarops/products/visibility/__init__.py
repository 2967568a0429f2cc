"""Product kind ``visibility``: extinction and visibility where beams of lidars cross."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.products.visibility.settings import VisibilityProductSettings

KIND: Final = Kind(
    name="visibility",
    title="Visibility",
    package=__name__,
    settings=VisibilityProductSettings,
    rank=10,
)

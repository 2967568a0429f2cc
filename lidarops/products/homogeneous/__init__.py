"""Product kind ``homogeneous``: extinction and amplitude of homogeneous range sections."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.products.homogeneous.settings import HomogeneousSettings

KIND: Final = Kind(
    name="homogeneous",
    title="Extinction of homogeneous sections",
    package=__name__,
    settings=HomogeneousSettings,
    rank=20,
    expects_usable=False,
)

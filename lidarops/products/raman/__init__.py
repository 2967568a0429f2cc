"""Product kind ``raman``: extinction, backscatter and lidar ratio, from Raman signals."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.products.raman.settings import RamanProductSettings

KIND: Final = Kind(
    name="raman",
    title="Extinction and lidar ratio of Raman signals",
    package=__name__,
    settings=RamanProductSettings,
    rank=45,
    expects_usable=False,
)

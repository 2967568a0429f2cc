"""Product kind ``elastic``: backscatter and extinction of aerosol, from a lidar ratio."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.products.elastic.settings import ElasticSettings

KIND: Final = Kind(
    name="elastic",
    title="Backscatter of elastic profiles",
    package=__name__,
    settings=ElasticSettings,
    rank=40,
)

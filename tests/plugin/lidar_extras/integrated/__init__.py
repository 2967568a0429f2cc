"""Product kind ``integrated``: the range-corrected signal, integrated over windows of range."""

from __future__ import annotations

from typing import Final

from lidar_extras.integrated.settings import IntegratedSettings
from lidarops.kinds import Kind

KIND: Final = Kind(
    name="integrated",
    title="Integrated signals",
    package=__name__,
    settings=IntegratedSettings,
    rank=95,
)

"""The variables of the product ``monthly``."""

from __future__ import annotations

from typing import Final

from lidar_extras.averaged.variables import layout_of_means

LAYOUT: Final = layout_of_means("monthly", "Mean lidar signals of the scenes of a month")

"""The variables of the ``integrated`` product."""

from __future__ import annotations

from typing import Final

from lidar_extras.integrated.flags import FLAGS
from lidarops.netcdf.variables import (
    GLUING,
    NO_STANDARD_NAME,
    SUBTRACTED_BACKGROUND,
    Coverage,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    shots,
)

_WINDOWS = ("time", "window")
_ALONG = (
    Row(
        name="window",
        dims=("window",),
        dtype="i4",
        units="1",
        long_name="number of the window",
        coverage=Coverage.COORDINATE,
    ),
    Row(
        name="window_range",
        dims=("window",),
        dtype="f8",
        units="m",
        long_name="distance from the lidar along the beam, midpoint of the window",
        coverage=Coverage.COORDINATE,
        bounds="window_bounds",
    ),
)

LAYOUT: Final = Layout(
    title="Integrated lidar signals",
    summary="Background-subtracted and range-corrected signals of one lidar channel, integrated"
    " over windows of range, with their standard errors.",
    keywords=("EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",),
    processing_level="L2: integrals of signals, not calibrated in power",
    references=(),
    comment="A bin belongs to a window if its centre does. The standard error includes that of the"
    " background, which is common to the bins.",
    sampled="window",
    coordinates=coordinates(_ALONG, altitude("window")),
    data=(
        Row(
            name="integral",
            dims=_WINDOWS,
            dtype="f4",
            units="{signal} m3",
            long_name="integral of the range-corrected signal over the window",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("bins", "quality_flag", "shots"),
            uncertain=True,
            comment=f"Not calibrated. {NO_STANDARD_NAME}",
        ),
        Row(
            name="bins",
            dims=("window",),
            dtype="i4",
            units="1",
            standard_name="number_of_observations",
            long_name="number of bins in the window",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
        ),
        SUBTRACTED_BACKGROUND,
        *GLUING,
        quality(FLAGS),
        shots(of="the profile"),
    ),
)
"""Layout of the product."""

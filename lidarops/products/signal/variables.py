"""The variables of the ``signal`` product."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Quality
from lidarops.netcdf.variables import (
    GLUING,
    NO_NAME,
    RANGE,
    Coverage,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    shots,
)

SIGNAL: Final = Layout(
    title="Range-corrected lidar signals",
    summary="Signals of one lidar channel, background-subtracted and range-corrected, with their"
    " standard errors.",
    keywords=("EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",),
    processing_level="L1: calibrated in range and time, not in power",
    references=("Licel GmbH (2023): Licel raw data format.",),
    comment="The standard errors of the range bins of one profile share the error of its"
    " background.",
    sampled="range",
    unused_steps=frozenset({"average", "molecular", "known_shape", "reference"}),
    coordinates=coordinates((RANGE,), altitude("range")),
    data=(
        Row(
            name="signal",
            dims=("time", "range"),
            dtype="f4",
            units="{signal} m2",
            long_name="background-subtracted signal times the square of range",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=("quality_flag", "shots"),
            significant_bits=13,
            uncertain=True,
            comment=f"Not calibrated. {NO_NAME}",
        ),
        Row(
            name="background",
            dims=("time",),
            dtype="f4",
            units="{signal}",
            long_name="background that was subtracted: sky light, dark current and offset",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("shots",),
            uncertain=True,
            comment=f"Not calibrated. {NO_NAME}",
        ),
        *GLUING,
        quality(
            ("time", "range"),
            Quality.INPUT_MISSING
            | Quality.SATURATED
            | Quality.PILE_UP
            | Quality.INCOMPLETE_OVERLAP
            | Quality.BACKGROUND_UNCERTAIN
            | Quality.NO_GLUING,
        ),
        shots(of="the profile"),
    ),
)
"""What the product holds."""

"""The variables of the ``signal`` product."""

from __future__ import annotations

from typing import Final

from lidarops.netcdf.variables import (
    BACKGROUND_METHOD,
    GLUING,
    MEASURED_SHARES,
    NO_STANDARD_NAME,
    RANGE,
    SUBTRACTED_BACKGROUND,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    shots,
)
from lidarops.products.signal.flags import FLAGS

LAYOUT: Final = Layout(
    title="Range-corrected lidar signals",
    summary="Background-subtracted and range-corrected signals of one lidar channel, with their"
    " standard errors.",
    keywords=("EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",),
    processing_level="L1: calibrated in range and time, not in power",
    references=("Licel GmbH (2023): Licel raw data format.",),
    comment="The standard errors of all range bins of a profile include the error of its"
    " background, which is common to them. lidarops_steps states the method of the background."
    " Where the noise of an analog record is below half a step of the digitizer, its bins share"
    " their rounding error: the standard error of a bin covers it, that of a mean over bins does"
    f" not. {MEASURED_SHARES}",
    sampled="range",
    weighed=("signal",),
    coordinates=coordinates((RANGE,), altitude("range")),
    data=(
        Row(
            name="signal",
            dims=("time", "range"),
            dtype="f4",
            units="{signal} m2",
            long_name="background-subtracted signal times range squared",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=("quality_flag", "shots"),
            significant_bits=13,
            uncertain=True,
            comment=f"Not calibrated. {NO_STANDARD_NAME}",
        ),
        Row(
            name="signal_dead_time_error",
            dims=("time", "range"),
            dtype="f4",
            units="{signal} m2",
            long_name="change of the signal with one standard error of the dead time",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            optional=True,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Of channels with photon counting. All ranges and profiles share it. Not part"
            f" of signal_standard_error. {NO_STANDARD_NAME}",
        ),
        Row(
            name="signal_baseline_error",
            dims=("time", "range"),
            dtype="f4",
            units="{signal} m2",
            long_name="change of the signal with one standard error of the analog baseline",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            optional=True,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Of analog and glued channels: a voltage without light that varies slowly with"
            " range. All ranges and profiles share it, with a shape that is not known. Not part of"
            f" signal_standard_error. {NO_STANDARD_NAME}",
        ),
        BACKGROUND_METHOD,
        SUBTRACTED_BACKGROUND,
        Row(
            name="noise_correlation_length",
            dims=("time",),
            dtype="f4",
            units="1",
            long_name="integral correlation length of noise along range in range bins",
            coverage=Coverage.AUXILIARY,
            comment="Of the far half of the profile; of glued channels at least that of the analog"
            " record. 1 where bins are independent; missing where too few are complete, and"
            " standard errors then assume independent bins. The standard error by noise of a mean"
            " over many bins is that of a bin times the root of this number over their number."
            f" {NO_STANDARD_NAME}",
        ),
        *GLUING,
        quality(("time", "range"), FLAGS),
        shots(of="the profile"),
    ),
)
"""Layout of the product."""

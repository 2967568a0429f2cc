"""The variables and quality bits of the ``signal`` product."""

from __future__ import annotations

from typing import Final

from lidarops.flags import RAW_BITS, Flags, Quality
from lidarops.netcdf.variables import (
    ALONG_BEAM,
    BACKGROUND_METHOD,
    GLUING,
    MEASURED_SHARES,
    SUBTRACTED_BACKGROUND,
    Error,
    Layout,
    Row,
    per_profile,
    quality,
    shots,
)

FLAGS: Final = Flags(
    kind="signal",
    version=2,
    bits=(
        *RAW_BITS,
        Quality.SINGLE_RECORD,
        Quality.NO_REAL_SOLUTION,
        Quality.LOW_SIGNAL_TO_NOISE,
        Quality.BACKGROUND_UNCERTAIN,
        Quality.NO_GLUING,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

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
    coordinates=ALONG_BEAM,
    data=(
        Row(
            "signal",
            "background-subtracted signal times range squared",
            "Not calibrated.",
            units="{signal} m2",
            ancillaries=("quality_flag", "shots"),
            bits=13,
            uncertain=True,
            errors=(
                Error(
                    "dead_time",
                    "change of the signal with one standard error of the dead time",
                    comment="Of channels with photon counting. All ranges and profiles share it."
                    " Not part of signal_standard_error.",
                    signed=True,
                    optional=True,
                ),
                Error(
                    "baseline",
                    "change of the signal with one standard error of the analog baseline",
                    comment="Of analog and glued channels: a voltage without light that varies"
                    " slowly with range. All ranges and profiles share it, with a shape that is not"
                    " known. Not part of signal_standard_error.",
                    signed=True,
                    optional=True,
                ),
            ),
        ),
        BACKGROUND_METHOD,
        SUBTRACTED_BACKGROUND,
        per_profile(
            "noise_correlation_length",
            "integral correlation length of noise along range in range bins",
            "Of the far half of the profile; of glued channels at least that of the analog record."
            " 1 where bins are independent; missing where too few are complete, and standard errors"
            " then assume independent bins. The standard error by noise of a mean over many bins is"
            " that of a bin times the root of this number over their number.",
        ),
        *GLUING,
        quality(FLAGS),
        shots(of="the profile"),
    ),
)

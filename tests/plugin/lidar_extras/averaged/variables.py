"""The variables of the products ``averaged`` and ``monthly``."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Flags
from lidarops.kinds import flags_of
from lidarops.netcdf.variables import ALONG_BEAM, Layout, Row, quality


def layout_of_means(kind: str, title: str) -> Layout:
    """Return the layout of a kind of product of mean signals, with the bits of ``signal``."""
    return Layout(
        title=title,
        summary="Range-corrected signals of one lidar channel, averaged over scenes.",
        keywords=("EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",),
        processing_level="L3: means of signals, not calibrated in power",
        references=(),
        comment="A bin carries the bits of all its profiles.",
        sampled="range",
        coordinates=ALONG_BEAM,
        data=(
            Row(
                "mean_signal",
                "mean over a scene of the background-subtracted signal times range squared",
                "Not calibrated.",
                units="{signal} m2",
                ancillaries=("quality_flag",),
            ),
            quality(Flags(kind=kind, version=1, bits=tuple(flags_of("signal")))),
        ),
    )


LAYOUT: Final = layout_of_means("averaged", "Mean lidar signals of a scene")

"""The variables of clouds, which kinds of mean profiles share."""

from __future__ import annotations

from typing import Final

from lidarops.netcdf.variables import NO_STANDARD_NAME, Coverage, Row
from lidarops.retrieve.clouds.thresholds import THRESHOLDS as CLOUD_THRESHOLDS
from lidarops.retrieve.signal.thresholds import THRESHOLDS

CLOUD_MASK: Final = "cloud_mask"
CLOUD_FRACTION: Final = "cloud_fraction"
CLOUDS: Final = (
    Row(
        name=CLOUD_MASK,
        dims=("time", "range"),
        dtype="i1",
        units="1",
        standard_name="status_flag",
        long_name="clouds and dense layers in the mean profile",
        coverage=Coverage.AUXILIARY,
        states=("clear", "partly_cloudy", "cloudy", "unknown"),
        comment="partly_cloudy: some of the averaged profiles show a cloud, not all. cloudy:"
        " all of them do, or their mean does. unknown: no usable data, the overlap may be"
        " incomplete, or noise would hide a cloud: in the noise of the mean,"
        f" {CLOUD_THRESHOLDS.visible_depth:g} m with"
        f" {CLOUD_THRESHOLDS.visible_excess:g} times the least excess over air that makes a cloud"
        " would not be found. From base to apparent top: beyond a cloud that attenuates strongly"
        " there may be more. Profiles that are left out, or have no data there, do not count.",
    ),
    Row(
        name=CLOUD_FRACTION,
        dims=("time", "range"),
        dtype="f4",
        units="1",
        long_name="share of the averaged profiles in which a cloud or dense layer is detected",
        coverage=Coverage.AUXILIARY,
        valid_min=0.0,
        valid_max=1.0,
        comment="The profiles of a mean are divided into up to"
        f" {THRESHOLDS.most_parts} parts, and clouds are sought in each, in cells of"
        f" about {THRESHOLDS.cell_length:g} m; only those with data there count. Missing"
        " where no part has any, where cloud_mask is unknown, or where only the mean shows a"
        f" cloud, so that cloud_mask is cloudy. {NO_STANDARD_NAME}",
    ),
    Row(
        name="cloud_base_range",
        dims=("time",),
        dtype="f4",
        units="m",
        long_name="range at which the lowest cloud or dense layer begins",
        coverage=Coverage.AUXILIARY,
        comment="Of all profiles in the mean. Missing where no cloud or dense layer was"
        f" detected. {NO_STANDARD_NAME}",
    ),
    Row(
        name="cloud_base_altitude",
        dims=("time",),
        dtype="f4",
        units="m",
        standard_name="cloud_base_altitude",
        long_name="altitude above the geoid at which the lowest cloud or dense layer begins",
        coverage=Coverage.AUXILIARY,
        comment="Of all profiles in the mean. Missing where no cloud or dense layer was detected.",
    ),
    Row(
        name="cloud_top_altitude",
        dims=("time",),
        dtype="f4",
        units="m",
        standard_name="cloud_top_altitude",
        long_name="altitude above the geoid of the apparent top of the highest cloud or dense"
        " layer",
        coverage=Coverage.AUXILIARY,
        comment="Of all profiles in the mean: where the ratio to air falls no more, or noise"
        " hides that it does: then this is below the true top. Missing where no cloud or dense"
        " layer was detected.",
    ),
)
"""Of `lidarops.retrieve.clouds.labeled.Clouds`."""

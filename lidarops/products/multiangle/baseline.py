"""Blocked beams of the product ``multiangle``, and the analog baseline that they show."""

from __future__ import annotations

from typing import Final

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.products.multiangle import MultiAngleSettings
from lidarops.records import DetectionMode
from lidarops.retrieve.multiangle.analog_baseline import AnalogBaseline, BlockedBeams
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.scene.case import ChannelCase, Entry
from lidarops.scene.profiles import Chunk, Profiles
from lidarops.scene.retrieval import Workload

_UNKNOWN: Final = np.int32(Quality.INPUT_MISSING | Quality.SATURATED)
"""Bits of bins that show nothing; what blocks a beam may stand where the overlap is incomplete."""
_NAMED: Final = 6
"""Most blocked beams that notes name."""
_TOGETHER: Final = 8
"""Profiles that are averaged together; the result does not depend on it."""


def plan_baseline(case: ChannelCase[MultiAngleSettings]) -> Entry:
    """Subtract the analog baseline that blocked beams show.

    For analog channels of scans with beams so low that they may be blocked.
    """
    if case.channel.mode is DetectionMode.PHOTON:
        return case.leave("baseline", "photon counting has no analog baseline")
    angles = [granule.zenith_angle for granule in case.scene.granules]
    lowest = 90.0 - max((angle for angle in angles if angle is not None), default=0.0)
    limit = f"{THRESHOLDS.lowest_free:g} degree above the horizon"
    if lowest >= THRESHOLDS.lowest_free:
        reason = f"no beam is lower than {limit}, where trees and buildings may block it"
        return case.leave("baseline", reason, number=lowest)
    reason = (
        f"beams lower than {limit} may be blocked: decided from the data, from what lies"
        " behind obstructions"
    )
    taken = ("noise", "glue", "background")
    return case.run("baseline", reason, needs=taken, number=lowest)


def held_of_low_beams(work: Workload) -> float:
    """Return the bytes of the low beams that are averaged together."""
    # So low that they may be blocked.
    limit = 90.0 - THRESHOLDS.lowest_free
    low = sum((granule.zenith_angle or 0.0) > limit for granule in work.scene.granules)
    return _BYTES_OF_A_BIN * min(_TOGETHER, low) * work.bins


_BYTES_OF_A_BIN: Final = 90.0
"""Bytes per bin of a low beam while it is averaged, at the peak."""


def add_low_beams(beams: BlockedBeams, chunk: Chunk, profiles: Profiles) -> None:
    """Take the beams of a chunk that are so low that they may be blocked."""
    conditioned, first = chunk.profiles(profiles), chunk.rows.start
    elevation = 90.0 - chunk.geometry["zenith_angle"].to_numpy()
    low = np.flatnonzero(elevation < THRESHOLDS.lowest_free)
    for start in range(0, low.size, _TOGETHER):
        rows = low[start : start + _TOGETHER]
        power, variance, quality, length = (
            conditioned[name].to_numpy()[rows]
            for name in ("power", "variance", "quality", CORRELATION_LENGTH)
        )
        missing = (quality & _UNKNOWN) != 0
        values = np.where(missing, np.nan, power)
        beams.add(values, variance * length[:, np.newaxis], first + rows)


def blocked_in_words(product: xr.Dataset) -> list[str]:
    """Return one note on the low beams that are blocked; none where all are free.

    Channels with the same blocked beams have the same note, so that it is reported once: the range
    is that of the product. Obstructions of steeper beams are clouds.
    """
    known = product["beam_obstruction"].notnull().any("time").to_numpy()
    elevation = 90.0 - product["beam_zenith_angle"].to_numpy()
    blocked = np.flatnonzero(known & (elevation < THRESHOLDS.lowest_free))
    if not blocked.size:
        return []
    sides = product["beam_azimuth"].to_numpy() if "beam_azimuth" in product.coords else None
    beams = [
        f"{elevation[beam]:.3g}" + ("" if sides is None else f" (azimuth {sides[beam]:.3g})")
        for beam in blocked
    ]
    more = f" and {blocked.size - _NAMED} more" if blocked.size > _NAMED else ""
    return [
        (
            f"blocked beams: elevation {', '.join(beams[:_NAMED])}{more}"
            " degree, from the range in beam_obstruction of the product"
        )
    ]


def with_baseline(
    product: xr.Dataset, baseline: AnalogBaseline, geometry: xr.Dataset
) -> xr.Dataset:
    """Return a product with the baseline that was subtracted, and the profiles that show it."""
    blocked = {
        f"blocked_{name}": ("blocked", geometry[name].to_numpy()[baseline.profile])
        for name in ("zenith_angle", "azimuth")
        if name in geometry
    }
    return product.assign(
        {
            "analog_baseline": ("baseline_range", baseline.power),
            "analog_baseline_standard_error": ("baseline_range", baseline.standard_error),
            "blocked_range": ("blocked", baseline.obstruction),
            **blocked,
        }
    ).assign_coords(baseline_range=baseline.range)

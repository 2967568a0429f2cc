"""Step of the product ``multiangle``: the analog baseline, from beams that are blocked."""

from __future__ import annotations

from typing import Final

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.products.multiangle.settings import MultiAngleSettings
from lidarops.records import DetectionMode
from lidarops.retrieve.multiangle.analog_baseline import AnalogBaseline, BlockedBeams
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.steps.case import ProductCase
from lidarops.steps.conditioning import PROFILES
from lidarops.steps.data import BackgroundSettings, Data
from lidarops.steps.preparation import BACKGROUND
from lidarops.steps.reading import ARCHIVE
from lidarops.steps.step import Datum, Decisions, Leave, NoSettings, Run, Step
from lidarops.steps.workload import Workload

BASELINE: Final = Datum[AnalogBaseline]("baseline")
_UNKNOWN: Final = np.int32(Quality.INPUT_MISSING | Quality.SATURATED)
"""Bits of bins that show nothing; what blocks a beam may stand where the overlap is incomplete."""
_TOGETHER: Final = 32
"""Profiles that are read together; the result does not depend on it."""


class Baseline(Step[ProductCase[MultiAngleSettings], NoSettings]):
    """Subtract the analog baseline that blocked beams show."""

    name = "baseline"
    inputs = (ARCHIVE, PROFILES, BACKGROUND)
    outputs = (BASELINE,)

    def decide(self, case: ProductCase[MultiAngleSettings]) -> Decisions:
        """Run for analog channels of scans with beams so low that they may be blocked."""
        if case.channel.mode is DetectionMode.PHOTON:
            yield Leave("photon counting has no analog baseline")
            return
        angles = [granule.zenith_angle for granule in case.scene.granules]
        lowest = 90.0 - max((angle for angle in angles if angle is not None), default=0.0)
        limit = f"{THRESHOLDS.lowest_free:g} degree above the horizon"
        if lowest >= THRESHOLDS.lowest_free:
            reason = f"no beam is lower than {limit}, where trees and buildings may block it"
            yield Leave(reason, number=lowest)
        else:
            reason = (
                f"beams lower than {limit} may be blocked: decided from the data, from what lies"
                " behind obstructions"
            )
            yield Run(reason, number=lowest)

    def carry_out(self, settings: NoSettings, data: Data) -> None:  # noqa: ARG002
        """Give the baseline, where a beam is blocked."""
        baseline = _baseline(data, data[BACKGROUND])
        if baseline is not None:
            data[BASELINE] = baseline

    def cpu_time(self, settings: NoSettings, work: Workload) -> float:  # noqa: ARG002
        """Return the CPU time by the number of bins of low beams, s."""
        return 4e-7 * _low_profiles(work) * work.bins

    def held(self, settings: NoSettings, work: Workload) -> float:  # noqa: ARG002
        """Return the bytes of the profiles that are read together."""
        return _BYTES_OF_A_BIN * min(_TOGETHER, _low_profiles(work)) * work.bins


_BYTES_OF_A_BIN: Final = 90.0
"""Bytes per bin of a profile that is read for the baseline, at the peak."""


def _low_profiles(work: Workload) -> int:
    """Return the number of profiles so low that they may be blocked."""
    limit = 90.0 - THRESHOLDS.lowest_free
    return sum((granule.zenith_angle or 0.0) > limit for granule in work.scene.granules)


def _baseline(data: Data, background: BackgroundSettings) -> AnalogBaseline | None:
    archive, profiles = data[ARCHIVE], data[PROFILES]
    low = 90.0 - archive["zenith_angle"].to_numpy() < THRESHOLDS.lowest_free
    rows = np.flatnonzero(low)
    beams = BlockedBeams(profiles.range, background.range)
    for first in range(0, rows.size, _TOGETHER):
        members = rows[first : first + _TOGETHER]
        part = profiles.of(archive.isel(time=members))
        power, variance, quality, length = (
            part[name].to_numpy() for name in ("power", "variance", "quality", CORRELATION_LENGTH)
        )
        missing = (quality & _UNKNOWN) != 0
        beams.add(np.where(missing, np.nan, power), variance * length[:, np.newaxis], members)
    return beams.baseline()


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

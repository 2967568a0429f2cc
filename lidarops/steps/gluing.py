"""Glue an analog and a photon-counting channel of one detector."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.retrieve.signal import labeled_gluing
from lidarops.settings import SettingsModel
from lidarops.steps.case import ChannelCase
from lidarops.steps.channels import LAG_STEP, glued_parts
from lidarops.steps.conditioning import PROFILES
from lidarops.steps.data import Data, Profiles
from lidarops.steps.profiles import GluedProfiles
from lidarops.steps.reading import ARCHIVE
from lidarops.steps.step import Datum, Decisions, Leave, Run, Step
from lidarops.steps.workload import Workload

LAG: Final = Datum[bool]("lag")
"""Whether the lag is to be estimated."""
_AT_ONCE: Final = 32
"""Profiles that are conditioned together for an estimate of the lag."""


class LagSettings(SettingsModel):
    """Settings of the step ``lag``."""

    method: Literal["estimate", "given"]
    lag: float | None = None
    """Bins, with the method ``given``."""


class Lag(Step[ChannelCase, LagSettings]):
    """Find the lag of the analog record behind the photon-counting one."""

    name = LAG_STEP
    settings = LagSettings
    outputs = (LAG,)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run where the campaign gives a lag or requests an estimate."""
        lag = channel_facts(case.facts, glued_parts(case.channel.name)[0]).lag
        if lag is None:
            yield Leave("the campaign gives no lag and requests no estimate; headers state 0")
        elif lag == "estimate":
            reason = "the campaign requests an estimate, from noise common to both records"
            yield Run(reason, LagSettings(method="estimate"))
        else:
            settings = LagSettings(method="given", lag=lag)
            yield Run("given by the campaign", settings, number=lag)

    def carry_out(self, settings: LagSettings, data: Data) -> None:
        """Give whether the lag is to be estimated; a given one has shifted the analog ranges."""
        data[LAG] = settings.method == "estimate"

    def held(self, settings: LagSettings, work: Workload) -> float:
        """Return the bytes of the profiles from which a lag is estimated."""
        if settings.method == "given":
            return 0.0
        profiles = min(labeled_gluing.LAG_PROFILES, len(work.scene.granules))
        return _BYTES_OF_A_LAG_BIN * profiles * work.bins


_BYTES_OF_A_LAG_BIN: Final = 65.0
"""Bytes per bin of a profile of the estimate."""


class GlueSettings(SettingsModel):
    """Settings of the step ``glue``."""

    analog: str
    photon: str


class Glue(Step[ChannelCase, GlueSettings]):
    """Glue the profiles of both channels."""

    name = "glue"
    settings = GlueSettings
    inputs = (ARCHIVE, LAG)
    from_parts = (PROFILES,)
    outputs = (PROFILES,)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run always: the channel is there because a product needs it."""
        analog, photon = glued_parts(case.channel.name)
        settings = GlueSettings(analog=analog, photon=photon)
        yield Run("the campaign requests the glued channel", settings)

    def carry_out(self, settings: GlueSettings, data: Data) -> None:
        """Give the glued profiles."""
        analog, photon = (data.channels[part] for part in (settings.analog, settings.photon))
        lag = labeled_gluing.range_lag(analog[PROFILES].range, photon[PROFILES].range)
        if data.get(LAG):
            powers = (_first_profiles(part) for part in (analog, photon))
            lag = labeled_gluing.estimate_lag(*powers, known=lag)
        data[PROFILES] = GluedProfiles(analog[PROFILES], photon[PROFILES], lag)


def _first_profiles(part: Data) -> npt.NDArray[np.float64]:
    """Return the power of the first profiles of a scene, (time, range)."""
    archive, profiles = part[ARCHIVE], part[PROFILES]
    count = min(labeled_gluing.LAG_PROFILES, archive.sizes["time"])
    return np.concatenate(
        [
            _power(profiles, archive.isel(time=slice(first, min(first + _AT_ONCE, count))))
            for first in range(0, count, _AT_ONCE)
        ]
    )


def _power(profiles: Profiles, counts: xr.Dataset) -> npt.NDArray[np.float64]:
    power: npt.NDArray[np.float64] = profiles.of(counts)["power"].to_numpy()
    return power

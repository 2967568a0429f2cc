"""Glue an analog and a photon-counting channel of one detector."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Final, Literal, cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.retrieve.signal import labeled_gluing
from lidarops.retrieve.signal.lag import PROFILES_AT_ONCE, enough_bins, profile_groups
from lidarops.settings import SettingsModel, quantity
from lidarops.steps.case import ChannelCase
from lidarops.steps.channels import LAG_STEP, glued_parts, lag_is_unknown
from lidarops.steps.conditioning import PROFILES
from lidarops.steps.data import Data
from lidarops.steps.profiles import FileProfiles, GluedProfiles
from lidarops.steps.reading import ARCHIVE
from lidarops.steps.step import Datum, Decisions, Leave, Run, Step
from lidarops.steps.workload import Workload

_Power = npt.NDArray[np.float64]

LAG: Final = Datum[bool]("lag")
"""Whether the lag is to be estimated."""


class LagSettings(SettingsModel):
    """Settings of the step ``lag``."""

    method: Literal["estimate", "given"]
    lag: float | None = quantity(None, unit="bins", description="with the method ``given``")


class Lag(Step[ChannelCase, LagSettings]):
    """Find the lag of the analog record behind the photon-counting one."""

    name = LAG_STEP
    settings = LagSettings
    outputs = (LAG,)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run but where the ranges of the campaign state the lag; estimate one that it omits."""
        analog, photon = glued_parts(case.channel.name)
        lag = channel_facts(case.facts, analog).lag
        if isinstance(lag, float):
            settings = LagSettings(method="given", lag=lag)
            yield Run("given by the campaign", settings, number=lag)
        elif not enough_bins(case.channel.bins):
            yield Leave(f"the {case.channel.bins} bins are too few for an estimate")
        elif not lag_is_unknown(case.facts, analog, photon):
            yield Leave("the range offsets that the campaign gives for both channels state the lag")
        else:
            estimate = "requests an estimate," if lag else "gives none: estimated"
            reason = f"the campaign {estimate} from noise common to both records"
            yield Run(reason, LagSettings(method="estimate"))

    def carry_out(self, settings: LagSettings, data: Data) -> None:
        """Give whether the lag is to be estimated; a given one has shifted the analog ranges."""
        data[LAG] = settings.method == "estimate"


_BYTES_OF_A_LAG_BIN: Final = 65.0
"""Bytes per bin of a profile of the estimate of a lag; gluing takes four times as many."""


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
        ranges = (part[PROFILES].range for part in (analog, photon))
        lag = labeled_gluing.ChannelLag(labeled_gluing.range_lag(*ranges))
        if data.get(LAG):
            lag = labeled_gluing.estimate_lag(_groups(analog, photon), known=lag.bins)
        # Parts of a glued channel are channels of the files.
        of_analog, of_photon = (cast("FileProfiles", part[PROFILES]) for part in (analog, photon))

        archives = analog[ARCHIVE], photon[ARCHIVE]

        @functools.cache
        def slope() -> labeled_gluing.Slope:
            return labeled_gluing.scene_slope(_samples(archives, (of_analog, of_photon)), lag)

        data[PROFILES] = GluedProfiles(of_analog, of_photon, lag, slope)

    def held(self, settings: GlueSettings, work: Workload) -> float:  # noqa: ARG002
        """Return the bytes of the profiles from which lag and slope are taken."""
        profiles = min(PROFILES_AT_ONCE, len(work.scene.granules))
        return _BYTES_OF_A_LAG_BIN * profiles * work.bins


def _groups(analog: Data, photon: Data) -> Iterator[tuple[_Power, _Power]]:
    """Yield the power of the first profiles of a scene in both channels, (time, range)."""
    count = min(labeled_gluing.LAG_PROFILES, analog[ARCHIVE].sizes["time"])
    for rows in profile_groups(count):
        yield _power(analog, rows), _power(photon, rows)


def _samples(
    archives: tuple[xr.Dataset, xr.Dataset], profiles: tuple[FileProfiles, FileProfiles]
) -> Iterator[tuple[xr.Dataset, xr.Dataset]]:
    """Yield profiles of both channels from all over a scene, some at a time."""
    number, together = archives[0].sizes["time"], PROFILES_AT_ONCE // 4
    rows = np.unique(np.linspace(0, number - 1, labeled_gluing.SLOPE_PROFILES).astype(int))
    for first in range(0, rows.size, together):
        some = rows[first : first + together]
        both = zip(archives, profiles, strict=True)
        one, other = (of_channel.of(counts.isel(time=some)) for counts, of_channel in both)
        yield one, other


def _power(part: Data, rows: slice) -> _Power:
    counts = part[ARCHIVE].isel(time=rows)
    power: _Power = part[PROFILES].of(counts)["power"].to_numpy()
    return power

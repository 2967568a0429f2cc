"""Glue an analog and a photon-counting channel of one detector."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.records import glued_parts
from lidarops.retrieve.signal import labeled_gluing
from lidarops.retrieve.signal.lag import PROFILES_AT_ONCE, ChannelLag, enough_bins, profile_groups
from lidarops.scene.case import LAG_STEP, ChannelCase, Entry, lag_is_unknown
from lidarops.scene.profiles import ChannelSignal, FileProfiles, GluedProfiles
from lidarops.settings import SettingsModel, quantity

_Power = npt.NDArray[np.float64]


class LagSettings(SettingsModel):
    """Settings of the stage ``lag``."""

    method: Literal["estimate", "given"]
    lag: float | None = quantity(None, unit="bins", description="with the method ``given``")


def plan_lag(case: ChannelCase[Any]) -> Entry:
    """Find the lag of the analog record, but where the ranges of the campaign state it."""
    analog, photon = glued_parts(case.channel.name)
    lag = channel_facts(case.facts, analog).lag
    if isinstance(lag, float):
        settings = LagSettings(method="given", lag=lag)
        return case.run(LAG_STEP, "given by the campaign", settings, number=lag)
    if not enough_bins(case.channel.bins):
        return case.leave(LAG_STEP, f"the {case.channel.bins} bins are too few for an estimate")
    if not lag_is_unknown(case.facts, analog, photon):
        reason = "the range offsets that the campaign gives for both channels state the lag"
        return case.leave(LAG_STEP, reason)
    estimate = "requests an estimate," if lag else "gives none: estimated"
    reason = f"the campaign {estimate} from noise common to both records"
    return case.run(LAG_STEP, reason, LagSettings(method="estimate"))


class GlueSettings(SettingsModel):
    """Settings of the stage ``glue``."""

    analog: str
    photon: str


def plan_glue(case: ChannelCase[Any]) -> Entry:
    """Glue the profiles of both channels: the channel is there because a product needs it."""
    parts = analog, photon = glued_parts(case.channel.name)
    return case.run(
        "glue",
        "the campaign requests the glued channel",
        GlueSettings(analog=analog, photon=photon),
        needs=("read", LAG_STEP, *(f"{part}/noise" for part in parts)),
    )


def glue(settings: GlueSettings, signal: ChannelSignal, *, estimated: bool) -> GluedProfiles:
    """Return the glued profiles.

    Parameters
    ----------
    settings : GlueSettings
    signal : ChannelSignal
    estimated : bool
        Whether the lag is to be estimated. A given one has shifted the analog ranges.
    """
    # Parts of a glued channel are channels of the files.
    analog, photon = (
        cast("FileProfiles", signal.channels[part].profiles)
        for part in (settings.analog, settings.photon)
    )
    archive = signal.source.archive
    lag = ChannelLag(labeled_gluing.range_lag(analog.range, photon.range))
    if estimated:
        lag = labeled_gluing.estimate_lag(_groups(archive, analog, photon), known=lag.bins)

    @functools.cache
    def slope() -> labeled_gluing.Slope:
        return labeled_gluing.scene_slope(_samples(archive, analog, photon), lag)

    return GluedProfiles(analog, photon, lag, slope)


def _groups(
    archive: xr.Dataset, analog: FileProfiles, photon: FileProfiles
) -> Iterator[tuple[_Power, _Power]]:
    """Yield the power of the first profiles of a scene in both channels, (time, range)."""
    for rows in profile_groups(min(labeled_gluing.LAG_PROFILES, archive.sizes["time"])):
        counts = archive.isel(time=rows)
        yield analog.of(counts)["power"].to_numpy(), photon.of(counts)["power"].to_numpy()


def _samples(
    archive: xr.Dataset, analog: FileProfiles, photon: FileProfiles
) -> Iterator[tuple[xr.Dataset, xr.Dataset]]:
    """Yield profiles of both channels from all over a scene, some at a time."""
    number, together = archive.sizes["time"], PROFILES_AT_ONCE // 4
    rows = np.unique(np.linspace(0, number - 1, labeled_gluing.SLOPE_PROFILES).astype(int))
    for first in range(0, rows.size, together):
        counts = archive.isel(time=rows[first : first + together])
        yield analog.of(counts), photon.of(counts)

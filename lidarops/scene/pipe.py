"""The pipe from raw counts to the profiles of a channel, and the air: its stages, in their order.

Of each stage there is a function ``plan_...``, which decides on the headers and the campaign
whether it runs. `channel_signal` carries out what is planned.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Final, Literal, cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.constants import (
    DARK_REACH,
    DEAD_TIME_UNCERTAINTY,
    DEFAULT_DEAD_TIME,
    LICEL_RANGE_PER_MICROSECOND,
)
from lidarops.records import (
    DetectionMode,
    Granule,
    LeftOut,
    PlannedStep,
    Role,
    glued_parts,
    is_glued,
)
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.signal import labeled, labeled_gluing
from lidarops.retrieve.signal.dead_time import (
    DeadTimeEstimate,
    ProfileGroup,
    estimate_dead_time,
)
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.retrieve.signal.lag import PROFILES_AT_ONCE, ChannelLag, enough_bins, profile_groups
from lidarops.retrieve.signal.thresholds import THRESHOLDS
from lidarops.scene.air import STANDARD_ERROR, AirFiles, ChosenAir
from lidarops.scene.case import (
    DARK_FILES,
    LAG_STEP,
    READ_STEP,
    REQUEST,
    ChannelCase,
    Entry,
    estimated_against,
    lag_is_unknown,
    prepared_channels,
)
from lidarops.scene.profiles import (
    BEFORE,
    ChannelSignal,
    FileProfiles,
    GluedProfiles,
    Source,
    bin_ranges,
)
from lidarops.settings import SettingsModel, quantity

Array = npt.NDArray[np.float64]


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
) -> Iterator[tuple[Array, Array]]:
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


_NEAR_THE_SCENE: Final = f"within {DARK_REACH / timedelta(hours=1):g} h of the scene"
_ASSUMED_DEAD_TIME: Final = f"{1e9 * DEFAULT_DEAD_TIME:g} ns"
NO_WAVELENGTH: Final = "the wavelength in the header is implausible, and no facts give one"


class ReadSettings(SettingsModel):
    """Settings of the stage ``read``."""

    wavelength: float = quantity(unit="m")
    recorder: str = ""
    pre_trigger: float | None = quantity(
        None, unit="m", description="of a record whose bins before the pulse are left out"
    )


def plan_read(case: ChannelCase[Any]) -> Entry:
    """Read a channel that a product needs, at a known wavelength."""
    requesters = (*case.requests, *case.requesters)
    if not requesters and case.networks:
        word = "networks" if len(case.networks) > 1 else "network"
        reason = f"used only by {word} {' and '.join(case.networks)}"
        return case.leave(READ_STEP, reason, rule="channel")
    if not requesters:
        reason = "no product of the campaign uses this channel"
        return case.leave(READ_STEP, reason, rule=REQUEST)
    metres = case.facts_of_channel.wavelength or case.channel.wavelength
    if math.isnan(metres):
        return case.leave(READ_STEP, NO_WAVELENGTH, rule="channel")
    before = case.channel.pre_trigger or None
    if not case.channel.bins:
        reason = f"pre_trigger of {before:g} m leaves no bin: give what the record counts before"
        return case.leave(READ_STEP, f"{reason} the pulse", rule="channel")
    settings = ReadSettings(wavelength=metres, recorder=case.channel.recorder, pre_trigger=before)
    return case.run(READ_STEP, f"required by {' and '.join(requesters)}", settings, rule="channel")


class OverlapSettings(SettingsModel):
    """Settings of the stage ``overlap``."""

    full_overlap_range: float = quantity(unit="m")
    overlap_profile: str | None = None
    """Ancillary file of the overlap function."""


def plan_overlap(case: ChannelCase[Any]) -> Entry:
    """Flag bins before full overlap, and give the overlap function, where they are stated."""
    full, profile = case.facts.full_overlap_range, case.facts.overlap_profile
    if not profile and full <= 0:
        return case.leave(
            "overlap",
            "the campaign gives no full_overlap_range: near bins are used as they are, and"
            " those whose signal shows no full overlap are rejected or to be used with care",
        )
    assumed = ", which is assumed," if case.facts.full_overlap_assumed else ""
    reason = f"bins nearer than full overlap{assumed} are flagged and excluded"
    if profile:
        reason = f"overlap_profile given by the campaign; {reason}"
    settings = OverlapSettings(full_overlap_range=full, overlap_profile=profile)
    return case.run("overlap", reason, settings, number=full)


class RangeOffsetSettings(SettingsModel):
    """Settings of the stage ``range_offset``."""

    range_offset: float = quantity(unit="m")


def plan_range_offset(case: ChannelCase[Any]) -> Entry:
    """Shift the ranges of the bins where the campaign gives an offset or a lag."""
    offset, lag = case.range_offset, case.facts_of_channel.lag
    if offset:
        reason = "given by the campaign"
        if isinstance(lag, float):
            reason += f", including a lag of {lag:g} bins"
        settings = RangeOffsetSettings(range_offset=offset)
        return case.run("range_offset", reason, settings, number=offset)
    if lag == "estimate":
        return case.leave("range_offset", "an estimated lag shifts glued channels only")
    return case.leave("range_offset", "the campaign gives no range_offset")


class DarkSettings(SettingsModel):
    """Settings of the stage ``dark``."""

    files: int
    method: Literal["interpolated", "nearest"]


def plan_dark(case: ChannelCase[Any]) -> Entry:
    """Subtract the signal of dark files near the scene from an analog channel."""
    if case.channel.mode is DetectionMode.PHOTON:
        return case.leave("dark", "dark counts are part of the photon-counting background")
    count = len(case.scene.dark)
    if not count:
        refused = any(file.role is Role.DARK for file in case.scene.unused)
        which = "dark files that can be used" if refused else "dark files"
        return case.leave("dark", f"no {which} {_NEAR_THE_SCENE}", number=0.0, rule=DARK_FILES)
    times = sorted(granule.start for granule in case.scene.dark if granule.start)
    profiles = [granule.start for granule in case.scene.granules if granule.start]
    enclosed = times[0] < max(profiles) and min(profiles) < times[-1]
    sessions = _sessions(case.scene.dark)
    method: Literal["interpolated", "nearest"]
    # Interpolation needs two sessions.
    if enclosed and sessions > 1:
        use, method = "interpolated in time", "interpolated"
    elif sessions > 1:
        use, method = "the nearest in time is used", "nearest"
    else:
        use, method = "one session, used for all profiles", "nearest"
    order = _order_in_words(times, min(profiles), max(profiles))
    files = "1 dark file" if count == 1 else f"{count} dark files"
    reason = f"{files} {_NEAR_THE_SCENE}, {order}: {use}"
    settings = DarkSettings(files=count, method=method)
    number = float(count)
    return case.run("dark", reason, settings, needs=("read",), number=number, rule=DARK_FILES)


def _sessions(dark: Iterable[Granule]) -> int:
    """Return the number of dark sessions, separated as in the retrieval."""
    middles = sorted(
        granule.start + ((granule.stop or granule.start) - granule.start) / 2
        for granule in dark
        if granule.start
    )
    gaps = ((later - time).total_seconds() for time, later in itertools.pairwise(middles))
    return 1 + sum(gap > THRESHOLDS.session_gap for gap in gaps)


def _order_in_words(times: Sequence[datetime], first: datetime, last: datetime) -> str:
    """Return in words how many times lie before, among and after the profiles of a scene."""
    counts = {
        "before": sum(time < first for time in times),
        "among": sum(first <= time <= last for time in times),
        "after": sum(time > last for time in times),
    }
    *firsts, last_count = [f"{number} {place}" for place, number in counts.items() if number]
    words = f"{', '.join(firsts)} and {last_count}" if firsts else last_count
    return f"{words} its profiles"


class DeadTimeSettings(SettingsModel):
    """Settings of the stage ``dead_time``."""

    dead_time: float | None = quantity(None, unit="s", description="None if it is estimated")
    dead_time_uncertainty: float | None = None
    """Relative standard error; None if it is estimated."""
    analog: str | None = None
    """Channel against which it is estimated."""
    lag: Literal["estimate", "given"] | None = None
    """Whether the lag of that channel is estimated too, or given by the ranges of the campaign."""


def plan_dead_time(case: ChannelCase[Any]) -> Entry:
    """Correct photon counts for a known dead time, or one that can be estimated."""
    dead_time = case.facts_of_channel.dead_time
    if case.channel.mode is not DetectionMode.PHOTON:
        return case.leave("dead_time", "analog detection has no dead time")
    if dead_time is None:
        pile_up = f"pile-up is flagged for an assumed {_ASSUMED_DEAD_TIME}"
        reason = f"the campaign gives no dead_time; {pile_up}"
        return case.leave("dead_time", reason)
    if dead_time == "estimate":
        return _plan_estimate(case)
    reason, error = "given by the campaign", case.facts_of_channel.dead_time_uncertainty
    if dead_time == 0.0:
        reason = "0 by the campaign: the counts of the files are corrected"
        error = 0.0
    elif error is None:
        reason += f"; its uncertainty is not, and {DEAD_TIME_UNCERTAINTY:.0%} is assumed"
        error = DEAD_TIME_UNCERTAINTY
    settings = DeadTimeSettings(dead_time=dead_time, dead_time_uncertainty=error)
    return case.run("dead_time", reason, settings, number=dead_time)


def _plan_estimate(case: ChannelCase[Any]) -> Entry:
    """Estimate the dead time against the analog channel of the detector."""
    analog = estimated_against(case.channel, case.facts_of_channel, case.scene.layout)
    if case.member:
        reason = "dead times are not estimated for a network; pile-up is flagged"
    elif not enough_bins(case.channel.bins):
        reason = f"the {case.channel.bins} bins are too few for an estimate"
    elif not analog:
        reason = "the files hold no analog channel of the same detector and bins"
    else:
        unknown = lag_is_unknown(case.facts, analog, case.channel.name)
        settings = DeadTimeSettings(analog=analog, lag="estimate" if unknown else "given")
        words = f"the campaign requests an estimate, against {analog}"
        return case.run("dead_time", words, settings, needs=(f"{analog}/noise",))
    return case.leave("dead_time", reason)


def _estimate_dead_time(signal: ChannelSignal, analog: ChannelSignal, lag: str | None) -> None:
    """Give the dead time, and its relative standard error, from the first profiles of a scene."""
    estimate = _estimated_dead_time(signal, analog, estimates_lag=lag == "estimate")
    words = f"dead_time: no estimate of {signal.channel} against {analog.channel}"
    if estimate is None:
        signal.notes.append(
            f"dead_time: estimate of {signal.channel}: the data give none against"
            f" {analog.channel}, so that pile-up is not corrected, and flagged for an"
            f" assumed {_ASSUMED_DEAD_TIME}; give dead_time, such as 4 ns, as the data sheet of"
            " the counter states it"
        )
    else:
        signal.dead_time = estimate.dead_time
        signal.dead_time_uncertainty = min(estimate.standard_error / estimate.dead_time, 1.0)
        words = (
            f"dead_time: {1e9 * estimate.dead_time:.3f} ns of {signal.channel}, estimated"
            f" against {analog.channel}, standard error"
            f" {1e9 * estimate.standard_error:.3f} ns"
        )
    signal.statements.append(words)


def _estimated_dead_time(
    photon: ChannelSignal, analog: ChannelSignal, *, estimates_lag: bool
) -> DeadTimeEstimate | None:
    """Return the dead time from the first profiles of a scene."""
    archive, profiles = photon.source.archive, analog.profiles
    channel = photon.channel
    width = archive[channel].attrs["bin_width"]
    groups: list[ProfileGroup] = []

    def records() -> Iterator[tuple[Array, Array]]:
        """Yield the records for an estimate of the lag, and keep those of profiles with shots."""
        for rows in profile_groups(min(labeled_gluing.LAG_PROFILES, archive.sizes["time"])):
            raw = archive.isel(time=rows)
            counts = raw[channel].to_numpy()
            shots = raw[f"{channel}_shots"].to_numpy()
            exposure = shots * (width / LICEL_RANGE_PER_MICROSECOND)
            part = profiles.of(raw)
            power, variance, length = (
                part[name].to_numpy() for name in ("power", "variance", CORRELATION_LENGTH)
            )
            # Of profiles without light in one of the records, nothing is compared.
            shot = (exposure > 0.0) & np.isfinite(power).any(axis=1)
            if shot.any():
                share = (exposure[shot] / exposure.sum())[:, np.newaxis]
                noise = variance[shot] * length[shot, np.newaxis]
                mean, of_mean = (power[shot] * share).sum(axis=0), (noise * share**2).sum(axis=0)
                groups.append(ProfileGroup(counts[shot], exposure[shot], mean, of_mean))
            yield power, counts / np.where(shot, exposure, np.nan)[:, np.newaxis]

    distance = bin_ranges(archive, channel, photon.range_offset)
    lag = labeled_gluing.range_lag(profiles.range, distance)
    if estimates_lag:
        lag = labeled_gluing.estimate_lag(records(), known=lag).bins
    else:
        for _ in records():
            pass
    return estimate_dead_time(groups, lag) if groups else None


class NoiseSettings(SettingsModel):
    """Settings of the stage ``noise``."""

    method: Literal["poisson", "given", "differences"]
    noise_variance: float | None = quantity(
        None, unit="mV2", description="with the method ``given``"
    )
    baseline_uncertainty: float | None = quantity(
        None, unit="mV", description="of an analog channel, where the campaign gives it"
    )


def plan_noise(case: ChannelCase[Any]) -> Entry:
    """Turn counts into power, with a noise that is Poisson, given, or estimated."""
    variance = case.facts_of_channel.noise_variance
    if case.channel.mode is DetectionMode.PHOTON:
        reason, settings = "photon counts are Poisson distributed", NoiseSettings(method="poisson")
    else:
        reason = (
            "the campaign gives no noise_variance; estimated from third differences over range"
            if variance is None
            else "given by the campaign"
        )
        settings = NoiseSettings(
            method="differences" if variance is None else "given",
            noise_variance=variance,
            baseline_uncertainty=case.facts_of_channel.baseline_uncertainty,
        )
    needs = ("read", "overlap", "range_offset", "dark", "dead_time")
    return case.run("noise", reason, settings, needs=needs, number=settings.noise_variance)


AIR: Final = "molecular"
"""Stage that runs once a channel, if one of its products needs it."""


class MolecularSettings(SettingsModel):
    """Settings of the stage ``molecular``."""

    molecular_profile: str | None = None
    """Ancillary file of pressure and temperature that the facts name."""
    atmosphere: ChosenAir | None = None
    """Profiles of the first source that holds."""
    relative_error: float | None = None
    """Standard error of the density, of sources or of the standard atmosphere that stands for them.

    With neither file nor profiles, the air is that of the US Standard Atmosphere 1976.
    """


def plan_molecular(case: ChannelCase[Any], air: AirFiles | None) -> PlannedStep:
    """Give the density of the air, of a file, of sources or of the standard atmosphere."""
    if source := case.facts.molecular_profile:
        settings = MolecularSettings(molecular_profile=source)
        return case.run(AIR, "given by the campaign", settings)
    if air is None or not air.is_given(case.scene.station):
        reason = "the campaign gives neither molecular_profile nor atmosphere; US Standard"
        return case.run(AIR, f"{reason} Atmosphere 1976 is used", MolecularSettings())
    windows = (getattr(request, "reference", None) for request in case.requests.values())
    highest = max((window.highest for window in windows if window), default=0.0)
    chosen = air.of_scene(case.scene, min(highest, case.last))
    if chosen is not None:
        reason = "nearest profiles of the first source of the atmosphere that holds"
        settings = MolecularSettings(atmosphere=chosen[0], relative_error=chosen[1])
        return case.run(AIR, reason, settings, number=chosen[0].age)
    warning = (
        "no source of the atmosphere holds: US Standard Atmosphere 1976 is used, and values of"
        " elastic and raman have the flag standard_air"
    )
    settings = MolecularSettings(relative_error=STANDARD_ERROR)
    return case.run(AIR, "all sources are too far in time or place", settings, warning=warning)


def with_air_error(entry: Entry, error: float) -> Entry:
    """Return the entry of a product with the error of the density that counts: that of sources."""
    key = "molecular_relative_error"
    if isinstance(entry, LeftOut) or key not in entry.settings:
        return entry
    reason = f"{entry.reason}; {key} is that of atmosphere, not that of the product"
    return replace(entry, settings={**entry.settings, key: error}, reason=reason)


_OF_FILES: Final = (plan_overlap, plan_range_offset, plan_dark, plan_dead_time, plan_noise)
"""From the counts of a channel of the files to its profiles, in the order in which stages run."""
_OF_GLUED: Final = (plan_overlap, plan_lag, plan_glue)
"""From two channels of the files to the profiles of the glued one."""


class Stages(SettingsModel):
    """What a plan states of the pipe of a channel: None where a stage is left out."""

    read: ReadSettings
    overlap: OverlapSettings | None = None
    range_offset: RangeOffsetSettings | None = None
    dark: DarkSettings | None = None
    dead_time: DeadTimeSettings | None = None
    noise: NoiseSettings | None = None
    lag: LagSettings | None = None
    glue: GlueSettings | None = None
    molecular: MolecularSettings | None = None


def plan_stages(case: ChannelCase[Any]) -> list[Entry]:
    """Return what is decided from the counts of a channel to its profiles.

    Only that it is not read, if no product needs the channel.
    """
    read = plan_read(case)
    if isinstance(read, LeftOut):
        return [read]
    decided = _OF_GLUED if is_glued(case.channel.name) else _OF_FILES
    return [read, *(stage(case) for stage in decided)]


def channel_signal(source: Source, steps: Sequence[PlannedStep], channel: str) -> ChannelSignal:
    """Return the signal of a channel, for which the planned stages are carried out.

    Parameters
    ----------
    source : Source
    steps : sequence of PlannedStep
        Of the plan, in its order.
    channel : str
    """
    signals: dict[str, ChannelSignal] = {}
    for name in prepared_channels(steps, channel):
        own = [step for step in steps if step.channel == name and not step.product]
        stages = Stages.model_validate({step.name: dict(step.settings) for step in own})
        signals[name] = ChannelSignal(source, name, signals, stages.read.wavelength)
        _carry_out(stages, signals[name])
    return signals[channel]


def _carry_out(stages: Stages, signal: ChannelSignal) -> None:
    """Give the profiles of a channel, what they are made with, and the air."""
    source = signal.source
    if stages.overlap is not None:
        signal.full_overlap_range = stages.overlap.full_overlap_range
        if stages.overlap.overlap_profile is not None:
            signal.overlap = source.ancillaries.overlaps[stages.overlap.overlap_profile].at
    if stages.range_offset is not None:
        signal.range_offset = stages.range_offset.range_offset
    before = f"{BEFORE}{signal.channel}"
    dark = {
        name: labeled.read_dark(source.dark, name, method=stages.dark.method)
        for name in (signal.channel, before)
        if stages.dark is not None and source.dark is not None and name in source.dark
    }
    correction = stages.dead_time
    if correction is not None and correction.analog is not None:
        _estimate_dead_time(signal, signal.channels[correction.analog], correction.lag)
    elif correction is not None:
        signal.dead_time = correction.dead_time
        signal.dead_time_uncertainty = correction.dead_time_uncertainty or 0.0
    if stages.noise is not None:
        signal.relative_variance = stages.noise.method == "differences"
        condition = partial(
            labeled.condition,
            dead_time=signal.dead_time,
            dead_time_uncertainty=signal.dead_time_uncertainty,
            noise_variance=stages.noise.noise_variance,
            baseline_uncertainty=stages.noise.baseline_uncertainty,
        )
        signal.profiles = FileProfiles(
            signal.channel,
            bin_ranges(source.archive, signal.channel, signal.range_offset),
            dark.get(signal.channel),
            partial(
                condition,
                dark=dark.get(signal.channel),
                range_offset=signal.range_offset,
                full_overlap_range=signal.full_overlap_range or 0.0,
            ),
            partial(condition, dark=dark.get(before)) if before in source.archive else None,
        )
    if stages.glue is not None:
        estimated = stages.lag is not None and stages.lag.method == "estimate"
        signal.profiles = glue(stages.glue, signal, estimated=estimated)
    if stages.molecular is not None:
        signal.air = stages.molecular.atmosphere
        signal.air_error = stages.molecular.relative_error
        signal.molecules = _molecules(stages.molecular, source)


def _molecules(settings: MolecularSettings, source: Source) -> MolecularProfile:
    """Return the air that a plan states."""
    if settings.atmosphere is not None:
        return settings.atmosphere.profile(source.ancillaries.folder)
    if settings.molecular_profile is not None:
        return source.ancillaries.profiles[settings.molecular_profile]
    return MolecularProfile.us_standard()

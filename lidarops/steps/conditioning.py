"""From the counts of a channel of the files to the power, variance and quality of its profiles."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from lidarops.constants import DEAD_TIME_UNCERTAINTY, LICEL_RANGE_PER_MICROSECOND
from lidarops.records import DetectionMode, Granule, LeftOut, Role
from lidarops.retrieve.signal import labeled, labeled_gluing
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.retrieve.signal.dead_time import DeadTimeEstimate, estimate_dead_time
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.retrieve.signal.lag import PROFILES_AT_ONCE, enough_bins, profile_groups
from lidarops.retrieve.signal.thresholds import THRESHOLDS
from lidarops.settings import SettingsModel, quantity
from lidarops.steps.case import ChannelCase
from lidarops.steps.channels import estimated_against, lag_is_unknown, range_offset
from lidarops.steps.data import Data, Profiles
from lidarops.steps.profiles import FileProfiles, bin_ranges
from lidarops.steps.reading import ARCHIVE
from lidarops.steps.step import Datum, Decisions, Leave, Run, Step
from lidarops.steps.workload import Workload

Array = npt.NDArray[np.float64]

FULL_OVERLAP_RANGE: Final = Datum[float]("full_overlap_range")
"""m, nearer bins are flagged."""
OVERLAP: Final = Datum[Callable[[Array], Array]]("overlap")
"""Returns the overlap at ranges in m."""
RANGE_OFFSET: Final = Datum[float]("range_offset")
"""m, added to the range of every bin."""
DARK: Final = Datum[DarkSignals]("dark")
DEAD_TIME: Final = Datum[float]("dead_time")
"""s."""
DEAD_TIME_ERROR: Final = Datum[float]("dead_time_uncertainty")
"""Relative standard error of the dead time."""
RELATIVE_VARIANCE: Final = Datum[bool]("relative_variance")
"""Whether the variance is estimated from the profile, and so scatters."""
PROFILES: Final = Datum[Profiles]("profiles")
"""Power, variance and quality of the profiles of the channel."""


class OverlapSettings(SettingsModel):
    """Settings of the step ``overlap``."""

    full_overlap_range: float = quantity(unit="m")
    overlap_profile: str | None = None
    """Ancillary file of the overlap function."""


class Overlap(Step[ChannelCase, OverlapSettings]):
    """Flag bins before full overlap, and give the overlap function."""

    name = "overlap"
    settings = OverlapSettings
    outputs = (FULL_OVERLAP_RANGE, OVERLAP)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run where the campaign states the overlap."""
        full, profile = case.facts.full_overlap_range, case.facts.overlap_profile
        if not profile and full <= 0:
            yield Leave(
                "the campaign gives no full_overlap_range: near bins are used as they are, and"
                " those whose signal shows no full overlap are rejected or to be used with care"
            )
            return
        reason = "bins nearer than full overlap are flagged and excluded"
        if profile:
            reason = f"overlap_profile given by the campaign; {reason}"
        settings = OverlapSettings(full_overlap_range=full, overlap_profile=profile)
        yield Run(reason, settings, number=full)

    def carry_out(self, settings: OverlapSettings, data: Data) -> None:
        """Give the range of full overlap, and the overlap function where it is known."""
        data[FULL_OVERLAP_RANGE] = settings.full_overlap_range
        if settings.overlap_profile is not None:
            data[OVERLAP] = data.source.ancillaries.overlaps[settings.overlap_profile].at

    def files(self, settings: OverlapSettings) -> Mapping[str, Role]:
        """Return the file of the overlap function."""
        return {settings.overlap_profile: Role.OVERLAP} if settings.overlap_profile else {}


class RangeOffsetSettings(SettingsModel):
    """Settings of the step ``range_offset``."""

    range_offset: float = quantity(unit="m")


class RangeOffset(Step[ChannelCase, RangeOffsetSettings]):
    """Shift the ranges of the bins."""

    name = "range_offset"
    settings = RangeOffsetSettings
    outputs = (RANGE_OFFSET,)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run where the campaign gives an offset or a lag."""
        offset, lag = range_offset(case.channel, case.facts), case.facts_of_channel.lag
        if offset:
            reason = "given by the campaign"
            if isinstance(lag, float):
                reason += f", including a lag of {lag:g} bins"
            yield Run(reason, RangeOffsetSettings(range_offset=offset), number=offset)
        elif lag == "estimate":
            yield Leave("an estimated lag shifts glued channels only")
        else:
            yield Leave("the campaign gives no range_offset")

    def carry_out(self, settings: RangeOffsetSettings, data: Data) -> None:
        """Give the offset."""
        data[RANGE_OFFSET] = settings.range_offset


class DarkSettings(SettingsModel):
    """Settings of the step ``dark``."""

    files: int
    method: Literal["interpolated", "nearest"]


class Dark(Step[ChannelCase, DarkSettings]):
    """Subtract the signal of dark files from an analog channel."""

    name = "dark"
    settings = DarkSettings
    inputs = (ARCHIVE,)
    outputs = (DARK,)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run for analog channels with dark files near the scene."""
        if case.channel.mode is DetectionMode.PHOTON:
            yield Leave("dark counts are part of the photon-counting background")
            return
        count = len(case.scene.dark)
        if not count:
            refused = any(file.role is Role.DARK for file in case.scene.unused)
            which = "dark files that can be used" if refused else "dark files"
            yield Leave(f"no {which} within 24 h of the scene", number=0.0)
            return
        times = sorted(granule.start for granule in case.scene.dark if granule.start)
        profiles = [granule.start for granule in case.scene.granules if granule.start]
        around = times[0] < max(profiles) and min(profiles) < times[-1]
        sessions = _sessions(case.scene.dark)
        method: Literal["interpolated", "nearest"]
        # Interpolation needs two sessions.
        if around and sessions > 1:
            use, method = "interpolated in time", "interpolated"
        elif sessions > 1:
            use, method = "the nearest in time is used", "nearest"
        else:
            use, method = "one session, used for all profiles", "nearest"
        order = _times_around(times, min(profiles), max(profiles))
        files = "1 dark file" if count == 1 else f"{count} dark files"
        reason = f"{files} within 24 h of the scene, {order}: {use}"
        yield Run(reason, DarkSettings(files=count, method=method), number=float(count))

    def carry_out(self, settings: DarkSettings, data: Data) -> None:
        """Give the dark signals."""
        if data.source.dark is not None:
            data[DARK] = labeled.read_dark(data.source.dark, data.channel, method=settings.method)

    def held(self, settings: DarkSettings, work: Workload) -> float:  # noqa: ARG002
        """Return the bytes of the signals of dark files, and of their mean at the peak."""
        return _BYTES_OF_A_DARK_BIN * len(work.scene.dark) * work.bins


def lacks_dark(entry: LeftOut) -> bool:
    """Return whether an entry of a plan says that dark files are wanting."""
    return entry.name == Dark.name and entry.number == 0.0


_BYTES_OF_A_DARK_BIN: Final = 24.0
"""Bytes per bin of a dark file: three arrays of float64 while sessions are averaged."""


def _sessions(dark: Iterable[Granule]) -> int:
    """Return the number of dark sessions, separated as in the retrieval."""
    middles = sorted(
        granule.start + ((granule.stop or granule.start) - granule.start) / 2
        for granule in dark
        if granule.start
    )
    gaps = ((later - time).total_seconds() for time, later in itertools.pairwise(middles))
    return 1 + sum(gap > THRESHOLDS.session_gap for gap in gaps)


def _times_around(times: Sequence[datetime], first: datetime, last: datetime) -> str:
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
    """Settings of the step ``dead_time``."""

    dead_time: float | None = quantity(None, unit="s", description="None if it is estimated")
    dead_time_uncertainty: float | None = None
    """Relative standard error; None if it is estimated."""
    analog: str | None = None
    """Channel against which it is estimated."""
    lag: Literal["estimate", "given"] | None = None
    """Whether the lag of that channel is estimated too, or given by the ranges of the campaign."""


class DeadTime(Step[ChannelCase, DeadTimeSettings]):
    """Correct photon counts for the dead time."""

    name = "dead_time"
    settings = DeadTimeSettings
    from_companions = (PROFILES,)
    outputs = (DEAD_TIME, DEAD_TIME_ERROR)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run for photon counting with a known dead time, or one that can be estimated."""
        dead_time = case.facts_of_channel.dead_time
        if case.channel.mode is not DetectionMode.PHOTON:
            yield Leave("analog detection has no dead time")
        elif dead_time is None:
            yield Leave("the campaign gives no dead_time; pile-up is flagged for an assumed 4 ns")
        elif dead_time == "estimate":
            analog = estimated_against(case.channel, case.facts, case.scene.layout)
            if case.member:
                yield Leave("dead times are not estimated for a network; pile-up is flagged")
            elif not enough_bins(case.channel.bins):
                yield Leave(f"the {case.channel.bins} bins are too few for an estimate")
            elif not analog:
                yield Leave("the files hold no analog channel of the same detector and bins")
            else:
                words = f"the campaign requests an estimate, against {analog}"
                unknown = lag_is_unknown(case.facts, analog, case.channel.name)
                lag: Literal["estimate", "given"] = "estimate" if unknown else "given"
                yield Run(words, DeadTimeSettings(analog=analog, lag=lag))
        else:
            reason, error = "given by the campaign", case.facts_of_channel.dead_time_uncertainty
            if error is None:
                reason += f"; its uncertainty is not, and {DEAD_TIME_UNCERTAINTY:.0%} is assumed"
                error = DEAD_TIME_UNCERTAINTY
            settings = DeadTimeSettings(dead_time=dead_time, dead_time_uncertainty=error)
            yield Run(reason, settings, number=dead_time)

    def companions(self, settings: DeadTimeSettings) -> tuple[str, ...]:
        """Return the analog channel of an estimate."""
        return () if settings.analog is None else (settings.analog,)

    def carry_out(self, settings: DeadTimeSettings, data: Data) -> None:
        """Give the dead time, and its relative standard error."""
        if settings.analog is not None:
            estimate = _estimated_dead_time(data, data.channels[settings.analog], settings)
            words = f"dead_time: no estimate of {data.channel} against {settings.analog}"
            if estimate is None:
                data.notes.append(
                    f"dead_time: estimate of {data.channel}: the data give none against"
                    f" {settings.analog}, so that pile-up is not corrected, and flagged for an"
                    " assumed 4 ns; give dead_time in s, as the data sheet of the counter states it"
                )
            else:
                data[DEAD_TIME] = estimate.dead_time
                data[DEAD_TIME_ERROR] = min(estimate.standard_error / estimate.dead_time, 1.0)
                words = (
                    f"dead_time: {1e9 * estimate.dead_time:.3f} ns of {data.channel}, estimated"
                    f" against {settings.analog}, standard error"
                    f" {1e9 * estimate.standard_error:.3f} ns"
                )
            data.statements.append(words)
        elif settings.dead_time is not None and settings.dead_time_uncertainty is not None:
            data[DEAD_TIME] = settings.dead_time
            data[DEAD_TIME_ERROR] = settings.dead_time_uncertainty

    def cpu_time(self, settings: DeadTimeSettings, work: Workload) -> float:
        """Return the CPU time of an estimate, s."""
        profiles = min(labeled_gluing.LAG_PROFILES, work.profiles)
        return 0.0 if settings.analog is None else 4e-7 * profiles * work.bins

    def held(self, settings: DeadTimeSettings, work: Workload) -> float:
        """Return the bytes of the profiles from which a dead time is estimated."""
        profiles = min(PROFILES_AT_ONCE, work.profiles)
        return 0.0 if settings.analog is None else _BYTES_OF_AN_ESTIMATE * profiles * work.bins


_BYTES_OF_AN_ESTIMATE: Final = 105.0
"""Bytes per bin of a profile of the estimate of a dead time, at the peak."""


def _estimated_dead_time(
    photon: Data, analog: Data, settings: DeadTimeSettings
) -> DeadTimeEstimate | None:
    """Return the dead time from the first profiles of a scene."""
    archive, profiles = photon[ARCHIVE], analog[PROFILES]
    channel = photon.channel
    width = archive[channel].attrs["bin_width"]
    groups: list[tuple[Array, ...]] = []

    def records() -> Iterator[tuple[Array, Array]]:
        """Yield the records for an estimate of the lag, and keep their sums."""
        for rows in profile_groups(min(labeled_gluing.LAG_PROFILES, archive.sizes["time"])):
            raw = archive.isel(time=rows)
            counts = raw[channel].to_numpy().astype(np.float64)
            shots = raw[f"{channel}_shots"].to_numpy()
            exposure = shots * (width / LICEL_RANGE_PER_MICROSECOND)
            part = profiles.of(raw)
            power, variance, length = (
                part[name].to_numpy() for name in ("power", "variance", CORRELATION_LENGTH)
            )
            share = (exposure / max(exposure.sum(), 1e-300))[:, np.newaxis]
            of_mean = (variance * length[:, np.newaxis] * share**2).sum(axis=0)
            groups.append(
                (counts.sum(axis=0), exposure.sum(), (power * share).sum(axis=0), of_mean)
            )
            yield power, counts / np.maximum(exposure, 1e-300)[:, np.newaxis]

    distance = bin_ranges(archive, channel, photon.get(RANGE_OFFSET) or 0.0)
    lag = labeled_gluing.range_lag(profiles.range, distance)
    if settings.lag == "estimate":
        lag = labeled_gluing.estimate_lag(records(), known=lag).bins
    else:
        for _ in records():
            pass
    kept = [group for group in groups if group[1] > 0.0]
    if not kept:
        return None
    counts, exposure, power, variance = (np.stack(parts) for parts in zip(*kept, strict=True))
    return estimate_dead_time(counts, exposure, power, variance, lag)


class NoiseSettings(SettingsModel):
    """Settings of the step ``noise``."""

    method: Literal["poisson", "given", "differences"]
    noise_variance: float | None = quantity(
        None, unit="mV2", description="with the method ``given``"
    )
    baseline_uncertainty: float | None = quantity(
        None, unit="mV", description="of an analog channel, where the campaign gives it"
    )


class Noise(Step[ChannelCase, NoiseSettings]):
    """Turn counts into power, with variance and quality."""

    name = "noise"
    settings = NoiseSettings
    inputs = (ARCHIVE, FULL_OVERLAP_RANGE, RANGE_OFFSET, DARK, DEAD_TIME, DEAD_TIME_ERROR)
    outputs = (PROFILES, RELATIVE_VARIANCE)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run always: the noise is Poisson, given, or estimated."""
        variance = case.facts_of_channel.noise_variance
        baseline = case.facts_of_channel.baseline_uncertainty
        if case.channel.mode is DetectionMode.PHOTON:
            reason = "photon counts are Poisson distributed"
            yield Run(reason, NoiseSettings(method="poisson"))
        elif variance is not None:
            settings = NoiseSettings(
                method="given", noise_variance=variance, baseline_uncertainty=baseline
            )
            yield Run("given by the campaign", settings, number=variance)
        else:
            reason = (
                "the campaign gives no noise_variance; estimated from third differences over range"
            )
            yield Run(reason, NoiseSettings(method="differences", baseline_uncertainty=baseline))

    def carry_out(self, settings: NoiseSettings, data: Data) -> None:
        """Give the profiles of the channel."""
        uncertainty = data.get(DEAD_TIME_ERROR)
        data[RELATIVE_VARIANCE] = settings.method == "differences"
        data[PROFILES] = FileProfiles(
            data[ARCHIVE],
            data.channel,
            {
                "dead_time": data.get(DEAD_TIME),
                "dead_time_uncertainty": DEAD_TIME_UNCERTAINTY
                if uncertainty is None
                else uncertainty,
                "noise_variance": settings.noise_variance,
                "baseline_uncertainty": settings.baseline_uncertainty,
                "dark": data.get(DARK),
                "range_offset": data.get(RANGE_OFFSET) or 0.0,
                "full_overlap_range": data.get(FULL_OVERLAP_RANGE) or 0.0,
            },
        )

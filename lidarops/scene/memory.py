"""Estimate the memory of a scene from its plan: process, profiles in work, and what is held."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Final

from lidarops.kinds import kinds
from lidarops.records import Plan, PlannedStep, Scene
from lidarops.retrieve.signal.labeled_gluing import LAG_PROFILES
from lidarops.retrieve.signal.lag import PROFILES_AT_ONCE
from lidarops.scene.case import counted_channels, prepared_channels
from lidarops.scene.profiles import CHUNK_BYTES
from lidarops.scene.retrieval import Making, Workload, making, product_settings

PROCESS: Final = 420_000_000
"""Bytes of a process with the code of all kinds loaded; above what ``benchmarks throughput --case
memory`` measures, like all sizes here."""
OF_A_COUNT: Final = 26.0
"""Bytes at the peak of a chunk of ``signal``, for each byte of its counts; other kinds take
less."""
OF_A_FILE: Final = 5_000
"""Bytes of the facts about a raw file."""
OF_A_RESULT: Final = 0.1
"""Bytes of a product that waits for those with which it is compared, for each byte of its
retrieval: 38 of 430 for an altitude of a beam."""
_OF_A_DARK_BIN: Final = 24.0
"""Bytes per bin of a dark file: three arrays of float64 while sessions are averaged."""
_OF_AN_ESTIMATE: Final = 105.0
"""Bytes per bin of a profile of a group from which a dead time is estimated, at the peak; raw
counts of all groups are held besides."""
_OF_A_LAG_BIN: Final = 65.0
"""Bytes per bin of a profile from which a lag is estimated; gluing takes four times as many."""
_COUNT: Final = 4
"""Bytes of a raw count."""


@dataclass(frozen=True, slots=True)
class SceneMemory:
    """Memory of a process that processes a scene, bytes."""

    held: float
    """Held for the whole scene, besides the process."""
    profile: float
    """Raw counts of one profile of the widest channel."""
    profiles: int
    """Number of profiles."""
    together: int = 1
    """Largest number of profiles that a chunk must not part."""
    process: float = PROCESS

    @property
    def total(self) -> float:
        """Bytes with chunks of the usual size."""
        return self.of(max(1, int(CHUNK_BYTES // max(self.profile, 1))))

    def of(self, profiles: int) -> float:
        """Return the bytes with chunks of some profiles."""
        together = min(max(profiles, self.together), self.profiles)
        return self.process + self.held + OF_A_COUNT * self.profile * together

    def profiles_within(self, limit: float) -> int:
        """Return the largest number of profiles of a chunk within a limit; 0 where none fits."""
        if self.of(1) > limit:
            return 0
        left = limit - self.process - self.held
        return max(1, int(left // max(OF_A_COUNT * self.profile, 1)))


def scene_memory(scene: Scene, plan: Plan) -> SceneMemory:
    """Return the estimated memory of a scene."""
    held: defaultdict[str, float] = defaultdict(float)
    together = 1
    members = {member.instrument: member for member in scene.members}
    for step in plan.steps:
        work = Workload(members.get(step.instrument, scene), step.channel)
        if step in plan.products:
            known = making(step.product, Making)
            settings = product_settings(plan.steps, step.product, step.channel)
            held[step.channel] += known.held(settings, work)
            together = max(together, known.together(settings, work))
        elif not step.product:
            held[step.channel] += _held_by_stage(step, work)
    files = len(scene.granules) + len(scene.dark)
    compared = [held[step.channel] for step in plan.products if kinds()[step.product].common]
    # Channels are processed one after the other.
    channels = [prepared_channels(plan.steps, step.channel) for step in plan.products]
    most = max((sum(held[name] for name in names) for names in channels), default=0.0)
    return SceneMemory(
        held=OF_A_FILE * files + most + OF_A_RESULT * sum(compared),
        profile=float(_COUNT * _most_bins(scene, plan)),
        together=together,
        profiles=max((len(member.granules) for member in scene.members or (scene,)), default=0),
    )


def _held_by_stage(step: PlannedStep, work: Workload) -> float:
    """Return the bytes that a stage of the pipe holds for the whole scene."""
    profiles = min(PROFILES_AT_ONCE, work.profiles)
    match step.name:
        case "dark":
            return _OF_A_DARK_BIN * len(work.scene.dark) * work.bins
        case "dead_time" if "analog" in step.settings:
            counts = _COUNT * min(LAG_PROFILES, work.profiles)
            return (_OF_AN_ESTIMATE * profiles + counts) * work.bins
        case "glue":
            return _OF_A_LAG_BIN * profiles * work.bins
        case _:
            return 0.0


def _most_bins(scene: Scene, plan: Plan) -> int:
    """Return the largest number of bins that a profile of a product is made from."""
    layouts = [
        {channel.name: channel.bins for channel in member.layout}
        for member in scene.members or (scene,)
    ]
    return max(
        (
            sum(bins.get(name, 0) for name in counted_channels(plan.steps, step.channel))
            for step in plan.products
            for bins in layouts
        ),
        default=0,
    )

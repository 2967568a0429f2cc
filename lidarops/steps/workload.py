"""What a planned step has to process, by which its CPU time and memory are estimated."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lidarops.records import Plan, Scene
from lidarops.steps.channels import file_channels


@dataclass(frozen=True, slots=True)
class Workload:
    """One channel of a scene, or of a member of a network."""

    scene: Scene
    """The whole network for the steps that are not of one member."""
    channel: str
    plan: Plan
    """Of the product for the step that makes it, else of the whole scene."""

    @property
    def profiles(self) -> int:
        """Number of profiles."""
        return len(self.scene.granules)

    @property
    def bins(self) -> int:
        """Number of bins of a profile."""
        return min(self.file_bins().values())

    def file_bins(self) -> dict[str, int]:
        """Return the number of bins of each channel of the files that the channel is made from."""
        bins = {layout.name: layout.bins for layout in self.scene.layout}
        return {name: bins[name] for name in file_channels(self.channel)}

    def intervals(self, seconds: float, instrument: str = "") -> int:
        """Return the number of clock intervals that hold profiles, of one member if named."""
        scenes = [member for member in self.scene.members if member.instrument == instrument]
        starts = (granule.start for scene in scenes or [self.scene] for granule in scene.granules)
        return len({math.floor(start.timestamp() / seconds) for start in starts if start})

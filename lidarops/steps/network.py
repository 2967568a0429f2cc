"""What a kind of product of a network is: its plan, and its retrieval from several instruments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import Campaign, Station
from lidarops.records import LeftOut, PlannedStep, Scene
from lidarops.settings import SettingsModel
from lidarops.steps.case import ChannelCase
from lidarops.steps.data import Chunk, Data
from lidarops.steps.step import Decisions, MakingStep

Decided = list[PlannedStep | LeftOut]


@dataclass(frozen=True, slots=True)
class Member:
    """One instrument of a network, with the data on which its steps work."""

    instrument: str
    station: Station
    data: Data | None
    """Of the channel that the network uses; None where no granule can be read."""
    range: npt.NDArray[np.float64]
    """m, ranges of the bins according to the plan."""


class NetworkStream(ABC):
    """A product of a network in the making."""

    @abstractmethod
    def add(self, member: Member, chunk: Chunk) -> None:
        """Take the next profiles of an instrument."""

    @abstractmethod
    def result(self) -> xr.Dataset:
        """Return the variables of the product, in memory."""


class NetworkProductStep(MakingStep[Any]):
    """The step that makes a product of a network."""

    def decide(self, case: ChannelCase) -> Decisions:  # noqa: ARG002
        """Decide nothing for one channel: `plan` sees all instruments."""
        return iter(())

    def carry_out(self, settings: Any, data: Data) -> None:
        """Do nothing for one channel: `network_stream` sees all instruments."""

    @abstractmethod
    def plan(self, scene: Scene, campaign: Campaign) -> Decided:
        """Return the entries of the plan of a scene, of all members and of the whole network."""

    @abstractmethod
    def network_stream(
        self, settings: SettingsModel, members: Sequence[Member], data: Data
    ) -> NetworkStream:
        """Return the product in the making; `data` holds what steps of the whole network gave."""

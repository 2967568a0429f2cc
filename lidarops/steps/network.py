"""What a kind of product of a network is: its plan, and its retrieval from several instruments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import Campaign, Station
from lidarops.records import LeftOut, PlannedStep, Scene
from lidarops.steps.data import Chunk, Data
from lidarops.steps.step import MakingStep, R, S

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

    wavelength: float
    """m."""

    @abstractmethod
    def add(self, member: Member, chunk: Chunk) -> None:
        """Take the next profiles of an instrument."""

    @abstractmethod
    def result(self) -> xr.Dataset:
        """Return the variables of the product, in memory."""


class NetworkProductStep(MakingStep[R, S]):
    """The step that makes a product of a network."""

    @abstractmethod
    def plan(self, scene: Scene, campaign: Campaign, request: R) -> Decided:
        """Return the entries of the plan of a scene, of all members and of the whole network."""

    @abstractmethod
    def network_stream(self, settings: S, members: Sequence[Member], data: Data) -> NetworkStream:
        """Return the product in the making; `data` holds what steps of the whole network gave."""

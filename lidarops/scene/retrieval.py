"""What a kind of product is to the processing: a decision, and products in the making."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, Generic, TypeVar, get_args

import numpy as np
import numpy.typing as npt
import xarray as xr
from pydantic import BaseModel

from lidarops.campaign.model import Campaign, Station
from lidarops.errors import LidarOpsError
from lidarops.kinds import Scope, kind_of
from lidarops.records import PlannedStep, Scene
from lidarops.scene.case import Entries
from lidarops.scene.channels import file_channels
from lidarops.scene.data import ChannelSignal, ProductStream
from lidarops.scene.dependence import is_product
from lidarops.scene.pipe import PIPE
from lidarops.scene.profiles import Chunk
from lidarops.settings import SettingsModel

R = TypeVar("R")
S = TypeVar("S", bound=SettingsModel)


@dataclass(frozen=True, slots=True)
class Workload:
    """One channel of a scene, or of a member of a network."""

    scene: Scene
    """The whole network for the steps that are not of one member."""
    channel: str

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


def nothing_held(settings: Any, work: Workload) -> float:  # noqa: ARG001
    """Return that nothing is held for the whole scene, bytes."""
    return 0.0


def any_profiles(settings: Any, work: Workload) -> int:  # noqa: ARG001
    """Return that a chunk may end after each profile."""
    return 1


# No slots: typing sets an attribute of generic instances, where it can.
@dataclass(frozen=True, kw_only=True)
class Making(Generic[S]):
    """What kinds of one channel and of a network have in common."""

    settings: type[S]
    """What a plan states of a product: a field for each of its entries, by name; None where the
    entry is left out."""
    needs: Callable[[Any], Entries]
    """Yields the entries of a case: what runs, and what is left out."""
    held: Callable[[S, Workload], float] = nothing_held
    """Returns the estimated number of bytes that are held for the whole scene."""
    together: Callable[[S, Workload], int] = any_profiles
    """Returns the largest number of profiles that a chunk must not part."""


@dataclass(frozen=True, kw_only=True)
class Retrieval(Making[S]):
    """How the products of a kind come about, each from one channel: `needs` of a `ProductCase`."""

    stream: Callable[[S, ChannelSignal], ProductStream]
    """Returns the product in the making, which takes the profiles of the scene in chunks."""


@dataclass(frozen=True, slots=True)
class NetworkCase(Generic[R]):
    """The scene of a network, as a kind of product sees it before any signal is read."""

    scene: Scene
    campaign: Campaign
    request: R
    """Settings of the kind in the campaign file."""


@dataclass(frozen=True, slots=True)
class Member(Generic[S]):
    """One instrument of a network, with the signal of the channel that the network uses."""

    instrument: str
    station: Station
    signal: ChannelSignal | None
    """None where no granule can be read."""
    settings: S
    """What the plan states of the product for this instrument."""
    range: npt.NDArray[np.float64]
    """m, ranges of the bins according to the plan."""


class NetworkStream(ABC):
    """A product of a network in the making."""

    wavelength: float
    """m."""

    @abstractmethod
    def add(self, member: Member[Any], chunk: Chunk) -> None:
        """Take the next profiles of an instrument."""

    @abstractmethod
    def result(self) -> xr.Dataset:
        """Return the variables of the product, in memory."""


@dataclass(frozen=True, kw_only=True)
class NetworkRetrieval(Making[S]):
    """How the products of a kind come about, each from a network: `needs` of a `NetworkCase`."""

    member: type[SettingsModel]
    """What a plan states for one instrument, as `settings`."""
    stream: Callable[[S, Sequence[Member[Any]]], NetworkStream]
    """Returns the product in the making, which takes the profiles of all instruments."""


def making(kind: str) -> Making[Any]:
    """Return how the products of a kind come about.

    Raises
    ------
    LidarOpsError
        If there is no such kind, its package is incomplete, or another scope than its settings.
    """
    known = kind_of(kind)
    found: Making[Any] = known.part("retrieval", "RETRIEVAL")
    expected = NetworkRetrieval if known.scope is Scope.NETWORK else Retrieval
    if not isinstance(found, expected) or kind not in found.settings.model_fields:
        raise LidarOpsError(
            f"kind of product {kind!r}: RETRIEVAL is no {expected.__name__} with settings of"
            f" {kind}",
            remedy=f"correct {known.package}.retrieval",
        )
    return found


def retrieval(kind: str) -> Retrieval[Any]:
    """Return how the products of a kind of one channel come about, as `making`."""
    found: Retrieval[Any] = kind_of(kind).part("retrieval", "RETRIEVAL")
    return found


def network_retrieval(kind: str) -> NetworkRetrieval[Any]:
    """Return how the products of a kind of networks come about, as `making`."""
    found: NetworkRetrieval[Any] = kind_of(kind).part("retrieval", "RETRIEVAL")
    return found


def product_settings(
    steps: Iterable[PlannedStep], kind: str, channel: str, member: str = ""
) -> SettingsModel:
    """Return what a plan states of a product, or of one instrument of its network."""
    model = network_retrieval(kind).member if member else making(kind).settings
    return model.model_validate(
        {
            step.name: dict(step.settings)
            for step in steps
            if (step.product, step.channel, step.instrument) == (kind, channel, member)
        }
    )


def streams_of(steps: Sequence[PlannedStep], signal: ChannelSignal) -> dict[str, ProductStream]:
    """Return the products of a channel in the making, by kind."""
    channel = signal.channel
    return {
        step.product: retrieval(step.product).stream(
            product_settings(steps, step.product, channel), signal
        )
        for step in steps
        if step.channel == channel and is_product(step)
    }


def settings_model(step: PlannedStep) -> type[BaseModel]:
    """Return the model of the settings of an entry of a plan."""
    if not step.product:
        return PIPE[step.name].settings
    known = making(step.product)
    fields = known.settings.model_fields | (
        known.member.model_fields if isinstance(known, NetworkRetrieval) else {}
    )
    annotation = fields[step.name].annotation
    # None is what a product states where the entry is left out.
    models = [model for model in (*get_args(annotation), annotation) if model is not NoneType]
    found: type[BaseModel] = models[0]
    return found

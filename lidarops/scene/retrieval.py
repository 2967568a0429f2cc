"""What a kind of product is to the processing: a decision, and products in the making."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Generic, TypeVar, get_args

import numpy as np
import numpy.typing as npt
import xarray as xr
from pydantic import BaseModel

from lidarops.campaign.model import Campaign, Station
from lidarops.errors import LidarOpsError
from lidarops.kinds import kinds
from lidarops.netcdf.read import open_product
from lidarops.records import PlannedStep, Scene, file_channels, products_of
from lidarops.scene.case import Entries
from lidarops.scene.pipe import Stages
from lidarops.scene.profiles import ChannelSignal, Chunk, ProductStream
from lidarops.settings import SettingsModel

R = TypeVar("R")
S = TypeVar("S", bound=SettingsModel)
M = TypeVar("M", bound="Making[Any]")


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
        made_from = file_channels(self.channel)
        return min(layout.bins for layout in self.scene.layout if layout.name in made_from)

    def intervals(self, seconds: float, instrument: str = "") -> int:
        """Return the number of clock intervals that hold profiles, of one member if named."""
        scenes = [member for member in self.scene.members if member.instrument == instrument]
        starts = (granule.start for scene in scenes or [self.scene] for granule in scene.granules)
        return len({math.floor(start.timestamp() / seconds) for start in starts if start})


# No slots: typing sets an attribute of generic instances, where it can.
@dataclass(frozen=True, kw_only=True)
class Making(Generic[S]):
    """What kinds of one channel and of a network have in common."""

    settings: type[S]
    """What a plan states of a product: a field for each of its entries, by name; None where the
    entry is left out."""
    needs: Callable[[Any], Entries]
    """Yields the entries of a case: what runs, and what is left out."""
    held: Callable[[S, Workload], float] = lambda _settings, _work: 0.0
    """Returns the estimated number of bytes that are held for the whole scene."""
    together: Callable[[S, Workload], int] = lambda _settings, _work: 1
    """Returns the largest number of profiles that a chunk must not part."""


@dataclass(frozen=True, kw_only=True)
class Retrieval(Making[S]):
    """How the products of a kind come about, each from one channel: `needs` of a `ChannelCase`."""

    stream: Callable[[S, ChannelSignal], ProductStream]
    """Returns the product in the making, which takes the profiles of the scene in chunks."""


@dataclass(frozen=True, slots=True)
class InputProduct:
    """A product of which another one is made."""

    kind: str
    channel: str
    file: Path

    def open(self, names: Iterable[str]) -> AbstractContextManager[xr.Dataset]:
        """Open it for some of its variables, as `lidarops.netcdf.read.open_product`."""
        return open_product(self.file, names)


@dataclass(frozen=True, kw_only=True)
class Derivation(Making[S]):
    """How the products of a kind come about, each from others: `needs` of a `ChannelCase`.

    It is asked only where all products are there that the kind reads, of the channel and of its
    `companions`. The case of a month has no facts, and a channel without bins.
    """

    derive: Callable[[S, Sequence[InputProduct]], Iterator[xr.Dataset]]
    """Yields the frame of the product, then its rows in batches, from products by path, so that
    those of a kind and channel are in order of time; as of a `ProductStream`."""


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


def making(kind: str, sort: type[M]) -> M:
    """Return how the products of a kind come about.

    Parameters
    ----------
    kind : str
    sort : type
        `Making`, or the one of its kinds that suits the settings of the kind of product.

    Raises
    ------
    LidarOpsError
        If there is no such kind, its package is incomplete, or it is of another sort.
    """
    known = kinds()[kind]
    found: M = known.part("retrieval", "RETRIEVAL")
    if not isinstance(found, sort) or kind not in found.settings.model_fields:
        raise LidarOpsError(
            f"kind of product {kind!r}: RETRIEVAL is no {sort.__name__} with settings of {kind}",
            remedy=f"correct {known.package}.retrieval",
        )
    return found


def product_settings(
    steps: Iterable[PlannedStep], kind: str, channel: str, member: str = ""
) -> SettingsModel:
    """Return what a plan states of a product, or of one instrument of its network."""
    model = making(kind, NetworkRetrieval).member if member else making(kind, Making).settings
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
        step.product: making(step.product, Retrieval).stream(
            product_settings(steps, step.product, channel), signal
        )
        for step in products_of(steps)
        if step.channel == channel and not kinds()[step.product].reads
    }


def settings_model(step: PlannedStep) -> type[BaseModel]:
    """Return the model of the settings of an entry of a plan."""
    fields = Stages.model_fields
    if step.product:
        known = making(step.product, Making)
        fields = known.settings.model_fields | (
            known.member.model_fields if isinstance(known, NetworkRetrieval) else {}
        )
    annotation = fields[step.name].annotation
    # None is what a product states where the entry is left out.
    models = [model for model in (*get_args(annotation), annotation) if model is not NoneType]
    found: type[BaseModel] = models[0]
    return found

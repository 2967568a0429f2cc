"""What steps work on: the data of a channel by name, and its profiles in chunks along time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeVar

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.retrieve.signal.labeled_screening import Record
from lidarops.settings import SettingsModel, quantity
from lidarops.steps.step import Datum

T = TypeVar("T")
Indices = npt.NDArray[np.int64]

CHUNK_BYTES: Final = 4_000_000
"""Bytes of raw counts that are processed together."""
GEOMETRY = ("time", "time_bnds", "zenith_angle", "azimuth")
"""Coordinates that every product over the time of the profiles has."""


@dataclass(frozen=True, slots=True)
class Source:
    """The opened files of a scene, on which the steps of all its channels work."""

    archive: xr.Dataset
    """Raw counts of the scene, lazy or in memory."""
    dark: xr.Dataset | None
    """Raw counts of its dark files, lazy."""
    ancillaries: Ancillaries
    station_altitude: float
    """m above mean sea level."""
    shared: dict[Any, Any] = field(default_factory=dict)
    """What one channel computed and others need too."""

    @property
    def geometry(self) -> xr.Dataset:
        """Times and pointing of all profiles."""
        return self.archive[[name for name in GEOMETRY if name in self.archive]]


class Chunk:
    """Consecutive profiles of a scene, with their counts in memory."""

    def __init__(self, counts: xr.Dataset, first: int) -> None:
        self.counts = counts
        self.rows = slice(first, first + counts.sizes["time"])
        """Place of the profiles in the scene."""
        self._profiles: dict[int, xr.Dataset] = {}

    @property
    def geometry(self) -> xr.Dataset:
        """Times and pointing of the profiles."""
        return self.counts[[name for name in GEOMETRY if name in self.counts]]

    def profiles(self, profiles: Profiles) -> xr.Dataset:
        """Return power, variance and quality of the profiles, computed once for all products."""
        key = id(profiles)
        if key not in self._profiles:
            self._profiles[key] = profiles.of(self.counts)
        return self._profiles[key]


class BackgroundSettings(SettingsModel):
    """How a background is estimated."""

    method: Literal["tail_mean", "cubic", "known_shape"]
    range: tuple[float, float] = quantity(unit="m")


class Profiles(ABC):
    """How the profiles of a channel follow from raw counts."""

    @property
    @abstractmethod
    def range(self) -> npt.NDArray[np.float64]:
        """Ranges of the bin centres, m."""

    @abstractmethod
    def shots(self, counts: xr.Dataset) -> xr.DataArray:
        """Return the number of laser shots of each profile."""

    @abstractmethod
    def of(self, counts: xr.Dataset) -> xr.Dataset:
        """Return power, variance and quality of profiles, (time, range)."""

    @abstractmethod
    def averages(self, geometry: xr.Dataset, shots: xr.DataArray, seconds: float) -> Averages:
        """Return an empty average of profiles over clock intervals."""

    @property
    @abstractmethod
    def recorded(self) -> tuple[LaggedProfiles, ...]:
        """The channels of the files of which the profiles are made."""

    @abstractmethod
    def joined(self, *means: xr.Dataset) -> xr.Dataset:
        """Return the means of the profiles from those of `recorded`, which are screened."""


class RecordedProfiles(Profiles):
    """Profiles of a channel that the files hold."""

    @abstractmethod
    def record(
        self, geometry: xr.Dataset, shots: xr.DataArray, seconds: float, lag: int = 0
    ) -> Record:
        """Return the record of an empty screened average."""


@dataclass(frozen=True, slots=True)
class LaggedProfiles:
    """A channel of the files of which profiles are made."""

    profiles: RecordedProfiles
    lag: int
    """Bins by which it lags behind the profiles."""


class Averages(ABC):
    """Means of profiles over clock intervals, in the making."""

    @abstractmethod
    def add(self, chunk: Chunk, rows: Indices | None = None) -> None:
        """Add the next profiles: all of a chunk, or some of its rows."""

    @property
    @abstractmethod
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""

    @abstractmethod
    def completed(self) -> Iterator[xr.Dataset]:
        """Yield the means that are complete, in batches, and forget them.

        They have power, variance and quality over (time, range).
        """


class WholeProduct(ABC):
    """A product that is retrieved when all profiles are known, in reduced form."""

    @property
    def reads(self) -> bool:
        """Whether the product needs the counts of the profiles."""
        return True

    def ends(self) -> Indices | None:
        """Return the rows before which a chunk may end; None for any."""
        return None

    @abstractmethod
    def add(self, chunk: Chunk) -> None:
        """Take the next profiles."""

    @abstractmethod
    def results(self) -> Iterator[xr.Dataset]:
        """Yield the frame of the product, then its rows in batches; see `RowProduct.rows`."""


def in_one_batch(product: xr.Dataset) -> Iterator[xr.Dataset]:
    """Yield a whole product as its frame, and as its rows."""
    yield product
    yield product


class RowProduct(ABC):
    """A product whose rows are written as soon as their profiles are known."""

    @abstractmethod
    def rows(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Take the next profiles, and yield the rows that are complete, in batches.

        Before the first of them comes the frame: the coordinates of all rows, and what does not
        depend on time.
        """


ProductStream = WholeProduct | RowProduct


@dataclass(slots=True)
class Data:
    """What the steps of one channel have given so far, by name."""

    source: Source
    channel: str
    channels: Mapping[str, Data]
    """Data of the channels that were prepared before."""
    statements: list[str] = field(default_factory=list)
    """What steps decided from the data, in words for the product."""
    notes: list[str] = field(default_factory=list)
    """What the report of the run states of the data, such as requested values that they do not
    give."""
    _values: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, datum: Datum[T]) -> T:
        """Return what a step has given."""
        value: T = self._values[datum.name]
        return value

    def __setitem__(self, datum: Datum[T], value: T) -> None:
        """Keep what a step gives."""
        self._values[datum.name] = value

    def get(self, datum: Datum[T]) -> T | None:
        """Return what a step has given; None where the step is left out."""
        return self._values.get(datum.name)

    def of_product(self) -> Data:
        """Return a copy for the steps of one product, which other products do not see."""
        words, notes, values = list(self.statements), list(self.notes), dict(self._values)
        return Data(self.source, self.channel, self.channels, words, notes, values)

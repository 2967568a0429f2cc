"""What the pipe works on: the opened files of a scene, the signal of a channel, and products."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.constants import DEAD_TIME_UNCERTAINTY
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.scene.profiles import CHUNK_BYTES, GEOMETRY, Chunk, Indices, Profiles

IN_MEMORY: Final = 2_000_000
"""Bytes of counts up to which a scene is one chunk: below, chunks cost more than they save."""
READ_TOGETHER: Final = 8
"""Chunks of dask in a chunk, so that few profiles are read twice where it ends within one."""


@dataclass(frozen=True, slots=True)
class Source:
    """The opened files of a scene, from which the signals of all its channels are made."""

    archive: xr.Dataset
    """Raw counts of all profiles of the scene, lazy or in memory."""
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

    @property
    def pointing(self) -> dict[str, float]:
        """Pointing of the first profile, which is that of all of a fixed beam, degree."""
        names = [name for name in ("zenith_angle", "azimuth") if name in self.archive]
        return {name: float(self.archive[name][0]) for name in names}


@dataclass(slots=True)
class ChannelSignal:
    """The signal of one channel of a scene, as the stages of the pipe fill it in."""

    source: Source
    channel: str
    channels: Mapping[str, ChannelSignal]
    """The channels that it is made from, and itself."""
    wavelength: float = field(init=False)
    """m."""
    full_overlap_range: float | None = None
    """m, nearer bins are flagged."""
    overlap: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]] | None = None
    """Returns the overlap at ranges in m."""
    range_offset: float = 0.0
    """m, added to the range of every bin."""
    dark: DarkSignals | None = None
    dead_time: float | None = None
    """s."""
    dead_time_uncertainty: float = DEAD_TIME_UNCERTAINTY
    """Relative standard error of the dead time."""
    estimated_lag: bool = False
    """Whether the lag of a glued channel is to be estimated."""
    relative_variance: bool = False
    """Whether the variance is estimated from the profile, and so scatters."""
    profiles: Profiles = field(init=False)
    """Power, variance and quality of the profiles of the channel."""
    molecules: MolecularProfile = field(init=False)
    """The air, of channels with a product that needs it."""
    statements: list[str] = field(default_factory=list)
    """What was decided from the data, in words for the product."""
    notes: list[str] = field(default_factory=list)
    """What the report of the run states of the data, such as requested values that they do not
    give."""

    @property
    def shots(self) -> xr.DataArray:
        """Number of laser shots of all profiles, (time,)."""
        return self.profiles.shots(self.source.archive)

    def overlap_at(self, distance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
        """Return the overlap at ranges in m; None where it is unknown."""
        return None if self.overlap is None else self.overlap(distance)


class WholeProduct(ABC):
    """A product that is retrieved when all profiles are known, in reduced form."""

    notes: Sequence[str] = ()
    """What the report of the run states of it."""

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


def chunk_profiles(bins: int, requested: int | None) -> int:
    """Return the number of profiles that are processed together, of channels with `bins` bins."""
    return max(1, requested or CHUNK_BYTES // (4 * max(bins, 1)))


def loaded(archive: xr.Dataset, channels: Iterable[str], rows: slice) -> xr.Dataset:
    """Return some profiles of channels, with their counts in memory."""
    of_channels = tuple(f"{channel}_" for channel in channels)
    names = [
        name for name in archive.variables if name in GEOMETRY or f"{name}_".startswith(of_channels)
    ]
    return archive[names].isel(time=rows).load()


def chunks(
    source: Source, channels: Sequence[str], streams: Iterable[ProductStream], profiles: int
) -> Iterator[Chunk]:
    """Yield the profiles of a scene in chunks that end where its products allow it.

    Parameters
    ----------
    source : Source
    channels : sequence of str
        Of the files, whose counts are loaded.
    streams : iterable of ProductStream
    profiles : int
        Number of profiles of a chunk, unless a product needs more together.
    """
    archive = source.archive
    streams = list(streams)
    reads = not streams or any(
        not isinstance(stream, WholeProduct) or stream.reads for stream in streams
    )
    for rows in _rows(archive.sizes["time"], _ends(streams), profiles if reads else None):
        counts = loaded(archive, channels, rows) if reads else archive.isel(time=rows)
        yield Chunk(counts, rows.start)


def _ends(streams: Iterable[ProductStream]) -> np.ndarray[Any, Any] | None:
    """Return the rows before which a chunk may end; None for any."""
    ends = [stream.ends() for stream in streams if isinstance(stream, WholeProduct)]
    limiting = [rows for rows in ends if rows is not None]
    if not limiting:
        return None
    common = limiting[0]
    for rows in limiting[1:]:
        common = np.intersect1d(common, rows)
    return common


def _rows(count: int, ends: np.ndarray[Any, Any] | None, profiles: int | None) -> Iterator[slice]:
    """Yield consecutive rows, about `profiles` together, cut before some of `ends` only."""
    size = profiles or count
    allowed = np.arange(count + 1) if ends is None else np.append(ends, count)
    first = 0
    while first < count:
        place = int(np.searchsorted(allowed, first + size, side="right")) - 1
        # More than the size where no cut is allowed within it.
        past = int(allowed[place]) if place >= 0 else 0
        if past <= first:
            past = int(allowed[np.searchsorted(allowed, first, side="right")])
        yield slice(first, past)
        first = past

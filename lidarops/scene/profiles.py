"""Profiles of a channel: of one that the files hold, and of one that is glued from two of them."""

from __future__ import annotations

import functools
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.constants import DEAD_TIME_UNCERTAINTY
from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.signal import labeled, labeled_gluing, light
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.retrieve.signal.labeled_averaging import ClockAverage, IntervalSums, Screening
from lidarops.retrieve.signal.lag import ChannelLag
from lidarops.retrieve.signal.thresholds import THRESHOLDS
from lidarops.scene.air import ChosenAir

Indices = npt.NDArray[np.int64]

CHUNK_BYTES: Final = 4_000_000
"""Bytes of raw counts that are processed together."""
GEOMETRY: Final = ("time", "time_bnds", "zenith_angle", "azimuth")
"""Coordinates that every product over the time of the profiles has."""
LIGHTLESS: Final = "lightless"
"""End of the name of the variable of a channel that tells which profiles hold no light."""
BEFORE: Final = "before_"
"""Begin of the name of the bins of a channel before the pulse."""
_PARTS: Final = ("power", "variance", "quality")


class Chunk:
    """Consecutive profiles of a scene, with their counts in memory."""

    def __init__(self, counts: xr.Dataset, rows: slice) -> None:
        self.counts, self.rows = counts, rows
        """Counts of the profiles, and their place in the scene."""
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


def bin_ranges(archive: xr.Dataset, channel: str, offset: float) -> npt.NDArray[np.float64]:
    """Return the ranges of the bin centres of a channel of the files, m, shifted by an offset."""
    # As `condition` adds it, in the type of the coordinate.
    distance = archive[str(archive[channel].dims[-1])].to_numpy() + offset
    return np.asarray(distance, dtype=np.float64)


@dataclass(frozen=True, eq=False, slots=True)
class FileProfiles:
    """Profiles of a channel that the files hold."""

    channel: str
    range: npt.NDArray[np.float64]
    """Ranges of the bin centres, m."""
    dark: DarkSignals | None
    """The dark signals that are subtracted."""
    condition: Callable[[xr.Dataset, str], xr.Dataset]
    """`lidarops.retrieve.signal.labeled.condition` with its settings."""
    of_before: Callable[[xr.Dataset, str], xr.Dataset] | None = None
    """As `condition`, of the bins before the pulse."""

    def shots(self, counts: xr.Dataset) -> xr.DataArray:
        """Return the number of laser shots of each profile."""
        return counts[f"{self.channel}_shots"]

    def of(self, counts: xr.Dataset) -> xr.Dataset:
        """Return power, variance and quality of profiles."""
        conditioned = self.condition(counts, self.channel)
        if (dark := f"{self.channel}_{LIGHTLESS}") in counts:
            conditioned["quality"][counts[dark].to_numpy()] = np.int32(Quality.NO_SIGNAL)
        if self.of_before is None:
            return conditioned
        before = self.of_before(counts, f"{BEFORE}{self.channel}")
        return conditioned.assign({labeled.SKY: (("time", "sky_part"), labeled.sky_before(before))})

    @property
    def recorded(self) -> tuple[tuple[FileProfiles, int], ...]:
        """The channel itself, with its lag of no bins."""
        return ((self, 0),)

    def joined(self, *means: xr.Dataset, cells: bool = False) -> xr.Dataset:  # noqa: ARG002
        """Return the means of the channel from that of its one record."""
        (own,) = means
        return own


@dataclass(frozen=True, eq=False, slots=True)
class GluedProfiles:
    """Profiles that are glued from those of an analog and a photon-counting channel."""

    analog: FileProfiles
    photon: FileProfiles
    lag: ChannelLag
    """Lag of the analog record behind the photon-counting one."""
    slope: Callable[[], labeled_gluing.Slope]
    """Returns that of profiles that cannot be glued. Kinds that take means do not compare them."""

    @property
    def range(self) -> npt.NDArray[np.float64]:
        """Ranges of the bin centres, m."""
        return self.photon.range[: self.analog.range.size]

    def shots(self, counts: xr.Dataset) -> xr.DataArray:
        """Return the number of laser shots of each profile."""
        return self.photon.shots(counts)

    def of(self, counts: xr.Dataset) -> xr.Dataset:
        """Return power, variance and quality of profiles, and the variables of the gluing."""
        records = self.analog.of(counts), self.photon.of(counts)
        return labeled_gluing.glue(*records, self.lag, self.slope())

    @property
    def recorded(self) -> tuple[tuple[FileProfiles, int], ...]:
        """Both parts, with the bins by which they lag behind the channel.

        The photon-counting one comes last, whose bins are those of the channel.
        """
        return (self.analog, round(self.lag.bins)), (self.photon, 0)

    def joined(self, *means: xr.Dataset, cells: bool = False) -> xr.Dataset:
        """Return the glued means of both records, with those of cells where these are screened."""
        analog, photon = means
        glued = labeled_gluing.glue(analog, photon, self.lag)
        kept = photon.isel(range=slice(glued.sizes["range"])).drop_vars(_PARTS)
        kept = kept.drop_vars(labeled.SKY, errors="ignore")
        joined = kept.assign(glued.variables)
        return joined.assign(labeled_gluing.glue_cells(analog, photon, glued)) if cells else joined


Profiles = FileProfiles | GluedProfiles
"""How the profiles of a channel follow from raw counts."""


class Averages:
    """Means of the profiles of channels over clock intervals.

    With a screening, a part of an interval that is outlying in any channel is left out of all. The
    means of a channel have the variables of
    `lidarops.retrieve.signal.labeled_averaging.ClockAverage.completed`.

    Parameters
    ----------
    channels : sequence of Profiles
        With bins of equal width.
    geometry : xr.Dataset
        ``time`` and ``time_bnds`` of all profiles.
    shots : xr.DataArray, (time,)
        Of all profiles.
    seconds : float
        Length of an interval.
    screening : Screening, optional
    """

    def __init__(
        self,
        channels: Sequence[Profiles],
        geometry: xr.Dataset,
        shots: xr.DataArray,
        seconds: float,
        screening: Screening | None = None,
    ) -> None:
        self._channels, self._screened = channels, screening is not None
        self._begun = False
        self._recorded = [record for channel in channels for record, _ in channel.recorded]
        first = channels[-1].range
        width = float(np.median(np.diff(first))) if first.size > 1 else 1.0
        parts = THRESHOLDS.most_parts if self._screened else 1
        records = [
            IntervalSums(
                geometry,
                record.range,
                seconds=seconds,
                shots=shots,
                shared_variance=None if record.dark is None else record.dark.variance,
                parts=parts,
                lag=lag + round((first[0] - channel.range[0]) / width),
            )
            for channel in channels
            for record, lag in channel.recorded
        ]
        self._means = ClockAverage(records, screening)

    def add(self, chunk: Chunk, rows: Indices | None = None) -> None:
        """Add the next profiles: all of a chunk, or some of its rows."""
        profiles = (chunk.profiles(record) for record in self._recorded)
        self._means.add([one if rows is None else one.isel(time=rows) for one in profiles])

    def rows(self, chunk: Chunk, made: Callable[..., xr.Dataset]) -> Iterator[xr.Dataset]:
        """Add all profiles of a chunk, and yield what is made of means, after its frame.

        As a `ProductStream`; `made` takes means of each channel.
        """
        self.add(chunk)
        for means in self.completed():
            rows = made(*means)
            if not self._begun:
                self._begun = True
                yield rows.drop_dims("time").assign_coords(self._means.times.coords)
            yield rows

    def completed(self) -> Iterator[tuple[xr.Dataset, ...]]:
        """Yield the means that are complete, in batches, of each channel; and forget them."""
        for records in self._means.completed():
            means = iter(records)
            yield tuple(
                channel.joined(
                    *itertools.islice(means, len(channel.recorded)), cells=self._screened
                )
                for channel in self._channels
            )


def gluing(profiles: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the variables that describe the gluing; none where profiles are not glued."""
    return {str(name): array for name, array in profiles.items() if str(name).startswith("glue_")}


IN_MEMORY: Final = 2_000_000
"""Bytes of counts up to which a scene is one chunk: below, chunks cost more than they save."""


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
    wavelength: float
    """m."""
    full_overlap_range: float | None = None
    """m, nearer bins are flagged."""
    overlap: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]] | None = None
    """Returns the overlap at ranges in m."""
    range_offset: float = 0.0
    """m, added to the range of every bin."""
    dead_time: float | None = None
    """s."""
    dead_time_uncertainty: float = DEAD_TIME_UNCERTAINTY
    """Relative standard error of the dead time."""
    relative_variance: bool = False
    """Whether the variance is estimated from the profile, and so scatters."""
    profiles: Profiles = field(init=False)
    """Power, variance and quality of the profiles of the channel."""
    molecules: MolecularProfile = field(init=False)
    """The air, of channels with a product that needs it."""
    air: ChosenAir | None = None
    """The profiles that it is made of, if the campaign gives sources and one of them holds."""
    air_error: float | None = None
    """Relative error of its density; None where the campaign gives no sources."""
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


class ProductStream(ABC):
    """A product in the making, which takes the profiles of its scene in chunks.

    Before its first rows it yields its frame: the coordinates of all rows, and what does not depend
    on time.
    """

    notes: Sequence[str] = ()
    """What the report of the run states of it."""

    def ends(self) -> Indices | None:
        """Return the rows before which a chunk may end; None for any."""
        return None

    @abstractmethod
    def add(self, chunk: Chunk) -> Iterable[xr.Dataset]:
        """Take the next profiles, and yield the rows that are complete, in batches."""

    def results(self) -> Iterator[xr.Dataset]:
        """Yield the rows of a product that is retrieved when all profiles are known."""
        return iter(())


def lightless_profiles(
    archive: xr.Dataset, requested: int | None
) -> dict[str, npt.NDArray[np.bool_]]:
    """Return which profiles hold no light of the laser, (time,), of channels that have any.

    Parameters
    ----------
    archive : xr.Dataset
        Raw counts of all channels and bins of a scene, lazy: the answer is the same whatever is
        made of it.
    requested : int, optional
        Number of profiles that are read together.
    """
    found, lasers = {}, {}
    for name in [name for name in map(str, archive) if f"{name}_shots" in archive]:
        counts, attributes = archive[name], archive[name].attrs
        together = max(1, requested or CHUNK_BYTES // (4 * counts.shape[1]))
        parts = [
            light.excess_over_far(counts[first : first + together].to_numpy())
            for first in range(0, len(counts), together)
        ]
        excess, variance, blank = (np.concatenate(part) for part in zip(*parts, strict=True))
        measured = archive[f"{name}_shots"].to_numpy() > 0
        found[name] = light.light_of(excess, variance, blank, measured)
        # Without a laser in the header, channels of one wavelength have one.
        lasers[name] = str(attributes.get("laser", attributes["wavelength_label"]))
    return {name: rows for name, rows in light.lightless(found, lasers).items() if rows.any()}


def in_one_batch(product: xr.Dataset) -> Iterator[xr.Dataset]:
    """Yield a whole product as its frame, and as its rows."""
    yield product
    yield product


def profiles_together(source: Source, channels: Iterable[str], requested: int | None) -> int:
    """Return the number of profiles of channels of the files that are processed together."""
    counts = [source.archive[name] for name in channels]
    if requested is None and sum(array.nbytes for array in counts) <= IN_MEMORY:
        return int(source.archive.sizes["time"])
    bins = sum(int(array.shape[1]) for array in counts)
    return max(1, requested or CHUNK_BYTES // (4 * max(bins, 1)))


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
    archive, count = source.archive, source.archive.sizes["time"]
    limiting = [rows for stream in streams if (rows := stream.ends()) is not None]
    allowed = functools.reduce(np.intersect1d, limiting, np.arange(count + 1))
    if not allowed.size or allowed[-1] < count:
        allowed = np.append(allowed, count)
    wanted = (*GEOMETRY, *channels, *(f"{BEFORE}{name}" for name in channels))
    known = tuple(f"{name}_" for name in wanted)
    archive = archive[[name for name in archive.variables if f"{name}_".startswith(known)]]
    first = 0
    while first < count:
        place = int(np.searchsorted(allowed, first + profiles, side="right")) - 1
        # More than the size where no cut is allowed within it.
        past = int(allowed[place]) if place >= 0 else 0
        if past <= first:
            past = int(allowed[np.searchsorted(allowed, first, side="right")])
        chunk = slice(first, past)
        yield Chunk(archive.isel(time=chunk).load(), chunk)
        first = past

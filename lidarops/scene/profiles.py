"""Profiles of a channel: of one that the files hold, and of one that is glued from two of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Final, TypedDict

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.retrieve.signal import labeled, labeled_gluing
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.retrieve.signal.labeled_averaging import (
    ClockAverage,
    Record,
    ScreenedAverage,
    Screening,
)
from lidarops.retrieve.signal.thresholds import THRESHOLDS

Indices = npt.NDArray[np.int64]

CHUNK_BYTES: Final = 4_000_000
"""Bytes of raw counts that are processed together."""
GEOMETRY: Final = ("time", "time_bnds", "zenith_angle", "azimuth")
"""Coordinates that every product over the time of the profiles has."""
_PARTS: Final = ("power", "variance", "quality")


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


class Conditioning(TypedDict):
    """Arguments of `lidarops.retrieve.signal.labeled.condition`."""

    dead_time: float | None
    dead_time_uncertainty: float
    noise_variance: float | None
    baseline_uncertainty: float | None
    dark: DarkSignals | None
    range_offset: float
    full_overlap_range: float


def bin_ranges(archive: xr.Dataset, channel: str, offset: float) -> npt.NDArray[np.float64]:
    """Return the ranges of the bin centres of a channel of the files, m, shifted by an offset."""
    # As `condition` adds it, in the type of the coordinate.
    distance = archive[str(archive[channel].dims[-1])].to_numpy() + offset
    return np.asarray(distance, dtype=np.float64)


class FileProfiles:
    """Profiles of a channel that the files hold.

    Parameters
    ----------
    archive : xr.Dataset
        The raw counts of the scene, whose ranges are used.
    channel : str
    settings : Conditioning
    """

    def __init__(self, archive: xr.Dataset, channel: str, settings: Conditioning) -> None:
        self._channel, self._settings = channel, settings
        self._range = bin_ranges(archive, channel, settings["range_offset"])

    @property
    def range(self) -> npt.NDArray[np.float64]:
        """Ranges of the bin centres, m."""
        return self._range

    def shots(self, counts: xr.Dataset) -> xr.DataArray:
        """Return the number of laser shots of each profile."""
        return counts[f"{self._channel}_shots"]

    def of(self, counts: xr.Dataset) -> xr.Dataset:
        """Return power, variance and quality of profiles."""
        return labeled.condition(counts, self._channel, **self._settings)

    def means(
        self, geometry: xr.Dataset, shots: xr.DataArray, seconds: float, parts: int | None = None
    ) -> ClockAverage:
        """Return the empty mean over clock intervals."""
        dark = self._settings["dark"]
        return ClockAverage(
            geometry,
            self._range,
            seconds=seconds,
            shots=shots,
            shared_variance=None if dark is None else dark.variance,
            parts=parts,
        )

    def record(
        self, geometry: xr.Dataset, shots: xr.DataArray, seconds: float, lag: int = 0
    ) -> Record:
        """Return the record of an empty screened average."""
        parts = THRESHOLDS.most_parts
        return Record(self.means(geometry, shots, seconds, parts), self._range, lag)

    @property
    def recorded(self) -> tuple[tuple[FileProfiles, int], ...]:
        """The channel itself, with its lag of no bins."""
        return ((self, 0),)

    def joined(self, *means: xr.Dataset, cells: bool = False) -> xr.Dataset:  # noqa: ARG002
        """Return the means of the channel from that of its one record."""
        (own,) = means
        return own


class GluedProfiles:
    """Profiles that are glued from those of an analog and a photon-counting channel.

    Parameters
    ----------
    analog, photon : FileProfiles
    lag : ChannelLag
        Lag of the analog record behind the photon-counting one.
    slope : callable
        Returns that of profiles that cannot be glued. Kinds that take means do not compare them.
    """

    def __init__(
        self,
        analog: FileProfiles,
        photon: FileProfiles,
        lag: labeled_gluing.ChannelLag,
        slope: Callable[[], labeled_gluing.Slope],
    ) -> None:
        self._analog, self._photon, self._lag, self._slope = analog, photon, lag, slope

    @property
    def range(self) -> npt.NDArray[np.float64]:
        """Ranges of the bin centres, m."""
        return self._photon.range[: self._analog.range.size]

    def shots(self, counts: xr.Dataset) -> xr.DataArray:
        """Return the number of laser shots of each profile."""
        return self._photon.shots(counts)

    def of(self, counts: xr.Dataset) -> xr.Dataset:
        """Return power, variance and quality of profiles, and the variables of the gluing."""
        records = self._analog.of(counts), self._photon.of(counts)
        return labeled_gluing.glue(*records, self._lag, self._slope())

    @property
    def recorded(self) -> tuple[tuple[FileProfiles, int], ...]:
        """Both parts, with the bins by which they lag behind the channel.

        The photon-counting one comes last, whose bins are those of the channel.
        """
        return (self._analog, round(self._lag.bins)), (self._photon, 0)

    def joined(self, *means: xr.Dataset, cells: bool = False) -> xr.Dataset:
        """Return the glued means of both records, with those of cells where these are screened."""
        analog, photon = means
        glued = labeled_gluing.glue(analog, photon, self._lag)
        kept = photon.isel(range=slice(glued.sizes["range"])).drop_vars(_PARTS)
        joined = kept.assign(glued.variables)
        return joined.assign(labeled_gluing.glue_cells(analog, photon, glued)) if cells else joined


Profiles = FileProfiles | GluedProfiles
"""How the profiles of a channel follow from raw counts."""


class Averages:
    """Means of the profiles of a channel over clock intervals.

    Parameters
    ----------
    channel : Profiles
    geometry : xr.Dataset
        ``time`` and ``time_bnds`` of all profiles.
    shots : xr.DataArray, (time,)
        Of all profiles.
    seconds : float
        Length of an interval.
    """

    def __init__(
        self, channel: Profiles, geometry: xr.Dataset, shots: xr.DataArray, seconds: float
    ) -> None:
        self._channel = channel
        self._recorded = [record for record, _ in channel.recorded]
        self._means = [record.means(geometry, shots, seconds) for record in self._recorded]

    def add(self, chunk: Chunk, rows: Indices | None = None) -> None:
        """Add the next profiles: all of a chunk, or some of its rows."""
        for record, means in zip(self._recorded, self._means, strict=True):
            conditioned = chunk.profiles(record)
            means.add(conditioned if rows is None else conditioned.isel(time=rows))

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return self._means[-1].times

    def completed(self) -> Iterator[xr.Dataset]:
        """Yield the means that are complete, in batches, and forget them."""
        for means in zip(*(means.completed() for means in self._means), strict=True):
            yield self._channel.joined(*means)


class ScreenedAverages:
    """Means of the profiles of channels over clock intervals, without outlying parts.

    A part that is outlying in any channel is left out of all. The means of a channel have the
    variables of `lidarops.retrieve.signal.labeled_averaging.ScreenedAverage.completed`.

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
    screening : Screening
    """

    def __init__(
        self,
        channels: Sequence[Profiles],
        geometry: xr.Dataset,
        shots: xr.DataArray,
        seconds: float,
        screening: Screening,
    ) -> None:
        self._channels = channels
        self._recorded = [record for channel in channels for record, _ in channel.recorded]
        first = channels[-1].range
        width = float(np.median(np.diff(first))) if first.size > 1 else 1.0
        records = [
            record.record(
                geometry,
                shots,
                seconds,
                lag + round((first[0] - channel.range[0]) / width),
            )
            for channel in channels
            for record, lag in channel.recorded
        ]
        self._means = ScreenedAverage(records, screening)

    def add(self, chunk: Chunk) -> None:
        """Add the profiles of the next chunk."""
        self._means.add([chunk.profiles(profiles) for profiles in self._recorded])

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return self._means.times

    def completed(self) -> Iterator[tuple[xr.Dataset, ...]]:
        """Yield the means that are complete, in batches, of each channel."""
        for records in self._means.completed():
            means = iter(records)
            yield tuple(
                channel.joined(*itertools.islice(means, len(channel.recorded)), cells=True)
                for channel in self._channels
            )


def gluing(profiles: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the variables that describe the gluing; none where profiles are not glued."""
    return {str(name): array for name, array in profiles.items() if str(name).startswith("glue_")}

"""Daily and monthly means of products with errors, written as NetCDF files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lidarops.aggregate._join import shared_attributes
from lidarops.aggregate._samples import Profiles, read_profiles
from lidarops.aggregate._sums import Array, Sample, Sums
from lidarops.aggregate.facts import FOLDER, Facts, Group, Refused, refuse_duplicates
from lidarops.aggregate.means_file import (
    Frame,
    Lineage,
    Periods,
    encode_means,
    means_provenance,
    means_version,
    read_frame,
)
from lidarops.aggregate.means_variables import MeansDescription, Period, Weights
from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.netcdf.context import UNUSED_INPUTS
from lidarops.netcdf.quantities import CLOUD_FRACTION
from lidarops.netcdf.variables import layout_of, whole_error
from lidarops.netcdf.write import write_product

_UNITS: Final = {Period.DAY: "D", Period.MONTH: "M"}

Record = Mapping[str, NDArray[Any]]


_ALL_BITS: Final = np.int32(-1)
_WEIGHED: Final = np.int32(Quality.LOW_SIGNAL_TO_NOISE)


@dataclass(frozen=True, slots=True)
class MeansFile:
    """A file of means that was written."""

    path: str
    """Relative to the root of the products, with forward slashes."""
    sha256: str
    size: int
    periods: int
    products: int


@dataclass(frozen=True, slots=True)
class MeansResult:
    """Files of means of one group, and products that could not be read."""

    files: tuple[MeansFile, ...]
    refused: tuple[Refused, ...]
    note: str = ""
    """Why the group has no means by its nature; empty where it has."""


def write_means(
    root: Path,
    products: Sequence[Facts],
    period: Period,
    *,
    weights: Weights = Weights.SHOTS,
) -> MeansResult:
    """Write the means of one group of products, one file per calendar year.

    Products are read one after the other, so that only one product and its periods are in memory.
    Unreadable products are reported and left out.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; files are written to its ``aggregates/means``.
    products : sequence of Facts
        Of one group, sorted by time (`lidarops.aggregate.facts.groups`).
    period : Period
    weights : Weights

    Returns
    -------
    MeansResult

    Raises
    ------
    ProductError
        If two products have a profile at the same time, or a file cannot be
        written.
    """
    averaging = _Averaging(period, weights)
    frame: Frame | None = None
    refused = []
    for facts in products:
        try:
            group_frame = frame or read_frame(root, facts)
            profiles = read_profiles(root, facts)
        except ProductError as error:
            refused.append(Refused(facts.path, error.problem))
            continue
        if group_frame.moving:
            note = f"no means of {facts.kind}: profiles of several directions have none"
            return MeansResult((), tuple(refused), f"{note} ({facts.path})")
        frame = group_frame
        averaging.add(profiles)
    averaging.finish()
    files = () if frame is None else tuple(_written(root, products[0].group, frame, averaging))
    return MeansResult(files, tuple(refused))


@dataclass(slots=True)
class _PeriodSums:
    """Sums of all quantities over one period."""

    kind: str
    weights: Weights
    quantities: dict[str, Sums] = field(default_factory=dict)
    profiles: int = 0
    usable: Any = 0
    """Number of usable profiles, with the shape of the flags without time."""
    good: Any = 0
    """Number of profiles whose value has no bit."""
    flags: Any = 0
    """Bits of all values."""
    usable_flags: Any = 0
    """Bits of the usable values."""
    common_flags: Any = _ALL_BITS
    """Bits that all usable values have."""
    shots: float = 0.0
    clouds: _CloudSums | None = None

    def add(self, profiles: Profiles, chosen: NDArray[np.intp]) -> None:
        for name, sample in profiles.samples.items():
            part = sample.take(chosen)
            if name not in self.quantities:
                self.quantities[name] = Sums.like(part)
            self.quantities[name].add(part, _weights(self.weights, part, profiles.shots[chosen]))
        flags = profiles.flags[chosen]
        usable = (flags & np.int32(flags_of(self.kind).rejecting)) == 0
        self.profiles += chosen.size
        self.usable = self.usable + usable.sum(axis=0)
        self.good = self.good + (flags == 0).sum(axis=0)
        self.flags = self.flags | np.bitwise_or.reduce(flags, axis=0)
        # Of the mean, not of its members: see `record`.
        kept = np.where(usable, flags & ~_WEIGHED, np.int32(0))
        self.usable_flags = self.usable_flags | np.bitwise_or.reduce(kept, axis=0)
        common = np.bitwise_and.reduce(np.where(usable, flags, _ALL_BITS), axis=0)
        self.common_flags = self.common_flags & common
        shots = profiles.shots[chosen]
        self.shots += float(shots.sum())
        if profiles.cloud_fraction is not None:
            self.clouds = self.clouds or _CloudSums()
            weights = np.ones(shots.size) if self.weights is Weights.PLAIN else shots
            self.clouds.add(profiles.cloud_fraction[chosen], usable, weights)

    def record(self) -> dict[str, NDArray[Any]]:
        """Return the variables of the period, without dimension time."""
        usable_flags = self.usable_flags
        if self.clouds is not None:
            usable_flags = _cloudy_flags(self.kind, usable_flags, self.common_flags)
        flags = np.where(self.usable > 0, usable_flags, self.flags)
        weighed = layout_of(self.kind).weighed
        variables: dict[str, NDArray[Any]] = {
            "usable_share": self.usable / np.float64(self.profiles),
            "good_share": self.good / np.float64(self.profiles),
            "shots": np.asarray(self.shots),
        }
        if self.clouds is not None:
            variables[CLOUD_FRACTION] = self.clouds.mean()
        for name, sums in self.quantities.items():
            mean = sums.mean()
            variables[name] = mean.mean
            variables[f"{name}_standard_error"] = mean.standard_error
            variables[f"{name}_standard_deviation"] = mean.standard_deviation
            variables[f"{name}_observations"] = mean.observations
            variables |= mean.systematic
            if name in weighed:
                error = whole_error(variables, name)
                flags = flags | np.where(np.abs(mean.mean) < error, _WEIGHED, np.int32(0))
            if mean.mean.shape == flags.shape:
                # Usable values without an error for weighting give no mean: flag it as missing.
                unflagged = ~np.isfinite(mean.mean) & (flags == 0)
                flags = np.where(unflagged, np.int32(Quality.INPUT_MISSING), flags)
        return {**variables, "quality_flag": flags}


@dataclass(slots=True)
class _CloudSums:
    """Weighted sums of the share of cloudy profiles of usable values."""

    value: Any = 0.0
    weight: Any = 0.0

    def add(self, fraction: Array, usable: NDArray[np.bool_], weights: Array) -> None:
        used = usable & np.isfinite(fraction)
        of_values = np.where(used, weights.reshape(-1, *(1,) * (fraction.ndim - 1)), 0.0)
        self.value = self.value + (of_values * np.where(used, fraction, 0.0)).sum(axis=0)
        self.weight = self.weight + of_values.sum(axis=0)

    def mean(self) -> Array:
        known = self.weight > 0.0
        return np.where(known, self.value / np.where(known, self.weight, 1.0), np.nan)


def _cloudy_flags(kind: str, flags: Any, common: Any) -> Any:
    """Return the bits of a mean, of which some values or all in it are those of clouds."""
    bits = (flags_of(kind).named(word) for word in ("cloud", "partly_cloudy"))
    cloud, partly = (np.int32(bit or 0) for bit in bits)
    some = ((flags & (cloud | partly)) != 0) & ((common & cloud) == 0)
    return np.where(some, flags & ~cloud | partly, flags)


def _weights(weights: Weights, sample: Sample, shots: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of the values of a sample."""
    if weights is Weights.INVERSE_VARIANCE:
        with np.errstate(divide="ignore"):
            return np.asarray(sample.errors**-2.0)
    of_profiles = shots if weights is Weights.SHOTS else np.ones(shots.size)
    along = of_profiles.reshape(-1, *(1,) * (sample.values.ndim - 1))
    return np.broadcast_to(along, sample.values.shape)


@dataclass(slots=True)
class _Year:
    """Means of one calendar year and their inputs."""

    keys: list[np.datetime64] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    inputs: dict[str, Facts] = field(default_factory=dict)
    shared: dict[str, Any] | None = None
    """Attributes that are equal in all products so far."""
    modified: str = ""
    """``date_modified`` of the newest product so far; such times in UTC sort as texts."""
    version: int = 0
    """Sum of the versions of the products so far."""
    partial: int = 0
    """Number of products so far that lack raw files of their scenes."""

    def note(self, profiles: Profiles) -> None:
        path = profiles.facts.path
        if path not in self.inputs:
            self.inputs[path] = profiles.facts
            so_far = profiles.attributes if self.shared is None else self.shared
            self.shared = shared_attributes([so_far, profiles.attributes])
            self.version += int(profiles.attributes["product_version"])
            self.partial += UNUSED_INPUTS in profiles.attributes
            self.modified = max(self.modified, str(profiles.attributes.get("date_modified", "")))

    def close(self, key: np.datetime64, sums: _PeriodSums) -> None:
        self.keys.append(key)
        self.records.append(sums.record())


@dataclass(slots=True)
class _Averaging:
    """Accumulates products and collects the means by year."""

    period: Period
    weights: Weights
    years: dict[int, _Year] = field(default_factory=dict)
    _open: dict[np.datetime64, _PeriodSums] = field(default_factory=dict)
    _times: list[Array] = field(default_factory=list)
    _owners: list[str] = field(default_factory=list)

    def add(self, profiles: Profiles) -> None:
        """Add a product; products must be added in order of their start."""
        facts = profiles.facts
        self._close(before=np.datetime64(facts.start.replace(tzinfo=None), "ms"))
        self._times.append(profiles.times)
        self._owners += [facts.path] * profiles.times.size
        for key, chosen in self._periods(profiles.times):
            self.years.setdefault(_year(key), _Year()).note(profiles)
            sums = self._open.setdefault(key, _PeriodSums(facts.kind, self.weights))
            sums.add(profiles, chosen)

    def finish(self) -> None:
        """Close all periods.

        Raises
        ------
        ProductError
            If two products have a profile at the same time.
        """
        if self._times:
            refuse_duplicates(np.concatenate(self._times), self._owners)
        self._close(before=None)

    def _close(self, *, before: np.datetime64 | None) -> None:
        done = [key for key in self._open if before is None or key + 1 <= before]
        for key in sorted(done):
            self.years[_year(key)].close(key, self._open.pop(key))

    def _periods(self, times: Array) -> Iterator[tuple[np.datetime64, NDArray[np.intp]]]:
        # Rounded to milliseconds, the accuracy of the middle of a profile.
        moments = np.datetime64(0, "ms") + np.rint(times * 1e3).astype("timedelta64[ms]")
        keys = moments.astype(f"datetime64[{_UNITS[self.period]}]")
        for key in np.unique(keys):
            yield key, np.flatnonzero(keys == key)


def _year(key: np.datetime64) -> int:
    return int(key.astype("datetime64[Y]").astype(int)) + 1970


def _written(root: Path, group: Group, frame: Frame, averaging: _Averaging) -> Iterator[MeansFile]:
    period, weights = averaging.period, averaging.weights
    for number, year in sorted(averaging.years.items()):
        keys = np.array(year.keys)
        bounds = np.stack([keys, keys + 1], axis=-1).astype("datetime64[s]")
        start, stop = (_datetime(moment) for moment in (bounds[0, 0], bounds[-1, 1]))
        lineage = Lineage(tuple(year.inputs.values()), period, weights, start, stop)
        first, last = (_datetime(pair[0] + (pair[1] - pair[0]) // 2) for pair in bounds[[0, -1]])
        about = MeansDescription(
            lineage.id,
            period,
            weights,
            start,
            stop,
            first,
            last,
            len(year.inputs),
            year.partial,
            year.modified,
            year.version,
            means_version(group.kind),
        )
        periods = Periods(bounds.astype(np.float64), year.records)
        dataset = encode_means(frame, periods, year.shared or {}, about, means_provenance(lineage))
        path = _path(group, period, weights, number)
        done = write_product(dataset, root / path)
        yield MeansFile(path, done.sha256, done.size, len(keys), len(year.inputs))


def _path(group: Group, period: Period, weights: Weights, year: int) -> str:
    folder = f"{group.station}/{group.instrument}/{group.kind}/{period.value}"
    weighted = "" if weights is Weights.SHOTS else f"_{weights.value}"
    return f"{FOLDER}/means/{folder}/{group.name}_{period.value}{weighted}_{year}.nc"


def _datetime(moment: np.datetime64) -> datetime:
    return datetime.fromtimestamp(int(moment.astype(np.int64)), UTC)

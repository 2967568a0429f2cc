"""Choose the air of a scene among the sources of the campaign.

The key ``atmosphere`` lists sources; the first one with a profile near enough in place and time
counts. One profile holds for the scene: that of the middle of its measurements.
"""

from __future__ import annotations

import json
import os
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from functools import cached_property, lru_cache
from math import asin, cos, radians, sin, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from lidarops.campaign.atmosphere import AtmosphereReading, AtmosphereSource
from lidarops.campaign.model import Campaign
from lidarops.campaign.path_patterns import path_matcher
from lidarops.errors import AncillaryError
from lidarops.records import Scene, digest
from lidarops.settings import Instant, SettingsModel, quantity
from lidarops.system.code_version import module_version
from lidarops.system.files import write_atomically

if TYPE_CHECKING:
    from lidarops.retrieve.air.molecular import MolecularProfile

SOURCE_ERROR: Final = 0.003
"""Relative standard error of the density of a profile at its time, as root mean square from 1 to
20 km: two models differ by 0.4 % (`tests/campaign/test_soundings.py`)."""
GROWTH: Final = 0.0035
"""Relative standard error that the density gains in an hour, and as the square root of time: 317
soundings over Vienna (`tests/scene/test_air.py`)."""
STANDARD_ERROR: Final = 0.03
"""The same of the standard atmosphere, by these soundings."""
SLOPE: Final = 6e-4
"""m-1; error of the derivative of the logarithm of the density over height, per relative error."""
_ONE_PLACE: Final = 10_000.0
"""m, within which soundings are taken for those of one place."""
_KEPT: Final = "atmosphere.json"
"""File in the output folder that keeps what the files of sources hold."""
_EARTH: Final = 6_371_000.0
"""m, mean radius."""
_HOUR: Final = timedelta(hours=1)


class AirProfile(SettingsModel):
    """One profile of a file, and its part of the air of a scene."""

    file: str
    number: int
    """Of the profile among those of the file that can be used."""
    time: Instant
    distance: float = quantity(unit="m")
    share: float = 1.0


class ChosenAir(SettingsModel):
    """The profiles from which the air of a scene follows."""

    origin: str
    """Of the nearest profile in time."""
    profiles: list[AirProfile]
    """One, or those before and after the middle of the scene."""
    time: Instant
    """Middle of the measurements of the scene."""
    place: tuple[float, float]
    """Latitude and longitude of the station, degree."""
    age: float = quantity(unit="s", description="from the middle to the nearest profile")
    top: float = quantity(unit="m", description="above sea level, of the lower of the profiles")
    reading: AtmosphereReading

    @property
    def distance(self) -> float:
        """Largest distance of a profile from the station, m."""
        return max(profile.distance for profile in self.profiles)

    def words(self, error: float) -> str:
        """Return the profiles in words, for products, with the relative error of the density."""
        parts = (
            f"{one.file} of {one.time:%Y-%m-%dT%H:%MZ} ({one.share:.3g})" for one in self.profiles
        )
        return (
            f"molecular: {self.origin}, {' and '.join(parts)}, for {self.time:%Y-%m-%dT%H:%MZ};"
            f" age {self.age / 3600.0:.3g} h, distance {self.distance / 1000.0:.3g} km, up to"
            f" {self.top / 1000.0:.3g} km, relative error of density {error:.2g}"
        )

    def profile(self, folder: Path) -> MolecularProfile:
        """Read the air of the scene from the files below the folder of the campaign file."""
        reading = self.reading.model_dump_json()
        first, *others = (
            _parsed(folder, one.file, _changed(folder / one.file), reading, self.place)[one.number]
            for one in self.profiles
        )
        return first.mixed(others[0], self.profiles[1].share) if others else first


@lru_cache(maxsize=2)
def _parsed(
    folder: Path,
    name: str,
    changed: tuple[int, int],  # noqa: ARG001 - another file is read again
    reading: str,
    place: tuple[float, float],
) -> tuple[MolecularProfile, ...]:
    """Return the profiles of a file, which many channels and scenes may need."""
    from lidarops.campaign.soundings import soundings  # noqa: PLC0415 - loads xarray

    stated = AtmosphereReading.model_validate_json(reading)
    return tuple(one.profile for one in soundings(folder, name, stated, place)[0])


def _changed(path: Path) -> tuple[int, int]:
    """Return size and modification time of a file; -1 where only reading it tells the problem."""
    try:
        status = os.stat(path)  # noqa: PTH116 - for each file, a Path is slow
    except OSError:
        return -1, -1
    return status.st_size, status.st_mtime_ns


class _Found(NamedTuple):
    """A profile of a file, without its levels."""

    time: datetime
    file: str
    number: int
    latitude: float
    longitude: float
    origin: str
    top: float
    """m above sea level."""


_File = tuple[str, int, int]
"""Path below the folder of the campaign file, size, modification time in ns."""


class AirFiles:
    """The profiles of all files that the sources of a campaign name.

    Files are listed at first need, and read at the first that a scene needs.

    Parameters
    ----------
    campaign : Campaign
    """

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign

    @cached_property
    def _listed(self) -> dict[tuple[str, int], list[_File]]:
        """Files of each source, by station and number."""
        return {
            (station, number): list(_files(self._campaign.folder, source))
            for station, sources in self._campaign.atmosphere.items()
            for number, source in enumerate(sources)
        }

    @cached_property
    def state(self) -> str:
        """Digest of names, sizes and modification times of the files."""
        return digest([[*source, files] for source, files in self._listed.items()])

    @cached_property
    def _found(self) -> tuple[dict[tuple[str, int], list[_Found]], dict[str, dict[str, str]]]:
        """Profiles of each source by time, and of each station path -> why it cannot be used.

        What a file holds is kept beside the catalog, until the file or the code changes.
        """
        found: dict[tuple[str, int], list[_Found]] = {}
        problems: dict[str, dict[str, str]] = {}
        kept = Path(self._campaign.output, _KEPT)
        known, used = _loaded(kept), dict[str, Any]()
        version = module_version("lidarops.campaign.soundings")
        for (station, number), files in self._listed.items():
            source, place = self._source(station, number)
            reading = AtmosphereReading.taken_from(source)
            told = problems.setdefault(station, {})
            profiles = found[station, number] = []
            if not files:
                told[", ".join(source.files)] = "matches no file"
            for file in files:
                key = digest(
                    [file, reading.model_dump(mode="json"), place, version, _Found._fields]
                )
                used[key] = known.get(key) or _read(self._campaign.folder, file[0], reading, place)
                rows, problem = used[key]
                profiles += [_Found(datetime.fromisoformat(time), *row) for time, *row in rows]
                if problem:
                    told[file[0]] = problem
            profiles.sort()
        if used != known:
            # Without, files are read again.
            with suppress(OSError):
                write_atomically(kept, json.dumps(used).encode())
        return found, problems

    def _source(self, station: str, number: int) -> tuple[AtmosphereSource, tuple[float, float]]:
        at = self._campaign.stations[station]
        return self._campaign.atmosphere[station][number], (at.latitude, at.longitude)

    def problems(self, station: str) -> dict[str, str]:
        """Return the files of a station that cannot be used, or patterns without file -> why."""
        return self._found[1].get(station, {})

    def is_given(self, station: str) -> bool:
        """Return whether the campaign gives sources for a station."""
        return bool(self._campaign.atmosphere.get(station))

    def of_scene(self, scene: Scene, height: float = 0.0) -> tuple[ChosenAir, float] | None:
        """Return the air of a scene, and the relative error of its density.

        By the first source that holds; None where none does. Where the profiles end below a height
        above the station, in m, the error is that of the standard atmosphere or larger.
        """
        starts = [granule.start for granule in scene.granules if granule.start]
        stops = [granule.stop or granule.start for granule in scene.granules if granule.start]
        begin, length = min(starts), max(filter(None, stops)) - min(starts)
        for number in range(len(self._campaign.atmosphere.get(scene.station, ()))):
            profiles = self._found[0][scene.station, number]
            source, place = self._source(scene.station, number)
            near = _near(profiles, begin + length / 2, source, place)
            if near:
                air, error = _chosen(near, begin + length / 2, length, source, place)
                needed = self._campaign.stations[scene.station].altitude + height
                return air, error if air.top >= needed else max(error, STANDARD_ERROR)
        return None


def _near(
    profiles: Sequence[_Found], time: datetime, source: AtmosphereSource, place: tuple[float, float]
) -> list[tuple[float, _Found]]:
    """Return distance and profile of the last one before a time, and of the next one after it.

    Of the nearest place that has one within the limits of the source.
    """
    first = bisect_left(profiles, time - source.greatest_age, key=lambda one: one.time)
    held: list[tuple[float, _Found]] = []
    for one in profiles[first:]:
        if one.time > time + source.greatest_age:
            break
        if (distance := _distance(one, place)) <= source.greatest_distance:
            held.append((distance, one))
    nearest = min((distance for distance, _ in held), default=0.0)
    held = [each for each in held if each[0] <= nearest + _ONE_PLACE]
    before = [each for each in held if each[1].time <= time]
    after = [each for each in held if each[1].time > time]
    if before and before[-1][1].time == time:
        return before[-1:]
    return [*before[-1:], *after[:1]]


def _chosen(
    near: Sequence[tuple[float, _Found]],
    time: datetime,
    length: timedelta,
    source: AtmosphereSource,
    place: tuple[float, float],
) -> tuple[ChosenAir, float]:
    hours = [abs(one.time - time) / _HOUR for _, one in near]
    shares = [1.0] if len(near) == 1 else [hours[1] / sum(hours), hours[0] / sum(hours)]
    # Between two profiles the error of a random walk is that of a bridge. The measurements are, in
    # the mean, a fourth of their length away from their middle.
    away = hours[0] * shares[0] if len(near) > 1 else hours[0]
    own = SOURCE_ERROR if source.relative_error is None else source.relative_error
    variance = own**2 + GROWTH**2 * (away + length / _HOUR / 4.0)
    air = ChosenAir(
        origin=near[hours.index(min(hours))][1].origin,
        profiles=[
            AirProfile(
                file=one.file,
                number=one.number,
                time=one.time,
                distance=round(distance),
                share=round(share, 6),
            )
            for (distance, one), share in zip(near, shares, strict=True)
        ],
        time=time,
        place=place,
        age=round(min(hours) * 3600.0),
        top=min(one.top for _, one in near),
        reading=AtmosphereReading.taken_from(source),
    )
    # What is stated holds, also above that of the standard atmosphere.
    return air, float(f"{min(sqrt(variance), max(own, STANDARD_ERROR)):.3g}")


def _distance(one: _Found, place: tuple[float, float]) -> float:
    """Return the distance of a profile from a place along the surface of the earth, m."""
    a, b, c, d = map(radians, (one.latitude, place[0], one.longitude, place[1]))
    chord = sin((a - b) / 2.0) ** 2 + cos(a) * cos(b) * sin((c - d) / 2.0) ** 2
    return 2.0 * _EARTH * asin(min(1.0, sqrt(chord)))


def _files(folder: Path, source: AtmosphereSource) -> Iterator[_File]:
    """Yield the files that a source names, by path."""
    matches = path_matcher(source.files)
    paths = {path for pattern in source.files for path in _paths(folder, pattern)}
    for path in sorted(filter(matches, paths)):
        yield path, *_changed(folder / path)


def _paths(folder: Path, pattern: str) -> Iterator[str]:
    """Yield the files of the folders that a pattern names; as in an archive, not behind links."""
    start = "/".join(_plain_parts(pattern)[:-1])
    for top, folders, names in os.walk(folder / start):
        inside = os.path.relpath(f"{top}/name", folder).removesuffix("name")
        if "**" not in pattern and inside.count("/") >= pattern.count("/"):
            folders.clear()
        yield from (f"{inside}{name}" for name in names)


def _plain_parts(pattern: str) -> list[str]:
    """Return the parts of a pattern up to the first that holds a wildcard, with that one."""
    parts = pattern.split("/")
    plain = next((n for n, part in enumerate(parts) if set("*?[") & set(part)), len(parts) - 1)
    return parts[: plain + 1]


def _read(
    folder: Path, name: str, reading: AtmosphereReading, place: tuple[float, float]
) -> tuple[list[list[Any]], str]:
    """Return the profiles of a file, as of `_Found`, and what of it cannot be used."""
    from lidarops.campaign.soundings import soundings  # noqa: PLC0415 - loads xarray

    try:
        read, problem = soundings(folder, name, reading, place)
    except AncillaryError as error:
        return [], str(error).removeprefix(f"{name}: ")
    tops = (round(float(one.profile.altitude[-1])) for one in read)
    return [
        [one.time.isoformat(), name, number, one.latitude, one.longitude, one.origin, top]
        for number, (one, top) in enumerate(zip(read, tops, strict=True))
    ], problem


def _loaded(kept: Path) -> dict[str, Any]:
    """Return what a former run has kept; nothing where it cannot be read."""
    try:
        return dict(json.loads(kept.read_bytes()))
    except (OSError, ValueError):
        return {}

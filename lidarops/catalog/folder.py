"""What a folder holds that no campaign describes yet: groups of like raw files, and instruments."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from enum import StrEnum
from operator import itemgetter
from statistics import median
from typing import Final

from lidarops.campaign.path_patterns import literal_pattern, path_pattern
from lidarops.catalog.raw_files import (
    HEADER_BYTES,
    Source,
    printable,
)
from lidarops.constants import FIXED, STEEPEST
from lidarops.errors import RawFormatError
from lidarops.raw.formats import parse_raw_header, time_in_path
from lidarops.raw.header import (
    TIME_REMEDY,
    HeaderPointing,
    RawHeader,
    named_layout,
    recorder_names,
)
from lidarops.records import (
    FEWEST_ALIKE,
    UNKNOWN_FORMAT,
    ChannelLayout,
    DetectionMode,
    file_channels,
    is_glued,
)
from lidarops.retrieve.raman.scattering import NITROGEN_SHIFT, WATER_SHIFT, is_raman_line
from lidarops.system.stores import Stored

_LASERS: Final = (
    355e-9, 532e-9, 1064e-9, 266e-9, 308e-9, 511e-9, 527e-9, 694e-9, 1047e-9, 1053e-9
)  # fmt: skip
"""m; lines of Nd:YAG lasers, of xenon chloride, copper vapour, Nd:YLF and ruby."""
_SAME_LINE: Final = 0.6e-9
"""m; rounding of headers."""
_ROTATIONAL: Final = 3.6e-9
"""m; rotational Raman lines lie within 3 nm of the laser line, and headers round."""
_SHORT_WORD: Final = 2
"""Letters of a stem, which may be those of a station."""
_CLEARLY: Final = 1.1
"""Share of usable values over that of the first channel beyond which another one is taken."""
_SCRATCH: Final = "temp"
"""Stem of the file in which an acquisition keeps its last record, ``temp.dat``."""


class Purpose(StrEnum):
    """As what files were recorded."""

    MEASUREMENT = "measurement"
    DARK = "dark"
    TELECOVER = "test of the telescope"
    POLARISATION = "calibration of the polarisation"
    BACKGROUND = "background"
    UNLIT = "without light of the laser"


_WORDS: Final = {
    Purpose.DARK: r"dc|darks?|dark ?current|dark ?files?",
    Purpose.TELECOVER: r"tc|tele ?cover",
    Purpose.POLARISATION: r"dp|(depol|pol) ?cal|calibration|cal|plus ?45|minus ?45|[pm]45|45[pm]",
    Purpose.BACKGROUND: r"background|bkg|bg",
}
"""Words that state a purpose: in folders, and in the letters of file names if longer than two."""
_SECTORS: Final = ({"n", "e", "s", "w"}, {"north", "east", "south", "west"})
"""Folders of the parts of a telescope."""
_TURNED: Final = re.compile(r"(?<!\d)[+-]45(?!\d)")
"""Angle of a polariser or plate, as in ``DP+45``."""


@dataclass(frozen=True, slots=True)
class FileGroup:
    """Raw files of one folder with like names, site, position and channels."""

    folder: str
    """Relative to the root, with a slash at its end; empty for the root."""
    stem: str
    """Letters with which the names begin."""
    purpose: Purpose
    """As what folder or name says that these files were recorded."""
    site: str
    coordinates: tuple[float, float] | None
    """degree, as the header orders them."""
    layout: tuple[ChannelLayout, ...]
    files: tuple[str, ...]
    """Paths relative to the root."""
    start: datetime
    stop: datetime
    zenith_angles: tuple[float, ...]
    """degree, distinct and rising."""
    without_zenith: int
    """Number of files that state no zenith angle, or a doubtful one."""
    doubts: tuple[str, ...]
    """Why pointings are doubtful, in words."""
    headers: tuple[RawHeader, ...]
    """By file."""
    header_pointing: HeaderPointing = "stated"
    """As what doubtful angles are read."""

    @property
    def dark(self) -> bool:
        """Whether these are dark files."""
        return self.purpose is Purpose.DARK

    @property
    def pattern(self) -> str:
        """Pattern of the paths of the files; those of another group may match it too."""
        return f"{literal_pattern(self.folder)}{self.stem}*"


@dataclass(frozen=True, slots=True)
class FolderContents:
    """The raw files of a folder and the folders below it."""

    groups: tuple[FileGroup, ...]
    refused: tuple[tuple[str, str], ...]
    """Path of each damaged raw file, and what is wrong with it."""
    other: tuple[str, ...]
    """Paths of files of no raw format."""
    copies: tuple[str, ...] = ()
    """Paths of files in which an acquisition keeps its last record, whose content another file of
    the folder has."""


@dataclass(frozen=True, slots=True)
class FirstLook:
    """What some files of an instrument give, processed as a campaign would."""

    files: int
    shares: Mapping[str, float] = field(default_factory=dict)
    """Elastic channel, or glued one -> share of usable values in the lowest 8 km."""
    reasons: Mapping[str, str] = field(default_factory=dict)
    """Channel without a usable value -> its most frequent flags, or why no product is made."""
    raman: frozenset[str] = frozenset()
    """Elastic channels of which a Raman product has usable values."""
    full_overlap: float | None = None
    """m; None where signals do not show it."""
    within: float = math.nan
    """m; to what it is known."""
    begins: float | None = None
    """m, where the light of all channels begins if that is not at once."""
    lags: Mapping[str, float] = field(default_factory=dict)
    """Analog channel -> bins by which it lags the photon-counting one."""
    unlit: tuple[str, ...] = ()
    """Paths of files without light of the laser."""
    clock: tuple[float, float] | None = None
    """h, least and greatest clock minus UTC that the light of the sky fits; None where UTC does."""


@dataclass(frozen=True, slots=True)
class InstrumentHeaders:
    """What the headers of one instrument state, and a look at its data shows."""

    groups: tuple[FileGroup, ...]
    files: tuple[str, ...]
    """Patterns of its files, which match those of no other instrument."""
    dark_files: tuple[str, ...]
    look: FirstLook | None = None

    @property
    def signal(self) -> tuple[FileGroup, ...]:
        """The groups that are not dark; all if all are."""
        return tuple(group for group in self.groups if not group.dark) or self.groups

    @property
    def main(self) -> FileGroup:
        """Its largest group of signal files; a few headers of an archive may be damaged."""
        return max(self.signal, key=lambda group: (len(group.files), len(group.layout)))

    @property
    def layout(self) -> tuple[ChannelLayout, ...]:
        """Channels of most of its files, with wavelengths that digits without a dot tell."""
        return tuple(
            channel if channel.wavelength > 0 else replace(channel, wavelength=_undotted(channel))
            for channel in self.main.layout
        )

    @property
    def zenith_angle(self) -> float:
        """Median zenith angle of its files in degree; 0 where none is known."""
        return median(self._zenith_angles or [0.0])

    @property
    def zenith_span(self) -> float:
        """Largest minus smallest zenith angle of all files but a tenth at either end, degree.

        A fixed lidar may have been slanted for some files.
        """
        angles = self._zenith_angles
        few = len(angles) // 10
        return angles[-1 - few] - angles[few] if angles else 0.0

    @property
    def reaches_clean_air(self) -> bool:
        """Whether the beam is fixed and steep enough for profiles of the atmosphere."""
        return self.zenith_span <= FIXED and self.zenith_angle <= STEEPEST

    @property
    def pairs(self) -> tuple[str, ...]:
        """Glued channels that its analog and photon-counting channels can make."""
        widths = {channel.name: channel.bin_width for channel in self.layout}
        labels = (_label(name) for name in widths if name.startswith("analog_"))
        return tuple(
            f"glued_{label}"
            for label in labels
            if widths.get(f"photon_{label}") == widths[f"analog_{label}"]
        )

    @property
    def elastic_channels(self) -> tuple[str, ...]:
        """One channel of each elastic detector, photon counting where there is one.

        Cross-polarised ones are left out, because they hold little light of molecules.
        """
        return tuple(channel.name for channel in self._elastic)

    @property
    def scanned_channels(self) -> tuple[str, ...]:
        """All elastic channels: of a scan, polarisations and detections test each other."""
        return tuple(
            channel.name
            for channel in self._by_mode
            if channel.wavelength > 0 and not self._is_raman(channel)
        )

    @property
    def joined_channels(self) -> tuple[str, ...]:
        """One channel of each elastic detector: glued if it can be, or what gave most values."""
        return tuple(
            best
            for first, *others in self.candidates
            if (best := self._best(first, others)) is not None
        )

    def _best(self, first: str, others: Sequence[str]) -> str | None:
        """Return the channel of a detector with most usable values; None if there is none."""
        if self.look is None:
            return first
        share = self.look.shares.get
        if is_glued(first):
            analog, photon = file_channels(first)
            # Glued with a counter that gives nothing, it is the analog record alone.
            if photon in self.look.reasons and share(analog, 0.0) >= share(first, 0.0):
                first = analog
        best = max((first, *others), key=lambda name: share(name, 0.0))
        if share(best, 0.0) <= _CLEARLY * share(first, 0.0):
            best = first
        return best if share(best, 0.0) > 0.0 else None

    @property
    def candidates(self) -> tuple[tuple[str, ...], ...]:
        """The channels of each elastic detector: glued, photon counting and analog."""
        names = {channel.name for channel in self.layout}
        return tuple(
            tuple(
                f"{mode}_{label}"
                for mode in ("glued", "photon", "analog")
                if f"{mode}_{label}" in (*self.pairs, *names)
            )
            for label in map(_label, self.elastic_channels)
        )

    @property
    def nitrogen_channels(self) -> dict[str, str]:
        """Elastic channels -> channels of their nitrogen Raman lines, of the nearest recorder.

        Each telescope of a lidar has its own, whose recorders follow each other.
        """
        pairs: dict[str, str] = {}
        for elastic in self._elastic:
            lines = (
                (raman.mode is DetectionMode.ANALOG, abs(_number(raman) - _number(elastic)), raman)
                for raman in self._by_mode
                if is_raman_line(raman.wavelength, elastic.wavelength, NITROGEN_SHIFT)
                and raman.bin_width == elastic.bin_width
            )
            if nearest := min(lines, key=itemgetter(0, 1), default=None):
                pairs[elastic.name] = nearest[-1].name
        return pairs

    @property
    def _zenith_angles(self) -> list[float]:
        stated = (header for group in self.signal for header in group.headers if not header.doubt)
        return sorted(h.zenith_angle for h in stated if h.zenith_angle is not None)

    @property
    def _by_mode(self) -> tuple[ChannelLayout, ...]:
        """The channels, photon counting first."""
        return tuple(sorted(self.layout, key=lambda channel: channel.mode is DetectionMode.ANALOG))

    @property
    def _elastic(self) -> tuple[ChannelLayout, ...]:
        detectors: dict[str, ChannelLayout] = {}
        for channel in self._by_mode:
            label = _label(channel.name)
            if channel.wavelength > 0 and not label.endswith("s") and not self._is_raman(channel):
                detectors.setdefault(label, channel)
        return tuple(detectors.values())

    def _is_raman(self, channel: ChannelLayout) -> bool:
        """Return whether a channel has vibrational or rotational Raman lines of another one."""
        return any(
            is_raman_line(channel.wavelength, other.wavelength, shift)
            for other in self.layout
            for shift in (NITROGEN_SHIFT, WATER_SHIFT)
        ) or any(
            _SAME_LINE < abs(channel.wavelength - other.wavelength) <= _ROTATIONAL
            and any(abs(other.wavelength - line) <= _SAME_LINE for line in _LASERS)
            for other in self.layout
        )


def read_folder(root: str, *, guess_pointing: bool = False) -> FolderContents:
    """Return the raw files of a folder or URL, grouped; reads all headers.

    On request, doubtful angles of instruments are read as what they probably are.

    Raises
    ------
    CatalogError
        If it cannot be listed.
    """
    source = Source.of(root)
    headers: dict[tuple[object, ...], list[tuple[str, RawHeader]]] = defaultdict(list)
    refused: list[tuple[str, str]] = []
    other: list[str] = []
    files = list(source.files())
    copies = [file for file in files if _is_copy(source, file, files)]
    for file in (file for file in files if file not in copies):
        try:
            header = _header(source, file)
        except (RawFormatError, OSError) as error:
            if UNKNOWN_FORMAT in str(error):
                other.append(printable(file.path))
            else:
                reason = str(error).removeprefix(f"{file.path}: ")
                refused.append((printable(file.path), reason))
        else:
            headers[_likeness(file.path, header)].append((file.path, header))
    for key, members in list(headers.items()):
        if not _names_tell_nothing(members):
            headers[key] = [(path, header) for path, header in members if not header.time_doubt]
            refused += [
                (printable(path), f"start: {header.time_doubt} ({TIME_REMEDY})")
                for path, header in members
                if header.time_doubt
            ]
    headers = {key: members for key, members in headers.items() if members}
    lidars: dict[tuple[object, ...], list[RawHeader]] = defaultdict(list)
    for members in headers.values():
        lidars[_lidar(members[0][1])] += [header for _, header in members]
    guesses = {key: _pointing(own) if guess_pointing else "stated" for key, own in lidars.items()}
    groups = [_group(members, guesses[_lidar(members[0][1])]) for members in headers.values()]
    return FolderContents(
        tuple(sorted(_named(_with_sectors(groups)), key=lambda group: group.files)),
        tuple(refused),
        tuple(other),
        tuple(printable(file.path) for file in copies),
    )


def _names_tell_nothing(members: Sequence[tuple[str, RawHeader]]) -> bool:
    """Return whether most names tell other days than headers, and not as a wrong clock does."""
    doubtful = [(path, header) for path, header in members if header.time_doubt]
    named = ((time_in_path(path, header.format), header.start) for path, header in doubtful)
    away = [start - moment for moment, start in named if moment]
    several = len(away) >= FEWEST_ALIKE and 2 * len(doubtful) > len(members)
    return several and max(away) - min(away) > timedelta(days=1)


def _named(groups: Sequence[FileGroup]) -> Iterator[FileGroup]:
    """Yield groups with names of channels that are the same in all files of an instrument."""
    for own in _by_instrument(groups):
        names = recorder_names((group.layout, len(group.files), group.start) for group in own)
        yield from (replace(group, layout=named_layout(group.layout, names)) for group in own)


def _with_sectors(groups: Iterable[FileGroup]) -> list[FileGroup]:
    """Return groups, those of four sectors beside each other as tests of the telescope."""
    places = [(*group.folder.lower().strip("/").rpartition("/")[::2], group) for group in groups]
    beside: dict[str, set[str]] = defaultdict(set)
    for parent, name, _ in places:
        beside[parent].add(name)
    return [
        replace(group, purpose=Purpose.TELECOVER)
        if any(name in sectors <= beside[parent] for sectors in _SECTORS)
        else group
        for parent, name, group in places
    ]


def _is_copy(source: Source, file: Stored, files: Sequence[Stored]) -> bool:
    """Return whether a file of the acquisition has the content of another file of its folder."""
    folder, stem = _split(file.path)
    if stem != _SCRATCH:
        return False
    others = [
        other.path
        for other in files
        if _split(other.path)[0] == folder and other.size == file.size and other != file
    ]
    try:
        return bool(others) and source.digest(file.path) in map(source.digest, others)
    except OSError:
        # What cannot be read is refused with its reason.
        return False


def _header(source: Source, file: Stored) -> RawHeader:
    if printable(file.path) != file.path:
        raise RawFormatError("has a name that is not UTF-8", remedy="rename it")
    return parse_raw_header(source.head(file.path, HEADER_BYTES), file=file.path, size=file.size)


def _label(channel: str) -> str:
    """Return wavelength and polarisation of a channel, such as 532p."""
    return channel.partition("_")[2]


def _number(channel: ChannelLayout) -> int:
    """Return the number of a recorder, such as 12 of BC12."""
    return int(re.sub(r"\D", "", channel.recorder) or 0)


def _undotted(channel: ChannelLayout) -> float:
    """Return the wavelength in m whose five digits a label lost its dot in: 53200 is 532.00 nm."""
    digits = re.fullmatch(r"(\d{3,4})\d\d[a-z]", _label(channel.name))
    wavelength = float(digits[1]) * 1e-9 if digits else math.nan
    return wavelength if wavelength in _LASERS else math.nan


def _split(path: str) -> tuple[str, str]:
    """Return the folder of a path, with a slash at its end, and the stem of its name."""
    folder, slash, name = path.rpartition("/")
    match = re.match(r"[^\W\d][^\W\d.]*", name)
    return folder + slash, match[0] if match else ""


def _likeness(path: str, header: RawHeader) -> tuple[object, ...]:
    grids = tuple((c.name, c.bins, c.bin_width, c.adc_bits, c.recorder) for c in header.layout)
    return (*_split(path), header.format, header.site, header.coordinates, grids)


def _lidar(stated: RawHeader | FileGroup) -> tuple[object, ...]:
    """Return what the headers of one instrument have in common."""
    return stated.site, stated.coordinates, frozenset(c.name for c in stated.layout)


def _pointing(headers: Sequence[RawHeader]) -> HeaderPointing:
    """Return as what the doubtful angles of an instrument are probably meant.

    A single one among others is probably damaged.
    """
    written = [header.written_angle for header in headers if header.written_angle is not None]
    doubtful = {header.written_angle for header in headers if header.doubt} - {None}
    if not doubtful or len(doubtful) == 1 < len(set(written)):
        return "stated"
    return "zenith_angle" if max(written) >= 0.0 else "elevation"


def _group(members: Sequence[tuple[str, RawHeader]], pointing: HeaderPointing) -> FileGroup:
    doubts = tuple(sorted({header.doubt for _, header in members if header.doubt}))
    headers = [header.read_as(pointing) for _, header in members]
    first, known = headers[0], [header for header in headers if not header.doubt]
    folder, stem = _split(members[0][0])
    angles = [header.zenith_angle for header in known if header.zenith_angle is not None]
    return FileGroup(
        folder=folder,
        stem=stem,
        purpose=_purpose(folder, stem),
        site=first.site,
        coordinates=first.coordinates,
        layout=first.layout,
        files=tuple(path for path, _ in members),
        start=min(header.start for header in headers),
        stop=max(header.stop for header in headers),
        zenith_angles=tuple(sorted(set(angles))),
        without_zenith=len(headers) - len(angles),
        doubts=doubts,
        headers=tuple(headers),
        header_pointing=pointing,
    )


def _purpose(folder: str, stem: str) -> Purpose:
    """Return as what files were recorded by the words of their folders and the stem of names."""
    words = " ".join(re.split(r"[\W_]+", folder.lower()))
    name = stem.lower() if len(stem) > _SHORT_WORD else ""
    if _TURNED.search(folder):
        return Purpose.POLARISATION
    for purpose, known in _WORDS.items():
        if re.search(rf"(?<![a-z])({known})(?![a-z])", f"{words} {name}"):
            return purpose
    return Purpose.MEASUREMENT


def instruments_of(
    groups: Iterable[FileGroup], left_out: Collection[FileGroup] = ()
) -> tuple[InstrumentHeaders, ...]:
    """Return the instruments of groups of files: one for each site, position and set of channels.

    Groups with one pattern are of one instrument, because its files could not be told apart.
    Patterns match no file of groups that are left out.
    """
    groups = tuple(groups)
    everything = [path for group in groups for path in group.files]
    groups = tuple(group for group in groups if group not in left_out)
    return tuple(
        InstrumentHeaders(
            tuple(own),
            tuple(_patterns([group for group in own if not group.dark], everything)),
            tuple(_patterns([group for group in own if group.dark], everything)),
        )
        for own in _by_instrument(groups)
    )


def _by_instrument(groups: Iterable[FileGroup]) -> list[list[FileGroup]]:
    sets: list[list[FileGroup]] = []
    for group in groups:
        alike = [
            own
            for own in sets
            if any(group.pattern == one.pattern or _lidar(group) == _lidar(one) for one in own)
        ]
        sets = [own for own in sets if own not in alike]
        sets.append([member for own in alike for member in own] + [group])
    return sets


def _patterns(groups: Sequence[FileGroup], everything: Sequence[str]) -> Iterator[str]:
    """Yield patterns that match the files of some groups, and no other raw file."""
    by_stem: dict[str, list[FileGroup]] = defaultdict(list)
    own = {path for group in groups for path in group.files}
    for group in groups:
        by_stem[group.stem].append(group)
    foreign = [path for path in everything if path not in own]
    for stem, members in by_stem.items():
        folders = {group.folder for group in members}
        # The deepest folder that holds all.
        common = os.path.commonpath([f"/{folder}" for folder in folders]).strip("/")
        whole = f"{literal_pattern(f'{common}/' if common else '')}**/{stem}*"
        if len(folders) > 1 and not _matches(whole, foreign):
            yield whole
            continue
        for pattern in dict.fromkeys(group.pattern for group in members):
            if _matches(pattern, foreign):
                yield from (literal_pattern(p) for p in sorted(own) if _matches(pattern, [p]))
            else:
                yield pattern


def _matches(pattern: str, paths: Iterable[str]) -> bool:
    matcher = path_pattern(pattern)
    return any(matcher.match(path) for path in paths)

"""The first campaign file of an archive, from what the headers of its files state.

What headers cannot tell stands in the file with an assumed value and a question in a comment.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from itertools import pairwise
from pathlib import PurePosixPath
from statistics import median
from types import MappingProxyType
from typing import Final

from lidarops.catalog.folder import (
    FileGroup,
    FirstLook,
    FolderContents,
    InstrumentHeaders,
    Purpose,
    instruments_of,
)
from lidarops.catalog.raw_files import misdated
from lidarops.constants import LEAST_SPREAD
from lidarops.errors import CatalogError
from lidarops.kinds import Scope, kinds_of
from lidarops.raw.formats import time_in_path
from lidarops.raw.header import LEFT_OUT, POINTING_NOTE, HeaderOrder, label_of
from lidarops.records import ChannelLayout, DetectionMode, file_channels, is_glued

_NEAR: Final = 0.2
"""degree, 22 km of latitude: twice the rounding of headers, and the reach of horizontal beams."""
_ALTITUDES: Final = (-500.0, 9000.0)
"""m; those that a station of a campaign may have."""
_SHOWN: Final = 5
"""Most files of a kind that a comment names."""
_ASSUMED_OVERLAP: Final = 500.0
"""m; of most telescopes. A signal may stop rising earlier, by haze at the ground."""
_USED: Final = frozenset({Purpose.MEASUREMENT, Purpose.DARK})
"""Purposes of files that a campaign names; others are a question."""
_SECOND: Final = timedelta(seconds=1)
"""Resolution of start and stop."""
_PROFILES: Final = (".csv", ".nc")
"""Endings of files that may be soundings."""
_PACKED: Final = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
"""Endings of files that may hold raw files."""

Position = tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class _Site:
    """One station, as headers state it."""

    key: str
    name: str
    coordinates: Position
    altitude: float | None
    order: HeaderOrder

    def is_near(self, other: _Site) -> bool:
        """Return whether beams from here may cross those from another station."""
        pairs = zip(self.coordinates or (), other.coordinates or (), strict=True)
        return all(abs(here - there) <= _NEAR for here, there in pairs)

    def lines(self) -> Iterator[str]:
        first, second = self.coordinates or (0.0, 0.0)
        longitude, latitude = (
            (first, second) if self.order == "longitude_first" else (second, first)
        )
        source = (
            "from the header; exact, and not swapped?"
            if self.coordinates
            else "headers state none on Earth"
        )
        height = "from the header" if self.altitude is not None else "headers state none"
        yield f"  {self.key}:"
        yield f"    name: {_text(self.name or self.key)}  # ? the header has 8 characters"
        yield f"    latitude: {latitude:.8g}  # ? degree north, {source}"
        yield f"    longitude: {longitude:.8g}  # ? degree east"
        yield f"    altitude: {self.altitude or 0.0:g}  # ? m above the geoid, {height}"


def draft_campaign(
    contents: FolderContents,
    *,
    archive: str,
    output: str,
    schema: str,
    looks: Mapping[str, FirstLook] = MappingProxyType({}),
) -> str:
    """Return the text of a campaign file for the raw files of a folder.

    Parameters
    ----------
    contents : FolderContents
    archive : str
        Folder of the raw files, as the file states it.
    output : str
        Folder of catalog, products and reports, as the file states it.
    schema : str
        Place of the JSON schema, for editors.
    looks : mapping, optional
        What a look at the data of instruments shows, by their keys in this text.

    Raises
    ------
    CatalogError
        If the folder holds no raw file that can be used.
    """
    known = drafted_instruments(contents)
    if not known:
        reasons = [f"{path}: {reason}" for path, reason in contents.refused[:1]]
        packed = "".join(f"unpack {path}, or " for path in _packed(contents)[:1])
        raise CatalogError(
            "holds no raw file that can be used" + "".join(f": {reason}" for reason in reasons),
            file=archive,
            remedy=f"{packed}give the folder of the raw files",
        )
    scanning = [headers for headers in known.values() if _scans(headers)]
    sites = dict(zip(known, _sites(list(known.values())), strict=True))
    places = list(dict.fromkeys(sites.values()))
    title = f"Lidar measurements at {', '.join(site.name or site.key for site in places)}"
    lines = [
        f"# yaml-language-server: $schema={schema}",
        "# Written by `lidarops init` from the headers of the raw files.",
        "# A question mark in a comment: headers do not state it, or cannot be trusted; check it.",
        f"name: {_key(' '.join(site.key for site in places))}",
        f"title: {_text(title)}  # ?",
        f"archive: {_text(archive)}",
        f"output: {_text(output)}  # catalog, products and reports, of this campaign alone",
        "",
        "stations:",
        *(line for site in places for line in site.lines()),
        "",
        "instruments:",
    ]
    for key, headers in known.items():
        # Instruments of one archive with equal channels have equal detectors.
        names = {channel.name for channel in headers.layout}
        estimates = any({channel.name for channel in own.layout} == names for own in scanning)
        seen = replace(headers, look=looks.get(key))
        lines += [*_instrument(key, seen, sites[key], estimates=estimates), ""]
    lines += _networks({key: (headers, sites[key]) for key, headers in known.items()})
    lines.append("scenes: {window: day}  # products of one file each: day, 6h, 30min")
    return "\n".join([*lines, *_left_out(contents, archive), ""])


def drafted_instruments(contents: FolderContents) -> dict[str, InstrumentHeaders]:
    """Return the instruments of a draft by their keys; none where no raw file can be used."""
    tests = [group for group in contents.groups if group.purpose not in _USED]
    if not any(group.purpose is Purpose.MEASUREMENT for group in contents.groups):
        tests = []
    instruments = [one for one in instruments_of(contents.groups, tests) if one.files]
    keys = _keys(f"{site.key}-lidar" for site in _sites(instruments))
    return dict(zip(keys, instruments, strict=True))


def _sites(instruments: Sequence[InstrumentHeaders]) -> list[_Site]:
    """Return the station of each instrument: one for each site and position of headers."""
    first: dict[tuple[str, Position], FileGroup] = {}
    for group in (instrument.main for instrument in instruments):
        first.setdefault((group.site, group.coordinates), group)
    keys = _keys(site or "station" for site, _ in first)
    stations = {
        place: _Site(key, group.site, *_position(group))
        for key, (place, group) in zip(keys, first.items(), strict=True)
    }
    return [stations[one.main.site, one.main.coordinates] for one in instruments]


def _position(group: FileGroup) -> tuple[Position, float | None, HeaderOrder]:
    """Return coordinates, altitude and order of coordinates; None for what is not on Earth.

    Longitude is first, unless the second one cannot be a latitude.
    """
    low, high = _ALTITUDES
    ((altitude, _),) = Counter(header.altitude for header in group.headers).most_common(1)
    known = altitude if altitude is not None and low <= altitude <= high else None
    coordinates = group.coordinates
    if coordinates is None or max(map(abs, coordinates)) > 180.0:
        return None, known, "longitude_first"
    first, second = map(abs, coordinates)
    if min(first, second) > 90.0:
        return None, known, "longitude_first"
    return coordinates, known, "latitude_first" if second > 90.0 else "longitude_first"


def _scans(headers: InstrumentHeaders) -> bool:
    return headers.zenith_span >= LEAST_SPREAD


def _instrument(
    key: str, headers: InstrumentHeaders, site: _Site, *, estimates: bool
) -> Iterator[str]:
    groups = headers.signal
    count = sum(len(group.files) for group in groups)
    start, stop = min(g.start for g in groups), max(g.stop for g in groups)
    files = "1 file" if count == 1 else f"{count} files"
    yield f"  # {files}, {start:%Y-%m-%d %H:%M} to {stop:%Y-%m-%d %H:%M} by their clock"
    yield f"  {key}:"
    yield f"    station: {site.key}"
    yield f"    files: {_list(headers.files)}"
    unlit, looked = (headers.look.unlit, headers.look.files) if headers.look else ((), 0)
    if 0 < len(unlit) < looked:
        such = f"such as {_text(unlit[0])}: dark files?"
        yield f"    # ? {len(unlit)} of {looked} files show no light of the laser, {such}"
    if headers.dark_files:
        yield f"    dark_files: {_list(headers.dark_files)}  # ? by the words in their path"
    else:
        yield '    # dark_files: "dark/*"  # ? no path holds the word dark or DC'
    if site.coordinates is None:
        yield "    header_position: ignore  # headers state no position on Earth"
    else:
        yield (
            f"    header_position: {site.order}  # ? order of {site.coordinates[0]:g},"
            f" {site.coordinates[1]:g} in headers"
        )
    pointing = headers.main.header_pointing
    if pointing != "stated":
        yield f"    header_pointing: {pointing}  # ? elevation or zenith_angle: headers do not tell"
    doubtful = [header for header in headers.main.headers if header.time_doubt]
    if doubtful:
        yield f"    name_times: ignored  # ? {doubtful[0].time_doubt}"
    notes = {note for header in headers.main.headers for note in header.notes}
    yield from (f"    # {note}" for note in sorted(notes) if note.endswith(LEFT_OUT))
    yield from _facts(headers, estimates=estimates)
    yield "    products:"
    for kind in kinds_of(Scope.CHANNEL):
        if kind.draft:
            yield from (f"      {line}" for line in kind.draft(headers))


def _facts(headers: InstrumentHeaders, *, estimates: bool) -> Iterator[str]:
    yield "    facts:"
    clock = "; ".join(_clock(headers.main, headers.look)) or "-18000 for UTC-5"
    yield f"      - clock_offset: 0  # ? s, clock of the files minus UTC; {clock}"
    yield from (f"        {line}" for line in _pointing(headers))
    yield from (f"        {line}" for line in _full_overlap(headers.look))
    if headers.look is not None and headers.look.begins is not None:
        late, width = headers.look.begins, headers.layout[0].bin_width
        place = f"light begins there, in bin {late / width:.0f} of {width:g} m"
        yield (
            f"        # pre_trigger: {late:.0f} m  # ? {place}: at which range of the record does"
            " the pulse leave?"
        )
    if headers.pairs:
        yield f"        # pairs that can be joined: {', '.join(headers.pairs)}"
    if len({group.layout for group in headers.signal}) > 1:
        yield "        # ? Other files have other channels or bins, which make scenes of their own."
    yield "        channels:"
    # Without dead times, all values of a scan are rejected where rates are high (SAVANT).
    joined = headers.joined_channels if headers.reaches_clean_air else ()
    joined = headers.pairs if estimates else joined
    estimated = {name for pair in joined if is_glued(pair) for name in file_channels(pair)}
    stated = {channel.name for channel in headers.main.layout if channel.wavelength > 0}
    several = Counter(map(label_of, {c.name for group in headers.signal for c in group.layout}))
    alike = Counter((label_of(c.name), c.recorder) for c in headers.layout)
    shifts = {c.device: c.bin_shift for c in headers.main.headers[0].channels if c.bin_shift}
    lags = headers.look.lags if headers.look else {}
    for channel in headers.layout:
        photon = channel.mode is DetectionMode.PHOTON
        facts = ["dead_time: estimate"] if photon and channel.name in estimated else []
        lost_dot = channel.wavelength > 0 and channel.name not in stated
        facts += [f"wavelength: {channel.wavelength * 1e9:g} nm"] if lost_dot else []
        own = label_of(channel.name), channel.recorder
        if channel.recorder and several[own[0]] > 1 == alike[own]:
            facts.insert(0, f"recorder: {_text(channel.recorder)}")
        recorder = f", {channel.recorder}" if channel.recorder else ""
        grid = f"{channel.bins} bins of {channel.bin_width:g} m{recorder}"
        question = "; ? wavelength, whose dot the header lacks" if lost_dot else ""
        question += _unknown(channel, estimated=channel.name in estimated)
        alone = channel.name.replace("analog_", "glued_") not in headers.pairs
        shift = shifts.get(channel.recorder) if alone or channel.name in lags else None
        question += _shift(channel, lags.get(channel.name), shift)
        yield f"          {channel.name}: {{{', '.join(facts)}}}  # {grid}{question}"


def _clock(group: FileGroup, look: FirstLook | None) -> Iterator[str]:
    """Yield what is to be said of the clock: what contradicts names, the sky and other files."""
    members = list(zip(group.files, group.headers, strict=True))
    away = [
        (header.start - named).total_seconds()
        for path, header in members
        if (named := time_in_path(path, header.format))
    ]
    if hours := round(median(away) / 1800.0) / 2.0 if away else 0.0:
        yield f"headers are {hours:+g} h from names: one of the two is local time"
    if look is not None and look.clock is not None:
        clocks = " to ".join(dict.fromkeys(f"{end:+g}" for end in look.clock))
        yield f"the light of the sky fits {clocks} h"
    spans = sorted((header.start, header.stop) for _, header in members)
    twice = sum(start < stop - _SECOND for (_, stop), (start, _) in pairwise(spans))
    if twice:
        yield f"files that start before another one stops: {twice}; is a clock hour there twice?"
    starts = {path: header.start for path, header in members}
    yield from (f"{path} is {reason}" for path, reason in list(misdated(starts).items())[:1])


def _shift(channel: ChannelLayout, lag: float | None, stated: float | None) -> str:
    """Return the question on the place of the bins of a channel; empty where there is none."""
    words = f"the header states a bin shift of {stated:g}" if stated else ""
    if lag is None:
        return f"; ? range_offset: {words}" if words else ""
    words = f"it lags photon counting by {lag:.1f} bins" + (f", {words}" if words else "")
    return f"; ? range_offset: {-lag * channel.bin_width:.0f} m, {words}"


def _full_overlap(look: FirstLook | None) -> Iterator[str]:
    look = look or FirstLook(files=0)
    found = look.full_overlap
    if found is not None and found >= _ASSUMED_OVERLAP:
        yield (
            f"full_overlap_range: {found:g}  # ? m, nearer bins are not used; at least:"
            f" signals rise up to there, ± {look.within:g} m"
        )
    else:
        seen = "" if found is None else f", signals stop rising at {found:g} ± {look.within:g} m"
        yield f"full_overlap_range: {_ASSUMED_OVERLAP:g}  # ? m, nearer bins are not used{seen}"
    yield "full_overlap_assumed: true  # until full_overlap_range is checked"


def _unknown(channel: ChannelLayout, *, estimated: bool) -> str:
    """Return the question on a channel; empty where there is none."""
    if not channel.wavelength > 0:
        return "; ? wavelength, such as 532 nm: that of the header is not plausible"
    if channel.mode is not DetectionMode.PHOTON:
        return ""
    if estimated:
        return "; ? dead_time, such as 4 ns, where it is known"
    return "; ? dead_time, such as 4 ns, or estimate: without it, high rates are too low"


def _pointing(headers: InstrumentHeaders) -> Iterator[str]:
    angles = sorted({angle for group in headers.signal for angle in group.zenith_angles})
    stated = [header for group in headers.signal for header in group.headers]
    sides = {header.azimuth for header in stated if not header.doubt} - {None}
    doubts = [doubt for group in headers.signal for doubt in group.doubts]
    refused = sum(group.without_zenith for group in headers.signal) if doubts else 0
    # A fact would hold for the files with doubtful pointings too.
    mark = "# " if refused else ""
    if not angles:
        yield f"{mark}zenith_angle: 0  # ? degree, headers state none; 0 is up, 90 level"
    elif len(angles) > 1:
        yield (
            f"# zenith_angle: the beam moves from {angles[0]:g} to {angles[-1]:g} degree by the"
            f" headers, over {len(sides) or 'no known'} azimuths"
        )
    else:
        notes = {note for header in stated for note in header.notes if POINTING_NOTE in note}
        source = "; ".join(sorted(notes)) or f"headers state {angles[0]:g}"
        yield f"{mark}zenith_angle: {abs(angles[0]):g}  # ? degree, {source}"
    if refused:
        yield f"# ? {refused} files state no sure pointing and are refused without zenith_angle"
        yield from (f"#   {doubt}" for doubt in doubts[:1])


def _networks(known: Mapping[str, tuple[InstrumentHeaders, _Site]]) -> Iterator[str]:
    """Yield comments on the networks that instruments may form: near stations, no vertical beam."""
    left = [
        key
        for key, (headers, site) in known.items()
        if site.coordinates and headers.zenith_angle > LEAST_SPREAD
    ]
    while left:
        first = known[left[0]][1]
        members = [key for key in left if known[key][1].is_near(first)]
        left = [key for key in left if key not in members]
        sections = [
            line
            for kind in kinds_of(Scope.NETWORK)
            if len(members) > 1 and kind.draft
            for line in kind.draft([known[key][0] for key in members])
        ]
        if sections:
            yield "# ? Do their beams cross? Then give exact positions, and azimuths in the facts:"
            yield "# networks:"
            yield f"#   {first.key}-network:"
            yield f"#     instruments: [{', '.join(members)}]"
            yield from (f"#     {line}" for line in sections)
            yield ""


def _left_out(contents: FolderContents, archive: str) -> Iterator[str]:
    """Yield comments on the files that no instrument has."""
    tables = [path for path in contents.other if path.lower().endswith(_PROFILES)]
    packed = _packed(contents)
    rest = [path for path in contents.other if path not in (*tables, *packed)]
    endings = Counter(PurePosixPath(path).suffix or "no ending" for path in rest)
    formats = ", ".join(f"{ending} {count}" for ending, count in endings.most_common(_SHOWN))
    taken = any(group.purpose is Purpose.MEASUREMENT for group in contents.groups)
    fate = "left out of `files`" if taken else "in `files`, as there are no others"
    named = "? soundings, lidar ratios or overlap? Name them in the facts, as molecular_profile"
    if archive.startswith(("/", "..")):
        # A campaign reads no file outside of its folder.
        named += "; copy them below the folder of this file first"
    for title, paths in (
        ("copies of the last record of the acquisition, left out", contents.copies),
        *(
            (
                f"? {purpose} by path or counts, {fate}",
                _one_by_one(g.files for g in contents.groups if g.purpose is purpose),
            )
            for purpose in Purpose
            if purpose not in _USED
        ),
        # As seen from the campaign file.
        (named, [f"{archive}/{path}" for path in tables]),
        ("? packed and not read: unpack them, and run init again", packed),
        (f"not read, unknown format ({formats})", rest),
        ("damaged", [f"{path}: {reason}" for path, reason in contents.refused]),
    ):
        if paths:
            yield f"# {len(paths)} file{'s' * (len(paths) > 1)}, {title}:"
            yield from (f"#   {json.dumps(path)}" for path in paths[:_SHOWN])


def _one_by_one(groups: Iterable[Sequence[str]]) -> list[str]:
    """Return the files of groups, the first ones of all groups first."""
    return [path for _, path in sorted((n, p) for files in groups for n, p in enumerate(files))]


def _packed(contents: FolderContents) -> list[str]:
    return [path for path in contents.other if path.lower().endswith(_PACKED)]


def _text(value: str) -> str:
    """Return a text in quotes, as YAML reads it."""
    return json.dumps(value, ensure_ascii=not value.isprintable())


def _list(patterns: Sequence[str]) -> str:
    texts = [_text(pattern) for pattern in patterns]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"


def _key(name: str) -> str:
    """Return a key of a campaign file that a name makes."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:30].strip("-") or "archive"


def _keys(names: Iterable[str]) -> list[str]:
    """Return different keys for names, numbered where they would be equal."""
    keys: list[str] = []
    for name in names:
        key, number = _key(name), 2
        while key in keys:
            key, number = f"{_key(name)}-{number}", number + 1
        keys.append(key)
    return keys

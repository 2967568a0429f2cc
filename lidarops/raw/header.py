"""Header of a raw file of any format: what the catalog and the data model need of it.

A file names its channels by itself: of two telescopes ``analog_532o`` and ``analog_532o_2``, and
the second one ``analog_532o`` when the first is off. Over many files, a name is bound to the
recorder that has it in the files with most recorders of its mode, wavelength and polarisation
(`recorder_names`).
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from functools import lru_cache
from typing import Any, Final, Literal, Self, TypeVar

from lidarops.errors import RawFormatError
from lidarops.records import FEWEST_ALIKE, ChannelLayout, DetectionMode, Header

_LEAST_TEXT: Final = 64
"""Bytes; the counts of 16 bins are not printable by chance."""
_TEXT: Final = bytes(range(0x20, 0x7F)) + b"\t\r\n"

POLARISATIONS: Final = {
    "o": "none", "p": "parallel", "s": "perpendicular", "r": "right circular", "l": "left circular"
}  # fmt: skip
_NUMBERED: Final = re.compile(r"([a-z]+_\d+[a-z])_\d+")

Layout = tuple[ChannelLayout, ...]
Recorder = tuple[str, str, int]
"""Label and recorder, such as ``("analog_532o", "BT5", 0)``, and the number among such channels of
a file. A format without recorders gives the whole name."""
Names = Mapping[Recorder, str]

_Channel = TypeVar("_Channel")
HeaderOrder = Literal["longitude_first", "latitude_first"]
HeaderPointing = Literal["stated", "elevation", "zenith_angle"]
LEFT_OUT: Final = "is left out"
"""Words at the end of notes on datasets that give no channel."""
POINTING_NOTE: Final = "taken as"
"""Words of the notes on headers that tell how their pointing is read."""

TIME_REMEDY: Final = "leave the file out, or correct its header"

Stretches = tuple[tuple[int, int], ...]
"""Stretches of bins of a channel, ascending: first bin, and the one past the last."""


class IncompleteHeaderError(RawFormatError):
    """Bytes that end inside the header."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RawChannel:
    """One analog or photon-counting channel that a raw file stores."""

    name: str
    """Unique in its file: mode, wavelength in nm and polarisation, such as ``photon_532o``."""
    mode: DetectionMode | None
    """None for what a file holds beside signals, such as a power meter; no channel of a header."""
    wavelength: float
    """m; NaN where the header gives no plausible wavelength."""
    wavelength_label: str
    """Wavelength as written; what stands before its first dot is a whole number of nm."""
    bins: int
    bin_width: float
    """m."""
    shots: int
    scale: float
    """Physical value of one count, mV (analog) or MHz (photon counting); NaN without shots."""
    places: tuple[int, ...]
    """Where the file holds the counts, for the format's own use: bytes, columns or numbers. The
    counts of several places add up, as those of the two memories of a recorder."""
    adc_bits: int = 0
    """0 for photon counting."""
    polarisation: str = "o"
    """o none, p parallel, s perpendicular, r and l circular."""
    device: str = ""
    input_range: float | None = None
    """V; None unless analog."""
    laser: int | None = None
    high_voltage: float | None = None
    """V."""
    discriminator: float | None = None
    """V; None unless photon counting."""
    bin_shift: float | None = None
    """Bins."""
    first: int | None = None
    """Place of the first of `bins` in the file, of which others are left out; None of a whole
    record."""

    def __hash__(self) -> int:
        return hash((self.name, self.places, self.shots))

    @property
    def full_scale(self) -> int | None:
        """Counts of a saturated digitiser, ``shots (2^adc_bits - 1)``; None without one."""
        analog = self.mode is DetectionMode.ANALOG
        return self.shots * ((1 << self.adc_bits) - 1) if analog else None


_RECORDED: Final = tuple(
    item.name for item in fields(RawChannel) if item.name not in {"shots", "scale", "places"}
)
"""Properties of a channel that say how it was recorded."""


def holds_text(data: bytes) -> bool:
    """Return whether bytes are printable text; False where there are too few to tell."""
    return len(data) >= _LEAST_TEXT and not data.translate(None, _TEXT)


@dataclass(frozen=True, slots=True, kw_only=True)
class RawHeader(Header):
    """Header of one raw file as its format parses it.

    A format may add fields in a subclass; ``lidarops inspect`` shows them too.
    """

    path: str = field(compare=False)
    """File, for messages."""
    size: int
    """Bytes of the file."""
    start: datetime
    stop: datetime
    channels: tuple[RawChannel, ...]
    """In file order. Files with equal channels should share one tuple, for speed."""
    layout: tuple[ChannelLayout, ...] = field(init=False, compare=False)
    """Follows from the channels."""
    setup: str = field(init=False, compare=False)
    """Follows from site and channels."""
    site: str = ""
    doubt: str = ""
    """Why the pointing is unknown although the header holds one, in words; the file is refused
    unless the campaign gives header_pointing or zenith_angle."""
    time_doubt: str = ""
    """Why the start is in doubt, in words; the file is refused unless the campaign has
    name_times ignored."""
    written_angle: float | None = None
    """degree; the angle as written, where no line of the file tells what it is."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "layout", _layout(self.channels))
        object.__setattr__(self, "setup", _setup(self.site, self.channels))

    def read_as(self, pointing: HeaderPointing) -> Self:
        """Return the header with its written angle read as what the campaign says that it is.

        Elevations may be positive or negative upwards. Where a zenith angle is negative, or an
        elevation beyond 90 degree, the beam is on the side opposite to its azimuth.
        """
        if pointing == "stated" or self.written_angle is None:
            return self
        written, azimuth = self.written_angle, self.azimuth
        angle = 90.0 - abs(written) if pointing == "elevation" else written
        if azimuth is not None and angle < 0.0:
            azimuth = (azimuth + 180.0) % 360.0
        notes = [note for note in self.notes if POINTING_NOTE not in note]
        notes.append(f"the angle of the header is {POINTING_NOTE} {pointing}: header_pointing")
        return replace(self, zenith_angle=abs(angle), azimuth=azimuth, doubt="", notes=tuple(notes))

    def check_time(self) -> None:
        """Raise a `RawFormatError` where the start is in doubt."""
        if self.time_doubt:
            raise RawFormatError(
                self.time_doubt,
                file=self.path,
                field="start",
                remedy=f"{TIME_REMEDY}: one of them is wrong; or set name_times: ignored, if names"
                " tell no time",
            )

    @property
    def coordinates(self) -> tuple[float, float] | None:
        """degree; longitude and latitude, unless the instrument writes them the other way round."""
        if self.longitude is None or self.latitude is None:
            return None
        return self.longitude, self.latitude

    def position(self, order: HeaderOrder = "longitude_first") -> tuple[float, float] | None:
        """Return latitude and longitude in degree; None where the header holds none.

        Parameters
        ----------
        order : {"longitude_first", "latitude_first"}
            Coordinate that the instrument writes first.

        Raises
        ------
        RawFormatError
            If the pair is impossible in this order.
        """
        if self.coordinates is None:
            return None
        longitude, latitude = self.coordinates[:: -1 if order == "latitude_first" else 1]
        if abs(latitude) > 90 or abs(longitude) > 180:
            raise RawFormatError(
                f"latitude {latitude:g}, longitude {longitude:g} is not a place on Earth",
                file=self.path,
                field="position",
                remedy=f"header_position is {order}: choose the other order, or 'ignore',"
                " in the campaign",
            )
        return latitude, longitude


@lru_cache(maxsize=128)
def _layout(channels: tuple[RawChannel, ...]) -> tuple[ChannelLayout, ...]:
    return tuple(
        ChannelLayout(
            name=channel.name,
            mode=DetectionMode(str(channel.mode)),
            wavelength=channel.wavelength,
            bins=channel.bins,
            bin_width=channel.bin_width,
            adc_bits=channel.adc_bits,
            recorder=channel.device,
        )
        for channel in channels
    )


@lru_cache(maxsize=128)
def _setup(site: str, channels: tuple[RawChannel, ...]) -> str:
    digest = hashlib.sha256(site.encode())
    for channel in channels:
        digest.update(repr([getattr(channel, name) for name in _RECORDED]).encode())
    return digest.hexdigest()[:16]


def chosen(
    stored: Mapping[str, _Channel], channels: Iterable[str] | None, file: str
) -> tuple[_Channel, ...]:
    """Return the channels of these names (one, some, or None for all), each once, in their order.

    Raises
    ------
    RawFormatError
        If one is not stored, or there is none; the error names the stored ones.
    """
    if channels is None:
        channels = stored
    names = list(dict.fromkeys([channels] if isinstance(channels, str) else channels))
    missing = [name for name in names if name not in stored]
    if missing or not names:
        raise RawFormatError(
            f"has no channel {', '.join(missing)}" if missing else "has no channels",
            file=file,
            field="channels",
            remedy=f"stored: {', '.join(stored) or 'none'}",
        )
    return tuple(stored[name] for name in names)


def label_of(channel: str) -> str:
    """Return the mode, wavelength and polarisation in the name of a channel."""
    numbered = _NUMBERED.fullmatch(channel)
    return numbered[1] if numbered else channel


def _recorders(layout: Layout) -> list[Recorder]:
    seen: Counter[tuple[str, str]] = Counter()
    recorders = []
    for channel in layout:
        key = (label_of(channel.name) if channel.recorder else channel.name, channel.recorder)
        recorders.append((*key, seen[key]))
        seen[key] += 1
    return recorders


def recorder_names(
    files: Iterable[tuple[Layout, int, datetime]],
    stated: Mapping[str, str] | None = None,
    bound: Names | None = None,
) -> Names:
    """Return the name of each recorder of an instrument, whatever the order of its files.

    Of the files with most recorders of a label, those that start first count. One file that
    differs from many may be damaged, so that it counts last. `files` are channels as files name
    them, the number of these files, and the start of the first one; `stated` are names that a
    person gave, with their recorders, and `bound` earlier ones. No other recorder has such a name.
    """
    counts: Counter[Any] = Counter()
    starts: dict[Any, datetime] = {}
    for layout, number, start in files:
        key = tuple(zip(_recorders(layout), (channel.name for channel in layout), strict=True))
        counts[key] += number
        starts[key] = min(starts.get(key, start), start)
    many = max(counts.values(), default=0) >= FEWEST_ALIKE
    first: dict[Recorder, Any] = {}
    for key, start in starts.items():
        held = Counter(label for (label, *_), _ in key)
        for recorder, name in key:
            place = (many and counts[key] == 1, -held[recorder[0]], start, key, name)
            first[recorder] = min(first.get(recorder, place), place)
    names = {(label_of(name), recorder, 0): name for name, recorder in (stated or {}).items()}
    # Before all others, and first those whose names no person gave to others.
    given = set(names.values())
    first |= {recorder: (-1, name in given, name) for recorder, name in (bound or {}).items()}
    for recorder in sorted(first.keys() - names.keys(), key=first.__getitem__):
        *_, name = first[recorder]
        number = 2
        while name in names.values():
            name, number = f"{recorder[0]}_{number}", number + 1
        names[recorder] = name
    return names


def named_layout(layout: Layout, names: Names) -> Layout:
    """Return the channels of a file with the names of their recorders, where they have any."""
    bound = zip(layout, _recorders(layout), strict=True)
    return tuple(replace(c, name=names.get(recorder, c.name)) for c, recorder in bound)

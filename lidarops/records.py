"""Frozen records that all packages share: the vocabulary of lidarops, and its words.

A *granule* is one raw file as catalogued. A *scene* is the granules that are processed together.
A *plan* lists the steps that run for one scene, and those that are left out, with the reasons. A
*product* is one NetCDF file. A *run* is one execution over many scenes.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, date, datetime
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple, Self, TypeVar

from lidarops.kinds import kinds

_EPOCH: Final = date(1970, 1, 1).toordinal()


def day_of(moment: datetime) -> int:
    """Return the UTC day of a time, in days since 1970-01-01."""
    return moment.astimezone(UTC).toordinal() - _EPOCH


def first_of_month(day: int) -> int:
    """Return the first day of the month of a day, both in days since 1970-01-01."""
    return date.fromordinal(day + _EPOCH).replace(day=1).toordinal() - _EPOCH


class DetectionMode(StrEnum):
    """How a channel detects light."""

    ANALOG = "analog"
    PHOTON = "photon"


SIGNAL_UNITS: Final[Mapping[str, str]] = {"analog": "mV", "photon": "MHz"}
"""Detection mode -> unit of its signal."""
GLUED: Final = "glued_"
"""Prefix of channels that are glued from the ``analog_`` and ``photon_`` ones of a detector."""


def is_glued(channel: str) -> bool:
    """Return whether a channel is glued from two channels of the files, by its name."""
    return channel.startswith(GLUED)


def mode_of_signal(channel: str, mode: str) -> DetectionMode:
    """Return how the signal of a channel is stated: glued ones as counted, others as detected."""
    return DetectionMode.PHOTON if is_glued(channel) else DetectionMode(mode)


def glued_parts(glued: str) -> tuple[str, str]:
    """Return the names of the analog and the photon-counting channel of a glued channel."""
    label = glued.removeprefix(GLUED)
    return f"analog_{label}", f"photon_{label}"


def file_channels(channel: str) -> tuple[str, ...]:
    """Return the channels of the files that a channel is made from."""
    return glued_parts(channel) if is_glued(channel) else (channel,)


class Role(StrEnum):
    """Purpose of a file."""

    SIGNAL = "signal"
    DARK = "dark"
    MOLECULAR = "molecular"
    ATMOSPHERE = "atmosphere"
    """Of a file of a source of the air, of which one profile may be used."""
    OVERLAP = "overlap"
    LIDAR_RATIO = "lidar_ratio"
    PRODUCT = "product"
    """Of a product that another one is made of; its path is below the folder of products."""
    UNUSED = "unused"
    """Of a raw file that a product states as unused; only in the ledger."""


class Status(StrEnum):
    """Whether a granule can be used."""

    GOOD = "good"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class ChannelLayout:
    """One channel of raw files: its detection mode, wavelength and range grid."""

    name: str
    """Identifier such as ``photon_532o``: mode, wavelength in nm, polarisation."""
    mode: DetectionMode
    wavelength: float
    """m; NaN where the header gives no plausible wavelength."""
    bins: int
    bin_width: float
    """m."""
    adc_bits: int
    """0 for photon counting."""
    recorder: str = ""
    """What digitises it, such as ``BT5``; empty where the raw format names none."""
    pre_trigger: float = 0.0
    """m, of a record that began before the pulse; its bins up to there are none of `bins`."""

    @property
    def before(self) -> int:
        """Number of bins of the record that begin before the pulse."""
        # Without rounding errors of a quotient of decimal numbers.
        return math.ceil(round(self.pre_trigger / self.bin_width, 6))


UNREADABLE: Final = "cannot be read"
"""Start of the reason if a disk or a network did not give a file."""
UNKNOWN_FORMAT: Final = "is of no known raw format"
"""Start of the reason if no installed format recognises a file."""
INVALID: Final = "is of a period that the facts declare invalid"
"""Start of the reason if a campaign wants no product of a file."""
MISDATED: Final = "more than a day away from the files beside it by name"
"""Start of the reason if names only count, and the date in a header cannot be right."""
ACKNOWLEDGED: Final = "acknowledged"
"""Start of the reason if a campaign knows that a file is refused, or belongs to no scene."""
EXPECTED: Final = (INVALID, ACKNOWLEDGED)
FEWEST_ALIKE: Final = 3
"""Fewest other files that must agree; with fewer, any of them may be the damaged one."""
LONGEST_REASON: Final = 300
"""Characters of a reason that products state; a damaged header may be quoted in it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What a raw file states of itself: its format makes it, the catalog stores it."""

    format: str = ""
    """Name of the raw format; empty where the file is refused."""
    start: datetime | None = None
    """UTC."""
    stop: datetime | None = None
    """UTC."""
    zenith_angle: float | None = None
    """degree, 0 = up; None where it is unknown."""
    azimuth: float | None = None
    """degree in [0, 360), clockwise from north."""
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    """m above the geoid."""
    layout: tuple[ChannelLayout, ...] = ()
    """Channels and their range grids, in file order."""
    notes: tuple[str, ...] = ()
    """Peculiarities in words."""
    header_digest: str | None = None
    """At most 16 characters; equal for files whose headers differ only in the fields above and in
    the lasers; None where unknown, or where the file may have changed."""
    setup: str = ""
    """Equal for files of one site whose channels were recorded in the same way, whatever their
    shots; empty where the file is refused."""


@dataclass(frozen=True, slots=True)
class Granule(Header):
    """One raw file as catalogued: times, pointing and position are those of the campaign."""

    path: str
    """Relative to the archive root, with forward slashes."""
    size: int
    mtime_ns: int
    instrument: str
    role: Role
    status: Status
    reason: str = ""
    """Why the granule is refused; empty when good."""
    contradictions: tuple[str, ...] = ()
    """Statements of the campaign on the station that the header contradicts, in words."""
    sha256: str | None = None
    """Digest of the file; None until the whole file has been read."""

    @property
    def is_expected(self) -> bool:
        """Whether the campaign says that the file is not used."""
        return self.reason.startswith(EXPECTED)


# An archive has few layouts.
@lru_cache(maxsize=128)
def after_pulse(layout: tuple[ChannelLayout, ...], pre_trigger: float) -> tuple[ChannelLayout, ...]:
    """Return channels without the bins before a pulse at so many m of the record."""
    stated = [replace(channel, pre_trigger=pre_trigger) for channel in layout]
    return tuple(replace(c, bins=max(c.bins - c.before, 0)) for c in stated)


@dataclass(frozen=True, slots=True)
class Holding:
    """Number of good signal files of one instrument with the same channels, in one period."""

    instrument: str
    since: datetime
    """Start of the period, not of its first file."""
    layout: tuple[ChannelLayout, ...]
    files: int
    first: datetime
    """Start of the first one."""


class UnusedFile(NamedTuple):
    """A raw file that belongs to a scene, and from which no product is made."""

    path: str
    """Relative to the archive root."""
    role: Role
    reason: str

    @classmethod
    def of(cls, refused: Granule) -> Self:
        """Return what products state of a refused file, each on one line.

        Not what a disk or network said: that may differ from try to try, and name other places.
        Nor which formats are installed: products do not depend on it.
        """
        reason = refused.reason
        if reason.startswith(UNREADABLE):
            reason = UNREADABLE
        elif reason.startswith(UNKNOWN_FORMAT):
            reason = reason.partition(" (")[0]
        return cls(_one_line(refused.path), refused.role, _one_line(reason)[:LONGEST_REASON])

    @classmethod
    def lost(cls, path: str, role: Role) -> Self:
        """Return what products state of a file that the archive had and no longer gives."""
        return cls(_one_line(path), role, "no longer in the archive")


def _one_line(text: str) -> str:
    """Return a text with escapes for what is no printable character."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


@dataclass(frozen=True, slots=True)
class Scene:
    """The granules that are processed together."""

    id: str
    campaign: str
    station: str
    instrument: str
    start: datetime
    """Start of the window, not of the first granule."""
    stop: datetime
    granules: tuple[Granule, ...]
    """Good signal granules, by start time then path; none of a month."""
    dark: tuple[Granule, ...] = ()
    """Good dark granules for this scene, by start time then path."""
    members: tuple[Scene, ...] = ()
    """Scenes of the instruments of a network, which together hold the granules of this scene;
    `station` and `instrument` are the key of the network. Empty for a single instrument."""
    notes: tuple[str, ...] = ()
    """Notes and contradictions of its signal granules, each with the number of granules."""
    unused: tuple[UnusedFile, ...] = ()
    """Files of its time that are refused, by path."""
    products: tuple[InputRecord, ...] = ()
    """Products of a month, of which its products are made; empty for a scene of raw files."""

    @property
    def layout(self) -> tuple[ChannelLayout, ...]:
        """Channels that every granule of the scene has; none of a month."""
        return self.granules[0].layout if self.granules else ()


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """One step of a plan, with its settings and the reason why it runs."""

    name: str
    channel: str
    settings: Mapping[str, Any]
    reason: str
    instrument: str = ""
    """Member of a network to which the step applies; empty where the scene has no members."""
    rule: str = ""
    """Name of the rule that decided."""
    number: float | None = None
    """Number on which the rule decided, where there is one."""
    product: str = ""
    """Kind of product to which it belongs; empty where all kinds share it."""
    needs: tuple[str, ...] = ()
    """Steps whose outputs it takes, run or left out: ``name``, or ``channel/name`` of another
    channel; for a product, also those of the same kind with which it is compared."""
    warning: str = ""
    """Why its results may be of no use; empty where nothing is known against them."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One step that a plan leaves out, and the reason."""

    name: str
    channel: str
    reason: str
    instrument: str = ""
    """Member of a network; empty where the scene has no members."""
    rule: str = ""
    """Name of the rule that decided."""
    number: float | None = None
    """Number on which the rule decided, where there is one."""
    product: str = ""
    """As of a planned step."""


_AnyEntry = TypeVar("_AnyEntry", bound=PlannedStep | LeftOut)


def products_of(entries: Iterable[_AnyEntry]) -> tuple[_AnyEntry, ...]:
    """Return the entries that are products themselves, and no steps on the way to one."""
    return tuple([entry for entry in entries if entry.name == entry.product])


_ALWAYS: Final = frozenset({"name", "channel", "settings", "reason"})
"""Fields that entries state even where they are empty."""


def entry_as_dict(entry: PlannedStep | LeftOut) -> dict[str, Any]:
    """Return an entry of a plan as plain JSON types."""
    values = {item.name: getattr(entry, item.name) for item in fields(entry)}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
        if name in _ALWAYS or value not in ("", None, ())
    }


@dataclass(frozen=True)
class Plan:
    """The steps that run for one scene, and those that are left out, with the reasons."""

    scene: str
    steps: tuple[PlannedStep, ...]
    left_out: tuple[LeftOut, ...]

    @cached_property
    def products(self) -> tuple[PlannedStep, ...]:
        """Steps that are products."""
        return products_of(self.steps)

    @cached_property
    def product_keys(self) -> tuple[tuple[str, str], ...]:
        """Kind and channel of each product, in the order of the steps."""
        return tuple(dict.fromkeys((step.name, step.channel) for step in self.products))

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain JSON types."""
        return {
            "scene": self.scene,
            "steps": list(map(entry_as_dict, self.steps)),
            "left_out": list(map(entry_as_dict, self.left_out)),
        }

    def lines(self, channel: str) -> list[str]:
        """Return what runs and what is left out, one line each, with channels other than this."""
        steps = (
            (s.name, s.channel, "; ".join(filter(None, (s.reason, s.warning)))) for s in self.steps
        )
        omitted = ((f"left out {o.name}", o.channel, o.reason) for o in self.left_out)
        return [
            f"{name}{f' of {owner}' if owner not in ('', channel) else ''}: {words}"
            for name, owner, words in (*steps, *omitted)
        ]

    @property
    def text(self) -> str:
        """The canonical JSON form; not kept, because it is larger than all else of a run."""
        return canonical(self.as_dict())

    @cached_property
    def hash(self) -> str:
        """sha256 of the canonical JSON form."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def canonical(value: Any) -> str:
    """Return JSON with sorted keys, without spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def without_numbers(text: str) -> str:
    """Return a text with a sign for each number: those that differ by values only are equal."""
    return re.sub(r"-?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)


def digest(value: Any) -> str:
    """Return the sha256 of plain JSON types."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class InputRecord:
    """One input file of a product."""

    path: str
    role: Role
    sha256: str


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a product: everything on which its content depends."""

    campaign: str
    scene: str
    kind: str
    channel: str
    inputs: tuple[InputRecord, ...]
    plan: Plan
    settings: Mapping[str, Any]
    """The part of the campaign on which the product depends, as plain JSON types."""
    versions: Mapping[str, str]
    """Package name -> version."""
    code_version: str


class Grade(StrEnum):
    """How much a product differs from the one that it replaces."""

    NONE = "none"
    """The same values and texts; the old file stays."""
    MINOR = "minor"
    """Texts, few flags, or values within a tenth of their stated errors."""
    MAJOR = "major"


class Measure(StrEnum):
    """What a difference is divided by."""

    ERROR = "standard error"
    """Of values that state one."""
    OF_ERROR = "share of the standard error"
    """Of an error itself, and of its parts: the standard error of the quantity."""
    SIZE = "share of the value"
    """Of values without a stated error: their size, or the usual one of the variable if larger."""


@dataclass(frozen=True, slots=True)
class Change:
    """How a product differs from the one that it replaces, and why."""

    grade: Grade
    largest: float
    """Largest difference of values that are in both, in units of `measure`."""
    variable: str
    """Of the largest difference; without one, in which values came or went."""
    share: float
    """Share of the values that differ."""
    causes: tuple[str, ...]
    """Inputs, settings, steps and software that differ."""
    measure: Measure = Measure.ERROR
    lost: int = 0
    """Number of values that are missing or rejected in only one of the two."""
    flags: int = 0
    """Number of flags and states that differ."""
    moved: str = ""
    """How values are of another place, time, wavelength, unit or state, as a phrase."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "grade": self.grade.value,
            "largest": self.largest,
            "measure": self.measure.value,
            "variable": self.variable,
            "share": self.share,
            "came_or_went": self.lost,
            "other_flags": self.flags,
            "other_meaning": self.moved,
            "causes": list(self.causes),
        }


@dataclass(frozen=True, slots=True)
class Stamp:
    """Number of a version of a product, and when it was written."""

    version: int = 1
    written: datetime | None = None
    """UTC; None for the time at which it is written."""


class Verdicts(NamedTuple):
    """Numbers of values by the worst severity of their quality bits."""

    good: int
    care: int
    reject: int

    @classmethod
    def of(cls, values: int, *, unflagged: int, usable: int) -> Verdicts:
        """Return the numbers of so many values, some without any bit and some not rejected."""
        return cls(unflagged, usable - unflagged, values - usable)

    @classmethod
    def total(cls, several: Iterable[Verdicts]) -> Verdicts:
        """Return the sums of several numbers of values."""
        return cls(*(sum(counts) for counts in zip((0, 0, 0), *several, strict=True)))

    @property
    def values(self) -> int:
        """Number of all values."""
        return sum(self)

    @property
    def usable(self) -> int:
        """Number of values that no bit rejects."""
        return self.good + self.care


@dataclass(frozen=True, slots=True)
class ProductRecord:
    """One written product."""

    path: str
    """Relative to the product root, with forward slashes."""
    kind: str
    channel: str
    sha256: str
    size: int
    values: int
    """Number of retrieved or measured values in the product's main variable."""
    flagged: Mapping[str, int]
    """Quality bit name -> number of values that carry it."""
    unflagged: int
    """Number of values that carry no bit."""
    usable: int | None = None
    """Number of values without a rejecting bit; None where they were not counted."""
    stamp: Stamp = field(default_factory=Stamp)
    """Of its file."""
    change: Change | None = None
    """How it differs from the product that it replaces; None for a new one."""

    @property
    def verdicts(self) -> Verdicts:
        """Numbers of good values, of those to be used with care, and of rejected ones."""
        usable = self.unflagged if self.usable is None else self.usable
        return Verdicts.of(self.values, unflagged=self.unflagged, usable=usable)


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Two channels of a scene that measure the same and disagree by more than their errors."""

    kind: str
    channels: tuple[str, str]
    outlier: str
    """The one of the two that more of the other channels contradict at the place; else empty."""
    place: float
    """Coordinate along the profile where they disagree most, m."""
    deviation: float
    """Difference there over its error, of all stated errors that differ between the channels."""

    @property
    def words(self) -> str:
        """The disagreement as a sentence without the scene."""
        wrong = (
            f"{self.outlier} is wrong, as other channels contradict it too"
            if self.outlier
            else "one of the two is wrong"
        )
        return (
            f"{' and '.join(self.channels)} differ by {self.deviation:.1f} stated errors at"
            f" {self.place:g} m, though both measure the same: {wrong}"
        )


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """Result of processing one scene."""

    scene: str
    station: str
    instrument: str
    start: datetime
    granules: int
    plan: Plan | None
    products: tuple[ProductRecord, ...] = ()
    refused: tuple[Granule, ...] = ()
    """Granules that could not be read during processing."""
    inputs: tuple[InputRecord, ...] = ()
    error: str = ""
    """Why the scene gave no product; empty where it gave one."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time by stage."""
    cpu_seconds: float = 0.0
    """CPU time of the thread that processed the scene; 0 where not measured."""
    left_out: tuple[LeftOut, ...] = ()
    """Requested steps that are not in `plan`, because their product or channel was not made."""

    disagreements: tuple[Disagreement, ...] = ()

    notes: tuple[str, ...] = ()
    """What the data did not give though the campaign requests it, with the remedy."""

    internal: str = ""
    """Traceback of the internal error (a bug of lidarops) that `error` names; else empty."""

    @property
    def unusable(self) -> bool:
        """Whether all values of the products that should have usable ones are rejected."""
        known = kinds()
        retrieved = [
            product
            for product in self.products
            if product.kind in known and known[product.kind].expects_usable
        ]
        return bool(retrieved) and all(product.usable == 0 for product in retrieved)


@dataclass(frozen=True, slots=True)
class Unmet:
    """A channel that a campaign requests or gives facts of, and files of an instrument lack."""

    instrument: str
    channel: str
    requested_by: str
    """Kind of the product that needs the channel, or the facts that name it, with their period."""
    reason: str
    files: int
    """Number of files that lack the channel."""
    files_expected: int
    """Number of files that should hold it: all of the instrument, or of the period of the facts."""
    files_with_channel: int
    """Number of files of the instrument, of any period, that hold it."""

    @property
    def nowhere(self) -> bool:
        """Whether no file holds the channel, as after a typing error."""
        return self.files_with_channel == 0


@dataclass(frozen=True, slots=True)
class FileNote:
    """A note on good files of an instrument."""

    instrument: str
    text: str
    contradicts: bool
    """Whether the headers contradict what the campaign states about the station."""
    files: int


@dataclass(frozen=True, slots=True)
class IdlePattern:
    """A file pattern of an instrument that matches no file of the archive."""

    instrument: str
    key: str
    """``files`` or ``dark_files``."""
    pattern: str


@dataclass(frozen=True, slots=True)
class Unmade:
    """A product that is requested of an instrument or network, and that does not exist."""

    instrument: str
    kind: str
    channel: str
    """Empty if all channels are requested, and none gives the product."""
    reason: str
    """Why examined scenes do not give it."""


@dataclass(frozen=True, slots=True)
class FactsNote:
    """Facts that no file or product uses, or that lack what products need."""

    instrument: str
    subject: str
    """Such as ``facts from 2024-01-01T00:00:00Z``."""
    reason: str


@dataclass(frozen=True, slots=True)
class UnusableFile:
    """A profile that the campaign names and that cannot be used."""

    instrument: str
    key: str
    """Fact that names it, such as ``molecular_profile``."""
    path: str
    problem: str


@dataclass(frozen=True, slots=True)
class LostFiles:
    """Raw files of products that have vanished, are empty or cannot be read."""

    instrument: str
    files: int
    of: int
    """Number of raw files of the products of which some are lost."""
    names: tuple[str, ...]
    """The first of them."""
    kept: int
    """Number of products that are kept as they are; those of few lost files are made again."""


@dataclass(frozen=True, slots=True)
class Findings:
    """Where an archive is not what the campaign states, names and requests."""

    unmet: tuple[Unmet, ...] = ()
    """Those that no file holds come first."""
    file_notes: tuple[FileNote, ...] = ()
    """Contradictions come first."""
    idle_patterns: tuple[IdlePattern, ...] = ()
    unusable_files: tuple[UnusableFile, ...] = ()
    unmade: tuple[Unmade, ...] = ()
    idle_facts: tuple[FactsNote, ...] = ()
    incomplete_facts: tuple[FactsNote, ...] = ()
    lost_files: tuple[LostFiles, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether the archive contradicts the campaign, lost many files, or a file is unusable."""
        return (
            bool(self.idle_patterns or self.unusable_files)
            or any(lost.kept for lost in self.lost_files)
            or any(request.nowhere for request in self.unmet)
            or any(note.contradicts for note in self.file_notes)
        )


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One execution over many scenes."""

    id: str
    campaign: str
    title: str
    started: datetime
    finished: datetime
    version: str
    archive: str
    products: str
    """Root of the products."""
    scenes: tuple[SceneOutcome, ...]
    refused: tuple[Granule, ...]
    """Granules that the catalog refused."""
    findings: Findings = field(default_factory=Findings)
    empty_scenes: Mapping[str, str] = field(default_factory=dict)
    """Scene -> why it can give no product; the first of those that the run examined."""
    more_empty_scenes: int = 0
    """Number of further scenes without product."""
    frozen: Mapping[str, str] = field(default_factory=dict)
    """Product of a frozen period that would be replaced -> why."""
    cut_short: bool = False
    """Whether the run was killed or met a full disk: it names only scenes that ended before."""

    @property
    def failed(self) -> bool:
        """Whether a file was refused, a scene failed or is unusable, or the findings failed.

        Files that the campaign declares invalid or acknowledges do not count.
        """
        return (
            bool(self.empty_scenes or self.cut_short)
            or not all(granule.is_expected for granule in self.refused)
            or self.findings.failed
            or any(scene.error or scene.unusable for scene in self.scenes)
            or not all(granule.is_expected for scene in self.scenes for granule in scene.refused)
        )

"""Frozen records that cross module borders: the vocabulary of lidarops, no logic.

The words mean the same everywhere: a *granule* is one raw file as catalogued, a *scene*
the granules that are processed together, a *plan* what runs for one scene and what is
left out and why, a *product* one NetCDF file, a *run* one execution over many scenes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any, Final


class DetectionMode(StrEnum):
    """How a channel detects light."""

    ANALOG = "analog"
    PHOTON = "photon"


class Role(StrEnum):
    """What a file is for."""

    SIGNAL = "signal"
    DARK = "dark"
    MOLECULAR = "molecular"
    OVERLAP = "overlap"


class Status(StrEnum):
    """Whether a granule can be used."""

    GOOD = "good"
    REFUSED = "refused"


class ProductKind(StrEnum):
    """Kinds of product."""

    SIGNAL = "signal"
    HOMOGENEOUS = "homogeneous"
    ELASTIC = "elastic"
    MULTIANGLE = "multiangle"
    VISIBILITY = "visibility"


@dataclass(frozen=True, slots=True)
class ChannelLayout:
    """What a channel looks like in every file of a layout: its place on the range grid."""

    name: str
    """Identifier such as ``photon_532o``: mode, wavelength label, polarisation."""
    mode: DetectionMode
    wavelength: float
    """m; NaN where the header holds no wavelength that light detectors know."""
    bins: int
    bin_width: float
    """m."""
    adc_bits: int
    """0 for photon counting."""


@dataclass(frozen=True, slots=True)
class Granule:
    """One raw file as catalogued."""

    path: str
    """Relative to the archive root, with forward slashes."""
    size: int
    mtime_ns: int
    instrument: str
    role: Role
    status: Status
    reason: str = ""
    """Why the granule is refused; empty when good."""
    notes: tuple[str, ...] = ()
    """What is odd about a good granule, in words."""
    start: datetime | None = None
    stop: datetime | None = None
    zenith_angle: float | None = None
    """degree, 0 = up."""
    azimuth: float | None = None
    """degree, clockwise from north."""
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    """m above the geoid."""
    layout: tuple[ChannelLayout, ...] = ()
    sha256: str | None = None
    """Of the whole file; None until the file has been read whole."""
    header_digest: str | None = None
    """Equal in files whose headers differ in what stands above alone, and in the lasers; None
    where that is not known, or the file may have changed."""


@dataclass(frozen=True, slots=True)
class Holding:
    """Good signal files of one instrument with the same channels, of a stretch of time."""

    instrument: str
    since: datetime
    """Where the stretch begins, not its first file."""
    layout: tuple[ChannelLayout, ...]
    files: int


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
    """Good signal granules, by start time then path."""
    dark: tuple[Granule, ...] = ()
    """Good dark granules that serve this scene, by start time then path."""
    members: tuple[Scene, ...] = ()
    """Of a network: the part of each instrument, whose granules are together those of the scene;
    `station` and `instrument` are the network's key. Empty for a single instrument."""

    @property
    def layout(self) -> tuple[ChannelLayout, ...]:
        """Channels that every granule of the scene has."""
        return self.granules[0].layout


@dataclass(frozen=True, slots=True)
class Step:
    """One thing that the plan does, with the settings it does it with."""

    name: str
    channel: str
    settings: Mapping[str, Any]
    reason: str
    instrument: str = ""
    """Member of a network that the step is for; empty where the scene has no members."""
    rule: str = ""
    """Name of the rule that decided, in `lidarops.plan.rule_table`."""
    number: float | None = None
    """That the rule decided on, where there is one."""

    def as_dict(self) -> dict[str, Any]:
        """Return the step as plain JSON types."""
        return {
            "name": self.name,
            "channel": self.channel,
            "settings": dict(self.settings),
            "reason": self.reason,
            **_of_member(self.instrument),
            **_decided(self.rule, self.number),
        }


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One thing that the plan does not do, and why."""

    name: str
    channel: str
    reason: str
    instrument: str = ""
    """Member of a network; empty where the scene has no members."""
    rule: str = ""
    """Name of the rule that decided, in `lidarops.plan.rule_table`."""
    number: float | None = None
    """That the rule decided on, where there is one."""

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain JSON types."""
        return {
            "name": self.name,
            "channel": self.channel,
            "reason": self.reason,
            **_of_member(self.instrument),
            **_decided(self.rule, self.number),
        }


def _of_member(instrument: str) -> dict[str, Any]:
    """Return what only plans of networks hold, so that other plans keep their hash."""
    return {"instrument": instrument} if instrument else {}


def _decided(rule: str, number: float | None) -> dict[str, Any]:
    return {
        **({"rule": rule} if rule else {}),
        **({"number": number} if number is not None else {}),
    }


@dataclass(frozen=True, slots=True)
class Plan:
    """What runs for one scene, and what is left out and why. Pure data."""

    scene: str
    steps: tuple[Step, ...]
    left_out: tuple[LeftOut, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain JSON types."""
        return {
            "scene": self.scene,
            "steps": [step.as_dict() for step in self.steps],
            "left_out": [left.as_dict() for left in self.left_out],
        }

    @property
    def hash(self) -> str:
        """sha256 of the canonical JSON form."""
        text = json.dumps(self.as_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class InputRecord:
    """One file that a product was made from."""

    path: str
    role: Role
    sha256: str


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a product came from: everything that its content depends on."""

    campaign: str
    scene: str
    kind: ProductKind
    channel: str
    inputs: tuple[InputRecord, ...]
    plan: Plan
    settings: Mapping[str, Any]
    """The part of the campaign that the product depends on, as plain JSON types."""
    versions: Mapping[str, str]
    """Package name -> version."""
    code_version: str


@dataclass(frozen=True, slots=True)
class ProductRecord:
    """One product that was written."""

    path: str
    """Relative to the product root, with forward slashes."""
    kind: ProductKind
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
    """Number of values that no bit rejects; None where it was not counted."""


JUDGE_THEMSELVES: Final = (ProductKind.ELASTIC, ProductKind.MULTIANGLE, ProductKind.VISIBILITY)
"""Products of which a scene is a trouble where all values are rejected.

Not homogeneous ones: sections are tried in any air, and fog or the dark leaves none of them.
"""


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """What became of one scene."""

    scene: str
    station: str
    instrument: str
    start: datetime
    granules: int
    plan: Plan | None
    products: tuple[ProductRecord, ...] = ()
    refused: tuple[Granule, ...] = ()
    """Granules that turned out unreadable while processing."""
    inputs: tuple[InputRecord, ...] = ()
    error: str = ""
    """Why the scene gave no product; empty when it did."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time by stage."""
    bytes_read: int = 0
    """Of raw files, headers apart."""
    cpu_seconds: float = 0.0
    """CPU time of the thread that processed it; 0 where it was not measured."""
    estimated_seconds: float = 0.0
    """CPU time that was reckoned with before; 0 where nothing was."""
    left_out: tuple[LeftOut, ...] = ()
    """What else was left out of what the scene was asked for: of products that it does not give at
    all, and of channels that it does not read, while `plan` tells of those that were made."""

    @property
    def empty(self) -> bool:
        """Whether every value of the retrievals that judge themselves is rejected."""
        retrieved = [product for product in self.products if product.kind in JUDGE_THEMSELVES]
        return bool(retrieved) and all(product.usable == 0 for product in retrieved)


@dataclass(frozen=True, slots=True)
class Unmet:
    """What a campaign asks for, or tells facts of, and files of an instrument do not hold."""

    instrument: str
    channel: str
    asked: str
    """Kind of the product that asks for the channel, or the facts that name it, with their
    period."""
    reason: str
    files: int
    """Number of files that lack it."""
    of: int
    """Number of files that were to hold it: all of the instrument, or of the period of facts."""
    held: int
    """Number of files of the instrument, of whatever period, that hold it."""

    @property
    def nowhere(self) -> bool:
        """Whether no file holds it, as after a slip of the pen."""
        return self.held == 0


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
    truth: str = ""
    """Path of the truth file of a simulated campaign, empty for real data."""
    costs: str = ""
    """Whence the costs were that times were estimated with; empty where nothing was estimated."""
    unmet: tuple[Unmet, ...] = ()
    """What is asked for, or told facts of, and not in the files; what no file holds first."""
    barren: Mapping[str, str] = field(default_factory=dict)
    """Scene -> why it can give no product, of the first of those that the run looked at."""
    more_barren: int = 0
    """How many more there were."""

    @property
    def failed(self) -> bool:
        """Whether anything was refused or failed, was asked for in vain, or left nothing to use."""
        return (
            bool(self.refused or self.barren)
            or any(each.nowhere for each in self.unmet)
            or any(scene.error or scene.refused or scene.empty for scene in self.scenes)
        )

"""Scene and plan -> estimated CPU time, from what each thing costs on this machine.

The estimate is a sum over `Term`: how much there is of it, times what one of it costs. Amounts
follow from the plan alone, costs from a calibration (`lidarops bench throughput --case costs`).
"""

from __future__ import annotations

import json
import math
import os
import platform
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, Final

from lidarops.errors import CatalogError
from lidarops.plan.signal_rules import GLUED, StepName, parts_of, read_windows
from lidarops.raw.model import bins_of
from lidarops.records import Granule, Plan, ProductKind, Scene, Step

_FORMAT: Final = "lidarops costs"
_CACHE_VARIABLE: Final = "XDG_CACHE_HOME"
MOST_FIGURES: Final = 40
"""Groups of products that a report draws."""


class Term(StrEnum):
    """What CPU time goes into."""

    RUN = "run"
    """A run: its process, what it imports, ledger."""
    LOAD = "load"
    """What the first scene of a process loads, whatever it is."""
    HOMOGENEOUS_LOAD = "homogeneous_load"
    """Compiled code that is loaded with the first scene that has such a product."""
    ELASTIC_LOAD = "elastic_load"
    MULTIANGLE_LOAD = "multiangle_load"
    VISIBILITY_LOAD = "visibility_load"
    SCENE = "scene"
    FILE = "file"
    """A raw file of a scene, dark ones too."""
    DIGEST = "digest"
    """A byte of raw files whose digest is not known yet."""
    CHANNEL = "channel"
    """A channel that is read."""
    VALUE = "value"
    """A profile times a bin, read and conditioned."""
    DARK = "dark"
    """A channel of which dark files are subtracted."""
    LOOK = "look"
    SIGNAL = "signal"
    SIGNAL_VALUE = "signal_value"
    """A profile times a bin, written."""
    HOMOGENEOUS = "homogeneous"
    HOMOGENEOUS_VALUE = "homogeneous_value"
    """A profile times a bin of a section."""
    ELASTIC = "elastic"
    ELASTIC_VALUE = "elastic_value"
    """An average times a bin."""
    MULTIANGLE = "multiangle"
    MULTIANGLE_VALUE = "multiangle_value"
    """A profile times an altitude."""
    VISIBILITY = "visibility"
    VISIBILITY_VALUE = "visibility_value"
    """An average of a beam."""
    PAGE = "page"
    """The page of a report."""
    SIGNAL_FIGURE = "signal_figure"
    """The figures of an instrument's channel, all scenes together."""
    HOMOGENEOUS_FIGURE = "homogeneous_figure"
    ELASTIC_FIGURE = "elastic_figure"
    MULTIANGLE_FIGURE = "multiangle_figure"
    VISIBILITY_FIGURE = "visibility_figure"
    FIGURE_VALUE = "figure_value"
    """A profile times a bin that figures are made of."""


@dataclass(frozen=True, slots=True)
class Costs:
    """What one of each term costs on a machine."""

    seconds: Mapping[Term, float]
    """CPU time in s, of every term."""
    processor: str = ""
    date: str = ""
    """Of the calibration; empty for the costs that come with lidarops."""
    note: str = ""
    """Why these costs are not those of this machine; empty where they are."""

    def of(self, amounts: Mapping[Term, float]) -> float:
        """Return the CPU time of some amounts, s."""
        return math.fsum(self.seconds[term] * amount for term, amount in amounts.items())

    @property
    def words(self) -> str:
        """Whence the costs are, for people."""
        return self.note or f"calibrated on this machine on {self.date}"


UNCALIBRATED: Final = (
    "not calibrated on this machine: run lidarops bench throughput --case costs, once"
)
DEFAULTS: Final[Mapping[Term, float]] = {
    Term.RUN: 7.0,
    Term.LOAD: 1.5,
    Term.HOMOGENEOUS_LOAD: 0.1,
    Term.ELASTIC_LOAD: 0.1,
    Term.MULTIANGLE_LOAD: 0.1,
    Term.VISIBILITY_LOAD: 0.1,
    Term.SCENE: 0.005,
    Term.FILE: 2e-5,
    Term.DIGEST: 2e-9,
    Term.CHANNEL: 0.01,
    Term.VALUE: 1.2e-7,
    Term.DARK: 0.035,
    Term.LOOK: 0.04,
    Term.SIGNAL: 0.05,
    Term.SIGNAL_VALUE: 2e-8,
    Term.HOMOGENEOUS: 0.08,
    Term.HOMOGENEOUS_VALUE: 1.2e-7,
    Term.ELASTIC: 0.1,
    Term.ELASTIC_VALUE: 5e-7,
    Term.MULTIANGLE: 0.1,
    Term.MULTIANGLE_VALUE: 6e-6,
    Term.VISIBILITY: 0.2,
    Term.VISIBILITY_VALUE: 2.5e-3,
    Term.PAGE: 0.2,
    Term.SIGNAL_FIGURE: 0.8,
    Term.HOMOGENEOUS_FIGURE: 0.4,
    Term.ELASTIC_FIGURE: 1.5,
    Term.MULTIANGLE_FIGURE: 1.9,
    Term.VISIBILITY_FIGURE: 1.2,
    Term.FIGURE_VALUE: 3e-7,
}
"""Costs of a common server core, where nothing was measured."""


@dataclass(slots=True)
class Tally:
    """The estimated CPU time of a run, scene by scene."""

    costs: Costs
    scenes: float = 0.0
    """s, of all scenes."""
    count: int = 0
    """Of scenes in which something is done."""
    _figures: set[tuple[str, str, str]] = field(default_factory=set)
    _values: float = 0.0

    def add(self, scene: Scene, plan: Plan, *, whole: bool = False) -> float:
        """Add a scene and return its own CPU time, s; see `amounts`."""
        terms = amounts(scene, plan, whole=whole)
        made = {(step.name, scene.instrument, step.channel) for step in _products(plan)}
        self.count += bool(made)
        self._figures |= made
        self._values += terms.get(Term.SIGNAL_VALUE, 0.0) + terms.get(Term.ELASTIC_VALUE, 0.0)
        found = self.costs.of(terms)
        self.scenes += found
        return found

    @property
    def loading(self) -> float:
        """What scenes cost once, s: compiled code, by kinds of products."""
        kinds = {kind for kind, _, _ in self._figures}
        return self.costs.of(
            {load_of(kind): 1.0 for kind in kinds}
            | dict.fromkeys([Term.LOAD] if kinds else [], 1.0)
        )

    @property
    def start(self) -> float:
        """What a run costs once, s: its process, compiled code, ledger."""
        return self.loading + self.costs.of({Term.RUN: 1.0}) if self.count else 0.0

    @property
    def report(self) -> float:
        """What the report costs, s."""
        if not self.count:
            return 0.0
        drawn = Counter(kind for kind, _, _ in sorted(self._figures)[:MOST_FIGURES])
        terms = {figure(kind): float(number) for kind, number in drawn.items()}
        return self.costs.of({Term.PAGE: 1.0, Term.FIGURE_VALUE: self._values, **terms})

    @property
    def total(self) -> float:
        """CPU time of the run, s."""
        return self.start + self.scenes + self.report

    @property
    def parts(self) -> dict[str, float]:
        """CPU time of scenes, start and report, and of all, s."""
        return {
            "scenes": self.scenes,
            "start": self.start,
            "report": self.report,
            "all": self.total,
        }


def load_of(kind: str) -> Term:
    """Return the term of what is loaded with the first product of a kind."""
    # What signals load is what all products do.
    return Term.LOAD if kind == ProductKind.SIGNAL else Term(f"{kind}_load")


def figure(kind: str) -> Term:
    """Return the term of the figures of a kind of product."""
    return Term(f"{kind}_figure")


def amounts(scene: Scene, plan: Plan, *, whole: bool = False) -> dict[Term, float]:
    """Return how much of each term a scene takes.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        What is to be done; before files are looked at, so that what a look leaves out counts.
    whole : bool
        Whether every file is read whole, as with ``--all-steps``.

    Returns
    -------
    dict of Term to float
        Without what there is nothing of; empty where the plan gives no product.
    """
    products = _products(plan)
    if not products:
        return {}
    parts = scene.members or (scene,)
    reading = [step.channel for step in plan.steps if step.name == StepName.READ]
    files = (*scene.granules, *scene.dark)
    found: dict[Term, float] = defaultdict(float)
    found[Term.SCENE] = 1
    found[Term.FILE] = sum(
        len(part.granules) + len(part.dark) * _darkened(plan, part.instrument) for part in parts
    )
    found[Term.DIGEST] = sum(each.size for each in files if whole or each.sha256 is None)
    found[Term.CHANNEL] = sum(not name.startswith(GLUED) for name in reading)
    found[Term.VALUE] = sum(_conditioned(part, plan) for part in parts)
    found[Term.DARK] = sum(step.name == StepName.DARK for step in plan.steps)
    found[Term.LOOK] = sum(step.name == StepName.LOOK for step in plan.steps)
    for step in products:
        found[Term(step.name)] += 1
        found[Term(f"{step.name}_value")] += _values(step, scene, plan)
    return {term: float(amount) for term, amount in found.items() if amount}


def _products(plan: Plan) -> list[Step]:
    kinds = tuple(ProductKind)
    return [step for step in plan.steps if step.name in kinds]


def _darkened(plan: Plan, instrument: str) -> bool:
    return any(
        step.name == StepName.DARK and step.instrument in ("", instrument) for step in plan.steps
    )


def _of(plan: Plan, part: Scene) -> Iterator[Step]:
    """Give the steps of a scene, or of a member of one."""
    return (step for step in plan.steps if step.instrument in ("", part.instrument))


def _bins(part: Scene) -> dict[str, int]:
    return {channel.name: channel.bins for channel in part.layout}


def _conditioned(part: Scene, plan: Plan) -> float:
    """Return profiles times bins that are read and conditioned; joined channels read their own."""
    held = _bins(part)
    windows = read_windows(tuple(_of(plan, part)))
    total = 0
    for step in _of(plan, part):
        if step.name == StepName.READ and not _only_a_part(step.channel, plan):
            names = parts_of(step.channel) if step.channel.startswith(GLUED) else (step.channel,)
            total += sum(
                bins_of(windows[name]) if name in windows else held.get(name, 0) for name in names
            )
    return float(len(part.granules) * total)


def _only_a_part(channel: str, plan: Plan) -> bool:
    """Return whether a channel is read for joined ones alone."""
    glued = {value for step in plan.steps if step.name == StepName.GLUE
             for value in step.settings.values()}  # fmt: skip
    return channel in glued and channel not in {step.channel for step in _products(plan)}


def _values(step: Step, scene: Scene, plan: Plan) -> float:
    settings = step.settings
    if step.name == ProductKind.VISIBILITY:
        seconds = _average(step, plan)
        members = {member.instrument: member for member in scene.members}
        return float(
            sum(_intervals(members[beam["instrument"]].granules, seconds)
                for beam in settings["beams"])
        )  # fmt: skip
    profiles = len(scene.granules)
    if step.name == ProductKind.HOMOGENEOUS:
        width = min(channel.bin_width for channel in scene.layout)
        return float(profiles * sum((far - near) / width for near, far in settings["sections"]))
    if step.name == ProductKind.MULTIANGLE:
        return float(profiles * settings["highest"] / settings["step"])
    held = _bins(scene)
    names = parts_of(step.channel) if step.channel.startswith(GLUED) else (step.channel,)
    bins = min(held[name] for name in names)
    if step.name == ProductKind.ELASTIC:
        return float(_intervals(scene.granules, _average(step, plan)) * bins)
    return float(profiles * bins)


def _average(product: Step, plan: Plan) -> float:
    return next(
        float(step.settings["seconds"])
        for step in plan.steps
        if step.name == StepName.AVERAGE and step.channel == product.channel
    )


def _intervals(granules: Iterable[Granule], seconds: float) -> int:
    """Return how many intervals of the clock hold profiles."""
    starts = (granule.start for granule in granules)
    return len({math.floor(start.timestamp() / seconds) for start in starts if start})


# The calibration of a machine -----------------------------------------------------------------


@cache
def processor() -> str:
    """Return the model of this machine's processor."""
    facts = Path("/proc/cpuinfo")
    if facts.is_file():
        for line in facts.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def calibration_path() -> Path:
    """Return where this user's calibration of this machine is kept.

    Raises
    ------
    CatalogError
        Where neither the environment nor the system tells.
    """
    try:
        folder = os.environ.get(_CACHE_VARIABLE) or str(Path.home() / ".cache")
    except RuntimeError as error:
        # A container may run as a user that it does not know.
        raise CatalogError(
            f"a calibration has no place: {error}", remedy=f"set {_CACHE_VARIABLE}"
        ) from error
    return Path(folder) / "lidarops" / "costs.json"


def save_calibration(costs: Costs, path: Path | None = None) -> Path:
    """Keep a calibration.

    Raises
    ------
    CatalogError
        Where the file cannot be written, or has no place.
    """
    target = path or calibration_path()
    document = {
        "format": _FORMAT,
        "processor": costs.processor,
        "date": costs.date,
        "seconds": {term.value: costs.seconds[term] for term in Term},
    }
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Renamed, as another process may be reading it.
        with tempfile.NamedTemporaryFile(
            "w", dir=target.parent, prefix=f".{target.name}.", encoding="utf-8", delete=False
        ) as stream:
            json.dump(document, stream, indent=1)
        Path(stream.name).replace(target)
    except OSError as error:
        raise CatalogError(
            f"cannot be written: {error}", file=target, remedy=f"set {_CACHE_VARIABLE}"
        ) from error
    return target


def load_calibration(path: Path | None = None) -> Costs:
    """Return the costs of this machine: calibrated where they are, with a note where not.

    A calibration of another processor is not used, as home directories move.

    Returns
    -------
    Costs
        Never raises: an estimate is no reason for a command to fail.
    """
    source = path
    try:
        source = path or calibration_path()
        document = json.loads(source.read_text(encoding="utf-8"))
        return _read(document)
    except FileNotFoundError:
        note = UNCALIBRATED
    except CatalogError as error:
        note = f"{UNCALIBRATED} ({error})"
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        note = f"{UNCALIBRATED} ({source} cannot be used: {error})"
    return Costs(DEFAULTS, note=note)


def _read(document: Any) -> Costs:
    if document["format"] != _FORMAT:
        raise ValueError("it is no calibration")
    if document["processor"] != processor():
        raise ValueError(f"it is of another machine, {document['processor']}")
    seconds = {term: float(document["seconds"][term.value]) for term in Term}
    if not all(math.isfinite(each) and each >= 0 for each in seconds.values()):
        raise ValueError("a cost is no time")
    return Costs(seconds, processor=processor(), date=str(document["date"]))

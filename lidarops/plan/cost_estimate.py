"""Estimate the CPU time of a scene from its plan and from unit costs of this machine.

The estimate is a sum over `Term` of amount times unit cost. Amounts follow from the plan, unit
costs from a calibration (`lidarops bench throughput --case costs`).
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
from lidarops.kinds import kinds
from lidarops.plan.rules import StepName
from lidarops.plan.signal_rules import GLUED, glued_parts, read_windows
from lidarops.raw.model import count_bins
from lidarops.records import Granule, Plan, Scene, Step

_FORMAT: Final = "lidarops costs"
_CACHE_VARIABLE: Final = "XDG_CACHE_HOME"
MOST_FIGURES: Final = 40
"""Number of groups of products that a report draws."""


class Term(StrEnum):
    """A term of the CPU time."""

    RUN = "run"
    """A run: process, imports, ledger."""
    LOAD = "load"
    """Compiled code that the first scene of a process loads, for any product."""
    HOMOGENEOUS_LOAD = "homogeneous_load"
    """Compiled code that the first scene with such a product loads."""
    ELASTIC_LOAD = "elastic_load"
    MULTIANGLE_LOAD = "multiangle_load"
    VISIBILITY_LOAD = "visibility_load"
    SCENE = "scene"
    FILE = "file"
    """A raw file of a scene, dark files included."""
    DIGEST = "digest"
    """A byte of a raw file whose digest is not known yet."""
    CHANNEL = "channel"
    """A channel that is read."""
    VALUE = "value"
    """One bin of one profile, read and conditioned."""
    DARK = "dark"
    """A channel from which dark files are subtracted."""
    LOOK = "look"
    SIGNAL = "signal"
    SIGNAL_VALUE = "signal_value"
    """One bin of one profile, written."""
    HOMOGENEOUS = "homogeneous"
    HOMOGENEOUS_VALUE = "homogeneous_value"
    """One bin of a section of one profile."""
    ELASTIC = "elastic"
    ELASTIC_VALUE = "elastic_value"
    """One bin of one average."""
    MULTIANGLE = "multiangle"
    MULTIANGLE_VALUE = "multiangle_value"
    """One altitude of one profile."""
    VISIBILITY = "visibility"
    VISIBILITY_VALUE = "visibility_value"
    """One average of one beam."""
    PAGE = "page"
    """The page of a report."""
    SIGNAL_FIGURE = "signal_figure"
    """The figures of one channel of an instrument, for all scenes together."""
    HOMOGENEOUS_FIGURE = "homogeneous_figure"
    ELASTIC_FIGURE = "elastic_figure"
    MULTIANGLE_FIGURE = "multiangle_figure"
    VISIBILITY_FIGURE = "visibility_figure"
    FIGURE_VALUE = "figure_value"
    """One bin of one profile in a figure."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Unit costs of all terms on a machine."""

    seconds: Mapping[Term, float]
    """Term -> CPU time in s for one unit."""
    processor: str = ""
    date: str = ""
    """Date of the calibration; empty for `DEFAULTS`."""
    note: str = ""
    """Why these costs are not those of this machine; empty where they are."""

    def of(self, amounts: Mapping[Term, float]) -> float:
        """Return the CPU time of amounts, s."""
        return math.fsum(self.seconds[term] * amount for term, amount in amounts.items())

    @property
    def words(self) -> str:
        """Source of the costs, in words."""
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
"""Costs on a common server core, used without a calibration."""


@dataclass(slots=True)
class Tally:
    """The estimated CPU time of a run, scene by scene."""

    costs: Costs
    scenes: float = 0.0
    """s, of all scenes."""
    count: int = 0
    """Number of scenes with products."""
    _figures: set[tuple[str, str, str]] = field(default_factory=set)
    _values: float = 0.0

    def add(self, scene: Scene, plan: Plan, *, whole: bool = False) -> float:
        """Add a scene and return its own CPU time, s; see `amounts`."""
        terms = amounts(scene, plan, whole=whole)
        made = {(step.name, scene.instrument, step.channel) for step in _products(plan)}
        self.count += bool(made)
        self._figures |= made
        self._values += terms.get(Term.SIGNAL_VALUE, 0.0) + terms.get(Term.ELASTIC_VALUE, 0.0)
        seconds = self.costs.of(terms)
        self.scenes += seconds
        return seconds

    @property
    def loading(self) -> float:
        """CPU time to load compiled code once, by kinds of products, s."""
        kinds = {kind for kind, _, _ in self._figures}
        return self.costs.of(
            {load_term(kind): 1.0 for kind in kinds}
            | dict.fromkeys([Term.LOAD] if kinds else [], 1.0)
        )

    @property
    def start(self) -> float:
        """CPU time of a run besides scenes and report, s: process, compiled code, ledger."""
        return self.loading + self.costs.of({Term.RUN: 1.0}) if self.count else 0.0

    @property
    def report(self) -> float:
        """CPU time of the report, s."""
        if not self.count:
            return 0.0
        drawn = Counter(kind for kind, _, _ in sorted(self._figures)[:MOST_FIGURES])
        terms = {figure_term(kind): float(number) for kind, number in drawn.items()}
        return self.costs.of({Term.PAGE: 1.0, Term.FIGURE_VALUE: self._values, **terms})

    @property
    def total(self) -> float:
        """CPU time of the run, s."""
        return self.start + self.scenes + self.report

    @property
    def parts(self) -> dict[str, float]:
        """CPU time of scenes, start, report and all together, s."""
        return {
            "scenes": self.scenes,
            "start": self.start,
            "report": self.report,
            "all": self.total,
        }


def load_term(kind: str) -> Term:
    """Return the term of the code that the first product of a kind loads."""
    # The signal product loads nothing beyond what all products load.
    return Term.LOAD if kind == "signal" else Term(f"{kind}_load")


def figure_term(kind: str) -> Term:
    """Return the term of the figures of a kind of product."""
    return Term(f"{kind}_figure")


def amounts(scene: Scene, plan: Plan, *, whole: bool = False) -> dict[Term, float]:
    """Return the amount of each term in a scene.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        Before it is refined in the worker: sections that are left out there still count.
    whole : bool
        Whether every file is read in full, as with ``--all-steps``.

    Returns
    -------
    dict of Term to float
        Terms with an amount above 0; empty where the plan makes no product.
    """
    products = _products(plan)
    if not products:
        return {}
    members = scene.members or (scene,)
    channels = [step.channel for step in plan.steps if step.name == StepName.READ]
    files = (*scene.granules, *scene.dark)
    terms: dict[Term, float] = defaultdict(float)
    terms[Term.SCENE] = 1
    terms[Term.FILE] = sum(
        len(member.granules) + len(member.dark) * _subtracts_dark(plan, member.instrument)
        for member in members
    )
    terms[Term.DIGEST] = sum(file.size for file in files if whole or file.sha256 is None)
    terms[Term.CHANNEL] = sum(not name.startswith(GLUED) for name in channels)
    terms[Term.VALUE] = sum(_conditioned(member, plan) for member in members)
    terms[Term.DARK] = sum(step.name == StepName.DARK for step in plan.steps)
    terms[Term.LOOK] = sum(step.name == StepName.LOOK for step in plan.steps)
    for step in products:
        terms[Term(step.name)] += 1
        terms[Term(f"{step.name}_value")] += _values(step, scene, plan)
    return {term: float(amount) for term, amount in terms.items() if amount}


def _products(plan: Plan) -> list[Step]:
    names = tuple(kinds())
    return [step for step in plan.steps if step.name in names]


def _subtracts_dark(plan: Plan, instrument: str) -> bool:
    return any(
        step.name == StepName.DARK and step.instrument in ("", instrument) for step in plan.steps
    )


def _steps_of(plan: Plan, member: Scene) -> Iterator[Step]:
    """Yield the steps of a scene, or of a member of one."""
    return (step for step in plan.steps if step.instrument in ("", member.instrument))


def _bins(scene: Scene) -> dict[str, int]:
    return {channel.name: channel.bins for channel in scene.layout}


def _conditioned(member: Scene, plan: Plan) -> float:
    """Return the number of values that are read and conditioned; glued channels read both parts."""
    bins = _bins(member)
    windows = read_windows(tuple(_steps_of(plan, member)))
    total = 0
    for step in _steps_of(plan, member):
        if step.name == StepName.READ and not _only_glued(step.channel, plan):
            names = glued_parts(step.channel) if step.channel.startswith(GLUED) else (step.channel,)
            total += sum(
                count_bins(windows[name]) if name in windows else bins.get(name, 0)
                for name in names
            )
    return float(len(member.granules) * total)


def _only_glued(channel: str, plan: Plan) -> bool:
    """Return whether a channel is read for glued channels only."""
    glued = {value for step in plan.steps if step.name == StepName.GLUE
             for value in step.settings.values()}  # fmt: skip
    return channel in glued and channel not in {step.channel for step in _products(plan)}


def _values(step: Step, scene: Scene, plan: Plan) -> float:
    settings = step.settings
    if step.name == "visibility":
        seconds = _average(step, plan)
        members = {member.instrument: member for member in scene.members}
        return float(
            sum(_intervals(members[beam["instrument"]].granules, seconds)
                for beam in settings["beams"])
        )  # fmt: skip
    profiles = len(scene.granules)
    if step.name == "homogeneous":
        width = min(channel.bin_width for channel in scene.layout)
        return float(profiles * sum((far - near) / width for near, far in settings["sections"]))
    if step.name == "multiangle":
        return float(profiles * settings["highest"] / settings["step"])
    by_channel = _bins(scene)
    names = glued_parts(step.channel) if step.channel.startswith(GLUED) else (step.channel,)
    bins = min(by_channel[name] for name in names)
    if step.name == "elastic":
        return float(_intervals(scene.granules, _average(step, plan)) * bins)
    return float(profiles * bins)


def _average(product: Step, plan: Plan) -> float:
    return next(
        float(step.settings["seconds"])
        for step in plan.steps
        if step.name == StepName.AVERAGE and step.channel == product.channel
    )


def _intervals(granules: Iterable[Granule], seconds: float) -> int:
    """Return the number of clock intervals that hold profiles."""
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
    """Return the path of this user's calibration of this machine.

    Raises
    ------
    CatalogError
        If neither the environment nor the system gives a home folder.
    """
    try:
        folder = os.environ.get(_CACHE_VARIABLE) or str(Path.home() / ".cache")
    except RuntimeError as error:
        # A container may run as a user without a home folder.
        raise CatalogError(
            f"there is no folder for a calibration: {error}", remedy=f"set {_CACHE_VARIABLE}"
        ) from error
    return Path(folder) / "lidarops" / "costs.json"


def save_calibration(costs: Costs, path: Path | None = None) -> Path:
    """Write a calibration, and return its path.

    Raises
    ------
    CatalogError
        If the file cannot be written, or there is no folder for it.
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
        # Replaced atomically, because another process may read it.
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
    """Return the costs of this machine: calibrated ones, or `DEFAULTS` with a note.

    A calibration of another processor is not used, because home directories are shared between
    machines. Never raises, because a missing estimate must not stop a command.
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
        raise ValueError("it is not a calibration")
    if document["processor"] != processor():
        raise ValueError(f"it is for another processor, {document['processor']}")
    seconds = {term: float(document["seconds"][term.value]) for term in Term}
    if not all(math.isfinite(cost) and cost >= 0 for cost in seconds.values()):
        raise ValueError("a cost is not a finite, non-negative time")
    return Costs(seconds, processor=processor(), date=str(document["date"]))

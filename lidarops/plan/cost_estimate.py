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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, Final

from lidarops.errors import CatalogError
from lidarops.kinds import kinds
from lidarops.raw.model import count_bins
from lidarops.records import Plan, PlannedStep, Scene
from lidarops.steps.channels import file_channels, is_glued
from lidarops.steps.dependence import is_product, plan_closure
from lidarops.steps.reading import read_windows
from lidarops.steps.registry import making_step, typed_settings
from lidarops.steps.step import UnitCosts

_FORMAT: Final = "lidarops costs"
_CACHE_VARIABLE: Final = "XDG_CACHE_HOME"
MOST_FIGURES: Final = 40
"""Number of groups of products that a report draws."""


class Term(StrEnum):
    """A term of the CPU time that all kinds of product share; see `kind_terms` for the others."""

    RUN = "run"
    """A run: process, imports, ledger."""
    LOAD = "load"
    """Compiled code that the first scene of a process loads, for any product."""
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
    """Sampled profiles of a channel, for decisions that need data."""
    PAGE = "page"
    """The page of a report."""
    FIGURE_VALUE = "figure_value"
    """One bin of one profile in a figure."""


def value_term(kind: str) -> str:
    """Return the term of one value of a product, as its step counts them."""
    return f"{kind}_value"


def load_term(kind: str) -> str:
    """Return the term of the compiled code that the first product of a kind loads."""
    return f"{kind}_load"


def figure_term(kind: str) -> str:
    """Return the term of the figures of one channel of an instrument, for all scenes together."""
    return f"{kind}_figure"


@dataclass(frozen=True, slots=True)
class Costs:
    """Unit costs of all terms on a machine."""

    seconds: Mapping[str, float]
    """Term -> CPU time in s for one unit."""
    processor: str = ""
    date: str = ""
    """Date of the calibration; empty for `default_costs`."""
    note: str = ""
    """Why these costs are not those of this machine; empty where they are."""

    def of(self, amounts: Mapping[str, float]) -> float:
        """Return the CPU time of amounts, s."""
        return math.fsum(self.seconds[term] * amount for term, amount in amounts.items())

    @property
    def words(self) -> str:
        """Source of the costs, in words."""
        return self.note or f"calibrated on this machine on {self.date}"


UNCALIBRATED: Final = (
    "not calibrated on this machine: run lidarops bench throughput --case costs, once"
)
_SHARED_COSTS: Final[Mapping[Term, float]] = {
    Term.RUN: 7.0,
    Term.LOAD: 1.5,
    Term.SCENE: 0.005,
    Term.FILE: 2e-5,
    Term.DIGEST: 2e-9,
    Term.CHANNEL: 0.01,
    Term.VALUE: 1.2e-7,
    Term.DARK: 0.035,
    Term.LOOK: 0.04,
    Term.PAGE: 0.2,
    Term.FIGURE_VALUE: 3e-7,
}


@cache
def default_costs() -> Mapping[str, float]:
    """Return the costs on a common server core, used without a calibration, by term in s."""
    costs: dict[str, float] = {term.value: seconds for term, seconds in _SHARED_COSTS.items()}
    for kind in kinds():
        of_kind: UnitCosts = making_step(kind).costs
        costs |= {
            kind: of_kind.product,
            value_term(kind): of_kind.value,
            load_term(kind): of_kind.load,
            figure_term(kind): of_kind.figure,
        }
    return costs


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
        self._values += sum(
            terms.get(value_term(kind), 0.0) for kind in kinds() if making_step(kind).drawn_whole
        )
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


def amounts(scene: Scene, plan: Plan, *, whole: bool = False) -> dict[str, float]:
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
    dict of str to float
        Terms with an amount above 0; empty where the plan makes no product.
    """
    products = _products(plan)
    if not products:
        return {}
    members = scene.members or (scene,)
    channels = [step.channel for step in plan.steps if step.name == "read"]
    files = (*scene.granules, *scene.dark)
    terms: dict[str, float] = defaultdict(float)
    terms[Term.SCENE] = 1
    terms[Term.FILE] = sum(
        len(member.granules) + len(member.dark) * _subtracts_dark(plan, member.instrument)
        for member in members
    )
    terms[Term.DIGEST] = sum(file.size for file in files if whole or file.sha256 is None)
    terms[Term.CHANNEL] = sum(not is_glued(name) for name in channels)
    terms[Term.VALUE] = sum(_conditioned(member, plan) for member in members)
    terms[Term.DARK] = sum(step.name == "dark" for step in plan.steps)
    terms[Term.LOOK] = sum(step.name == "look" for step in plan.steps)
    for step in products:
        closure = plan_closure(plan, [(step.name, step.channel)])
        terms[step.name] += 1
        terms[value_term(step.name)] += making_step(step.name).values(
            typed_settings(step), scene, closure
        )
    return {term: float(amount) for term, amount in terms.items() if amount}


def _products(plan: Plan) -> list[PlannedStep]:
    return [step for step in plan.steps if is_product(step)]


def _subtracts_dark(plan: Plan, instrument: str) -> bool:
    return any(step.name == "dark" and step.instrument in ("", instrument) for step in plan.steps)


def _steps_of(plan: Plan, member: Scene) -> Iterator[PlannedStep]:
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
        if step.name == "read" and not _only_glued(step.channel, plan):
            names = file_channels(step.channel)
            total += sum(
                count_bins(windows[name]) if name in windows else bins.get(name, 0)
                for name in names
            )
    return float(len(member.granules) * total)


def _only_glued(channel: str, plan: Plan) -> bool:
    """Return whether a channel is read for glued channels only."""
    return channel not in {step.channel for step in _products(plan)} and any(
        channel in file_channels(step.channel) for step in plan.steps if is_glued(step.channel)
    )


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
        "seconds": {term: costs.seconds[term] for term in default_costs()},
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
    """Return the costs of this machine: calibrated ones, or `default_costs` with a note.

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
    return Costs(default_costs(), note=note)


def _read(document: Any) -> Costs:
    if document["format"] != _FORMAT:
        raise ValueError("it is not a calibration")
    if document["processor"] != processor():
        raise ValueError(f"it is for another processor, {document['processor']}")
    measured = document["seconds"]
    missing = [term for term in _SHARED_COSTS if term not in measured]
    if missing:
        raise ValueError(f"it lacks {missing[0]}")
    # It may be older than a kind of product, which is then estimated from the costs of its step.
    seconds = {term: float(measured.get(term, cost)) for term, cost in default_costs().items()}
    if not all(math.isfinite(cost) and cost >= 0 for cost in seconds.values()):
        raise ValueError("a cost is not a finite, non-negative time")
    return Costs(seconds, processor=processor(), date=str(document["date"]))

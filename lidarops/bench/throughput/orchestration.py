"""What it costs to run a campaign by workers or as a Prefect flow, over a plain loop."""

from __future__ import annotations

import importlib.util
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lidarops.errors import SceneError
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import Part, Table

SERIAL: Final = "plain loop"
_CLI: Final = ("-c", "from lidarops.cli import app; app()", "reprocess")
_FLOW: Final = ("-m", "flows.reprocess")
WAYS: Final[Mapping[str, tuple[str, ...]]] = {
    SERIAL: _CLI,
    "2 workers": (*_CLI, "--workers", "2"),
    "flow": _FLOW,
    "flow, 2 workers": (*_FLOW, "--workers", "2"),
}
JOB: Final = 300.0
"""s of CPU time of the plain loop, of the job that the table extrapolates to."""


@dataclass(frozen=True, slots=True)
class RunMode:
    """How campaigns were run, and what each took with all processes that it started."""

    name: str
    cpu: tuple[float, ...]
    """s, a campaign."""
    wall: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Overhead:
    """CPU time of a way over that of the plain loop, as a line."""

    fixed: float
    """s, whatever the size."""
    share: float
    """s for each s of the plain loop."""

    def of(self, job: float) -> float:
        """Return the share of a job that takes the plain loop so many s."""
        return self.fixed / job + self.share


def measure_orchestration(
    campaigns: Sequence[Path], *, ways: Sequence[str] = tuple(WAYS)
) -> tuple[RunMode, ...]:
    """Run campaigns by every way, each with an output folder of its own.

    Parameters
    ----------
    campaigns : sequence of Path
        Campaign files with their archives, of rising size.
    ways : sequence of str
        Of `WAYS`; flows are left out where their package is not there.

    Raises
    ------
    SceneError
        If a run fails.
    """
    there = importlib.util.find_spec("flows") is not None
    asked = [name for name in ways if there or not name.startswith("flow")]
    found = []
    for name in asked:
        taken = [_run(WAYS[name], file, name.replace(", ", "-")) for file in campaigns]
        found.append(
            RunMode(name, tuple(cpu for cpu, _ in taken), tuple(wall for _, wall in taken))
        )
    return tuple(found)


def _run(words: Sequence[str], campaign: Path, name: str) -> tuple[float, float]:
    command = [sys.executable, *words, str(campaign), "--out", str(campaign.parent / name)]
    before, began = _children(), time.perf_counter()
    # Of the words above and the path of a campaign that is written here.
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    wall = time.perf_counter() - began
    if done.returncode:
        told = f"{done.stdout}\n{done.stderr}".strip()[-500:]
        raise SceneError(f"the run by {name} failed: {told}", file=campaign)
    return _children() - before, wall


def _children() -> float:
    """Return the CPU time in s of the processes that ended, and of all that they waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def overhead(way: RunMode, serial: RunMode) -> Overhead:
    """Return the line through the smallest and the largest campaign."""
    extra = [mine - plain for mine, plain in zip(way.cpu, serial.cpu, strict=True)]
    share = (extra[-1] - extra[0]) / (serial.cpu[-1] - serial.cpu[0])
    return Overhead(fixed=extra[0] - share * serial.cpu[0], share=share)


def part(ways: Sequence[RunMode], scenes: Sequence[int]) -> Part:
    """Return the part of the page."""
    serial = next(way for way in ways if way.name == SERIAL)
    told: list[Callable[[RunMode], str]] = [
        lambda way: f"{way.cpu[-1]:.1f}",
        lambda way: f"{way.wall[-1]:.1f}",
        lambda way: f"{overhead(way, serial).fixed:.1f}",
        lambda way: percent(overhead(way, serial).share),
        lambda way: percent(overhead(way, serial).of(JOB)),
    ]
    table = Table(
        title=f"Whole commands, with the start of all processes, at {scenes[-1]} scenes",
        columns=(
            "way",
            "CPU s",
            "wall s",
            "fixed extra CPU s",
            "extra CPU of the rest",
            f"extra CPU of a job of {JOB:.0f} s",
        ),
        rows=tuple((way.name, *(cell(way) for cell in told)) for way in ways),
        note=f"Lines through campaigns of {scenes[0]} and {scenes[-1]} scenes; the flow starts a "
        "Prefect server of its own, which a deployment has already.",
    )
    return Part(
        title="Workers and flows",
        text="The same campaign by the command line and as a flow. CPU time of all processes.",
        tables=(table,),
    )

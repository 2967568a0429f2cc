"""Extra cost of running a campaign with workers or as a Prefect flow, over a plain loop."""

from __future__ import annotations

import importlib.util
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.harness.figure import share
from benchmarks.harness.rows import Scores, rows_of_scores
from benchmarks.harness.study import Chapter, Results
from lidarops.errors import SceneError

SERIAL: Final = "plain loop"
_CLI: Final = ("-c", "from lidarops.cli import app; app()", "reprocess")
_FLOW: Final = ("-m", "flows.reprocess")
COMMANDS: Final[Mapping[str, tuple[str, ...]]] = {
    SERIAL: _CLI,
    "2 workers": (*_CLI, "--workers", "2"),
    "flow": _FLOW,
    "flow, 2 workers": (*_FLOW, "--workers", "2"),
}
JOB: Final = 300.0
"""s; CPU time of the plain loop for the job to which the table extrapolates."""


@dataclass(frozen=True, slots=True)
class RunMode:
    """A command that runs campaigns, and the times of each campaign with all its processes."""

    name: str
    cpu: tuple[float, ...]
    """s, for each campaign."""
    wall: tuple[float, ...]
    """s, for each campaign."""


def measure_orchestration(
    campaigns: Sequence[Path], *, names: Sequence[str] = tuple(COMMANDS)
) -> tuple[RunMode, ...]:
    """Return the times of campaigns run by each command, each with its own output folder.

    Parameters
    ----------
    campaigns : sequence of Path
        Campaign files with their archives, of ascending size.
    names : sequence of str
        Keys of `COMMANDS`; flows are omitted if their package is not installed.

    Raises
    ------
    SceneError
        If a run fails.
    """
    has_flows = importlib.util.find_spec("flows") is not None
    modes = []
    for name in names:
        if name.startswith("flow") and not has_flows:
            continue
        times = [_run(COMMANDS[name], file, name.replace(", ", "-")) for file in campaigns]
        modes.append(
            RunMode(name, tuple(cpu for cpu, _ in times), tuple(wall for _, wall in times))
        )
    return tuple(modes)


def _run(words: Sequence[str], campaign: Path, name: str) -> tuple[float, float]:
    command = [sys.executable, *words, str(campaign), "--out", str(campaign.parent / name)]
    before, began = _children_cpu(), time.perf_counter()
    # The command consists of constants and the path of a campaign written by us.
    process = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    wall = time.perf_counter() - began
    if process.returncode:
        output = f"{process.stdout}\n{process.stderr}".strip()[-500:]
        raise SceneError(f"the run by {name} failed: {output}", file=campaign)
    return _children_cpu() - before, wall


def _children_cpu() -> float:
    """Return the CPU time in s of all ended child processes and their descendants."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def overhead(mode: RunMode, serial: RunMode) -> tuple[float, float]:
    """Return extra CPU time over the plain loop: s for any size, and s per s of the plain loop.

    The line goes through the smallest and the largest campaign.
    """
    extra = [cpu - plain for cpu, plain in zip(mode.cpu, serial.cpu, strict=True)]
    slope = (extra[-1] - extra[0]) / (serial.cpu[-1] - serial.cpu[0])
    return extra[0] - slope * serial.cpu[0], slope


def orchestration_chapter(modes: Sequence[RunMode], scenes: Sequence[int]) -> Chapter:
    """Return the chapter on workers and flows."""
    serial = next(mode for mode in modes if mode.name == SERIAL)
    scores: Scores = {}
    for mode in modes:
        fixed, slope = overhead(mode, serial)
        scores["", mode.name] = {
            "CPU s": mode.cpu[-1],
            "wall s": mode.wall[-1],
            "fixed extra CPU s": fixed,
            "extra CPU of the rest": share(slope),
            f"extra CPU of a job of {JOB:.0f} s": share(fixed / JOB + slope),
        }
    commands = Results(
        f"Whole commands, including the start of all processes, for {scenes[-1]} scenes",
        rows_of_scores(scores),
        f"Lines through campaigns of {scenes[0]} and {scenes[-1]} scenes. The flow starts its "
        "own Prefect server, which a deployment already has.",
        method="command",
    )
    return Chapter(
        "Workers and flows",
        "The same campaign by the command line and as a flow. CPU time of all processes.",
        [commands],
    )

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

from lidarops.bench.harness.rows import Row, Unit, table
from lidarops.errors import SceneError
from lidarops.reports.benchmark_page import Part

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
_EXTRA: Final = f"extra CPU of a job of {JOB:.0f} s"
_SHARE: Final = Unit.SHARE


@dataclass(frozen=True, slots=True)
class RunMode:
    """A command that runs campaigns, and the times of each campaign with all its processes."""

    name: str
    cpu: tuple[float, ...]
    """s, for each campaign."""
    wall: tuple[float, ...]
    """s, for each campaign."""


@dataclass(frozen=True, slots=True)
class Overhead:
    """Extra CPU time over the plain loop, as a straight line."""

    fixed: float
    """s, independent of the size."""
    share: float
    """s per s of the plain loop."""

    def of(self, job: float) -> float:
        """Return the extra share of a job that takes the plain loop `job` s."""
        return self.fixed / job + self.share


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


def overhead(mode: RunMode, serial: RunMode) -> Overhead:
    """Return the line through the smallest and the largest campaign."""
    extra = [cpu - plain for cpu, plain in zip(mode.cpu, serial.cpu, strict=True)]
    share = (extra[-1] - extra[0]) / (serial.cpu[-1] - serial.cpu[0])
    return Overhead(fixed=extra[0] - share * serial.cpu[0], share=share)


def orchestration_part(modes: Sequence[RunMode], scenes: Sequence[int]) -> Part:
    """Return the chapter on workers and flows."""
    serial = next(mode for mode in modes if mode.name == SERIAL)
    rows = [
        row
        for mode in modes
        for row in (
            Row("", mode.name, "CPU s", mode.cpu[-1]),
            Row("", mode.name, "wall s", mode.wall[-1]),
            Row("", mode.name, "fixed extra CPU s", overhead(mode, serial).fixed),
            Row("", mode.name, "extra CPU of the rest", overhead(mode, serial).share, unit=_SHARE),
            Row("", mode.name, _EXTRA, overhead(mode, serial).of(JOB), unit=_SHARE),
        )
    ]
    commands = table(
        f"Whole commands, including the start of all processes, for {scenes[-1]} scenes",
        rows,
        f"Lines through campaigns of {scenes[0]} and {scenes[-1]} scenes. The flow starts its "
        "own Prefect server, which a deployment already has.",
        method="command",
    )
    return Part(
        title="Workers and flows",
        text="The same campaign by the command line and as a flow. CPU time of all processes.",
        tables=(commands,),
    )

"""Report page of the throughput of retrievals from scans."""

from __future__ import annotations

from collections.abc import Sequence

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.bench.harness.benchmark import facts
from lidarops.bench.harness.timing import READ, StepCost
from lidarops.bench.throughput.scan_kernels import INPUTS, MultiAngleThroughput
from lidarops.figures.charts import Ladder
from lidarops.figures.wording import counted
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table


def multiangle_throughput_report(timing: MultiAngleThroughput, data: str = "") -> BenchmarkReport:
    """Return the page of the throughput benchmark."""
    return BenchmarkReport(
        title="Scans: time per profile",
        facts=facts(timing.date, timing.machine),
        parts=(_times(timing),),
        data=data,
    )


def _times(timing: MultiAngleThroughput) -> Part:
    batches = sorted({cost.batch for cost in timing.costs})
    return Part(
        title="CPU time per profile",
        text=f"Clear air, {timing.angles} angles, {timing.altitudes} altitudes, float64, one "
        "thread, least CPU time of interleaved repeats. make_beams, regress and vertical.smooth "
        "are steps; the others are complete retrievals, with all errors, residuals and flags. "
        "Plain: without the robust passes, which a single residual too large for chance starts, "
        "and which take more time than all other steps. The peers give values without flags, "
        f"lstsq also standard errors. {READ} is a vectorised maximum of the signals in the same "
        "run.",
        charts=(_time_ladder(timing, batches),),
        tables=tuple(_time_table(timing, batch) for batch in batches),
    )


def _time_ladder(timing: MultiAngleThroughput, batches: Sequence[int]) -> Ladder:
    steps = list(dict.fromkeys(cost.step for cost in timing.costs))
    spent = {(cost.batch, cost.step): cost.nanoseconds / 1e3 for cost in timing.costs}
    return Ladder(
        name="multiangle-time",
        title=f"CPU time per profile of {timing.angles} angles and {timing.altitudes} altitudes",
        caption="By the number of profiles in one call.",
        x_label="CPU time per profile (µs)",
        rows=tuple(steps),
        series=tuple(
            (counted(batch, "profile"), tuple(spent.get((batch, step)) for step in steps))
            for batch in batches
        ),
    )


def _time_table(timing: MultiAngleThroughput, batch: int) -> Table:
    costs = [cost for cost in timing.costs if cost.batch == batch]
    whole = next(cost.nanoseconds for cost in costs if cost.step == cases.JOINT)
    samples = timing.angles * timing.altitudes
    return Table(
        title=f"Calls of {counted(batch, 'profile')}",
        columns=(
            "step",
            "whose",
            "profiles",
            "µs per profile",
            "ns per sample",
            "ns per altitude",
            "reads",
            "times joint",
        ),
        rows=tuple(
            (
                cost.step,
                _whose(cost),
                f"{cost.profiles:,}",
                f"{cost.nanoseconds / 1e3:,.2f}",
                f"{cost.nanoseconds / samples:,.2f}",
                f"{cost.nanoseconds / timing.altitudes:,.1f}",
                f"{cost.reads:,.1f}",
                f"{cost.nanoseconds / whole:,.2f}",
            )
            for cost in costs
        ),
        note=f"Reads: multiples of {READ}. Profiles: in one call, fewer for slow methods.",
    )


def _whose(cost: StepCost) -> str:
    if cost.step in {READ, INPUTS}:
        return "floor"
    return "ours" if cost.ours else "peer"

"""CPU time of methods beside a read of the same array in the same run."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from typing import Final

from benchmarks.harness.drawing import Ladder
from benchmarks.harness.figure import cpu_time
from benchmarks.harness.rows import CPU_TIME, Row, rows_of
from benchmarks.harness.study import Chapter, Results
from benchmarks.harness.timing import READ, in_threads, least_times
from lidarops.figures.wording import counted

READS: Final = "reads"
"""Quantity: CPU time as a multiple of the read."""
Calls = Mapping[str, tuple[Callable[[], object], int]]
"""Calls by method, each with its number of profiles; the read is one of them."""


def batch_label(batch: int) -> str:
    """Return the name of the case of a number of profiles per call."""
    return f"{counted(batch, 'profile')} a call"


def time_methods(case: str, calls: Calls, repeats: int, *, peers: Container[str] = ()) -> list[Row]:
    """Return the least CPU time per profile of each method, and as a multiple of the read."""
    times = least_times({name: call for name, (call, _) in calls.items()}, repeats)
    read = times[READ] / calls[READ][1]
    rows = []
    for name, (_, profiles) in calls.items():
        seconds = times[name] / profiles
        rows += rows_of(
            case,
            name,
            {
                "lidarops": name != READ and name not in peers,
                "profiles": profiles,
                CPU_TIME: cpu_time(1e9 * seconds),
                READS: seconds / read,
            },
        )
    return rows


def thread_gain(whole: Callable[[], object], half: Callable[[int], object], repeats: int) -> float:
    """Return the wall time of one thread over that of two, each with half of the profiles."""
    calls = {"one": whole, "two": lambda: in_threads(half, 2)}
    times = least_times(calls, repeats, clock="perf_counter")
    return times["one"] / times["two"]


def cost_chapter(name: str, text: str, rows: Sequence[Row]) -> Chapter:
    """Return the chapter on the CPU time of methods, with a chart of all cases."""
    times = {
        (row.case, row.method): 1e-3 * row.value
        for row in rows
        if row.quantity == CPU_TIME and isinstance(row.value, float)
    }
    cases, methods = (tuple(dict.fromkeys(key[number] for key in times)) for number in (0, 1))
    return Chapter(
        "CPU time per profile",
        f"{text} {READ} is a vectorised maximum of the same array in the same run: the floor.",
        [
            Results(
                case,
                [row for row in rows if row.case == case],
                "Reads: multiples of the read. Profiles: of a call, fewer for slow methods.",
            )
            for case in cases
        ],
        [
            Ladder(
                name,
                "CPU time per profile",
                "A mark for each case.",
                f"{CPU_TIME} (µs)",
                methods,
                tuple((case, tuple(times.get((case, m)) for m in methods)) for case in cases),
            )
        ],
    )

"""Methods beside each other: their scores, and the study of one retrieval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from benchmarks.harness.figure import (
    CPU_TIME,
    SIGMAS,
    Array,
    Figure,
    Mask,
    Score,
    cpu_time,
    mean_by_block,
    root_by_block,
    share,
    share_by_block,
    timed,
)
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Results, Study, Work, frame

RMSE: Final = "RMSE"
BIAS: Final = "mean error"
WITHIN_1: Final = "within 1"
COVERAGE: Final = "95 %"
_DRAWN: Final = frozenset({"background of 100000 counts", "3 x 2 beams, plume, noise 5 %"})
"""Settings drawn for a retrieval, if not its first."""
_Result = TypeVar("_Result")


def score_errors(error: Array, stated: Array, kept: Mask, block: int = 1) -> Score:
    """Return mean and root mean square of kept errors, and how many are within the stated ones.

    Parameters
    ----------
    error, stated : (profile, ...) float
        In the unit of the scores.
    kept : (profile, ...) bool
    block : int
        Profiles of a block; blocks are independent, and Monte Carlo errors are from their scatter.
    """
    # Of one value per profile, half a profile keeps the error above zero.
    mean = share_by_block if error.ndim == 1 else mean_by_block
    within = [mean(abs(error) <= sigmas * stated, kept, block) for sigmas in SIGMAS]
    return {
        BIAS: mean_by_block(error, kept, block),
        RMSE: root_by_block(error, kept, block),
        WITHIN_1: within[0] and share(within[0]),
        COVERAGE: within[1] and share(within[1]),
    }


def time_profiles(
    call: Callable[[], _Result], profiles: int, rounds: int = 1
) -> tuple[Figure, _Result]:
    """Return the least CPU time per profile of some rounds of a call, and its result."""
    spent = [timed(call) for _ in range(rounds)]
    return cpu_time(1e9 * min(seconds for seconds, _ in spent) / profiles), spent[-1][1]


def comparison(
    retrieval: str, works: Sequence[Work], note: str, others: Sequence[Results] = ()
) -> Study:
    """Return the study of the methods of one retrieval, with other tables of it."""
    scores = {
        (f"{work.quantity}; {work.setting}", method_name(work)): score_of(work) | work.more
        for work in works
    }
    table = Results(f"{retrieval.capitalize()}: all methods", scores, note, case="error of")
    return Study([table, *others], [methods_chart(retrieval, works)], works)


def method_name(work: Work) -> str:
    """Return the name of a method; that of a peer says so."""
    return work.method if work.ours else f"peer: {work.method}"


def score_of(work: Work) -> Score:
    """Return error, coverage and time of a method."""
    coverage = None if work.coverage is None else share(work.coverage)
    return {RMSE: work.error, COVERAGE: coverage, CPU_TIME: work.time}


def drawn_setting(settings: Sequence[str]) -> str:
    """Return the setting that stands for all of a retrieval."""
    return next((setting for setting in settings if setting in _DRAWN), settings[0])


def methods_chart(retrieval: str, works: Sequence[Work]) -> Chart:
    """Return the errors against run time in two settings that peers solve too."""
    quantity = works[0].quantity
    drawn = [work for work in works if work.quantity == quantity]
    settings = list(dict.fromkeys(work.setting for work in drawn if not work.ours))
    last = drawn_setting(settings)
    chosen = {settings[0], last if last != settings[0] else settings[-1]}
    scores = {
        (work.setting, work.method): score_of(work) for work in drawn if work.setting in chosen
    }
    return Chart(
        "all-" + retrieval.replace(" ", "-"),
        f"{retrieval.capitalize()}: RMSE of {quantity} against CPU time",
        frame(scores),
        RMSE,
        {work.method for work in drawn if not work.ours or work.informed},
    )

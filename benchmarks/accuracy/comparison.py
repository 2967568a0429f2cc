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
    Scores,
    Work,
    cpu_time,
    mean_by_block,
    root_by_block,
    share,
    share_by_block,
    timed,
)
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Results, Study

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
    """Return the study of the methods of one retrieval, with other tables of it.

    Its chart shows the first quantity in two settings that peers solve too.
    """
    scores: Scores = {}
    for work in works:
        key = f"{work.quantity}; {work.setting}", f"{'' if work.ours else 'peer: '}{work.method}"
        figures = {RMSE: work.error, COVERAGE: work.coverage, CPU_TIME: work.time}
        scores[key] = figures | work.more
    title, quantity = retrieval.capitalize(), works[0].quantity
    table = Results(f"{title}: all methods", scores, note, case="error of")
    drawn = [work for work in works if work.quantity == quantity]
    settings = list(dict.fromkeys(work.setting for work in drawn if not work.ours))
    last = next((setting for setting in settings if setting in _DRAWN), settings[-1])
    chart = Chart(
        "all-" + retrieval.replace(" ", "-"),
        f"{title}: RMSE of {quantity} against CPU time",
        [work for work in drawn if work.setting in {settings[0], last}],
    )
    return Study([table, *others], [chart], works)

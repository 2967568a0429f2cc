"""Methods beside each other: their scores, and the study of one retrieval."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, TypeVar

from benchmarks.harness import figure
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Results, Study

RMSE: Final = "RMSE"
BIAS: Final = "mean error"
WITHIN_1: Final = "within 1"
COVERAGE: Final = "95 %"
ROUNDS: Final = 3
"""Timed calls, of which the least counts: others share the processor."""
_DRAWN: Final = frozenset({"background of 100000 counts", "3 x 2 beams, plume, noise 5 %"})
"""Settings drawn for a retrieval, if not its first."""
_Result = TypeVar("_Result")


def score_errors(
    error: figure.Array, stated: figure.Array, kept: figure.Mask, block: int = 1
) -> figure.Score:
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
    mean = figure.share_by_block if error.ndim == 1 else figure.mean_by_block
    within = [mean(abs(error) <= sigmas * stated, kept, block) for sigmas in figure.SIGMAS]
    return {
        BIAS: figure.mean_by_block(error, kept, block),
        RMSE: figure.root_by_block(error, kept, block),
        WITHIN_1: within[0] and figure.share(within[0]),
        COVERAGE: within[1] and figure.share(within[1]),
    }


def time_profiles(
    call: Callable[[], _Result], profiles: int, rounds: int = 1
) -> tuple[figure.Figure, _Result]:
    """Return the least CPU time per profile of some rounds of a call, and its result."""
    spent = [figure.timed(call) for _ in range(rounds)]
    return figure.cpu_time(1e9 * min(seconds for seconds, _ in spent) / profiles), spent[-1][1]


def study(
    retrieval: str, works: Sequence[figure.Work], note: str, others: Sequence[Results] = ()
) -> Study:
    """Return the study of the methods of one retrieval, with other tables of it.

    Its chart shows the first quantity in two settings that peers solve too.
    """
    scores: figure.Scores = {}
    for work in works:
        key = f"{work.quantity}; {work.setting}", f"{'' if work.ours else 'peer: '}{work.method}"
        figures = {RMSE: work.error, COVERAGE: work.coverage, figure.CPU_TIME: work.time}
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


def against_peers(works: Mapping[str, Sequence[figure.Work]]) -> figure.Scores:
    """Return the most accurate of our methods beside that of the peers, in every setting.

    Parameters
    ----------
    works : mapping of sequences of figure.Work
        By retrieval.
    """
    scores: figure.Scores = {}
    for retrieval, every in works.items():
        for quantity, setting in dict.fromkeys((work.quantity, work.setting) for work in every):
            group = [
                work for work in every
                if (work.quantity, work.setting) == (quantity, setting) and not work.informed
            ]  # fmt: skip
            ours, peers = ([work for work in group if work.ours is of] for of in (True, False))
            if ours and peers:
                best = _best(ours)
                key = (f"{retrieval}, {setting}: {quantity}", best.method)
                scores[key] = _compared(best, _best(peers))
    return scores


def _compared(ours: figure.Work, peer: figure.Work) -> figure.Score:
    """Return the ratios of error and time of a method of ours to those of a peer, and words."""
    ratio = ours.error.value / peer.error.value
    scatter = math.hypot(ours.error.error / ours.error.value, peer.error.error / peer.error.value)
    faster = ours.time.value <= peer.time.value
    equal = abs(ratio - 1.0) < 2.0 * ratio * scatter
    accuracy = "equal error" if equal else "less accurate" if ratio > 1.0 else "more accurate"
    return {
        "peer": peer.method,
        "error, ratio": figure.Figure(ratio, ratio * scatter),
        "time, ratio": ours.time.value / peer.time.value,
        "ours is": f"{accuracy}, {'faster' if faster else 'slower'}",
    }


def _best(works: Sequence[figure.Work]) -> figure.Work:
    least = min((work.error for work in works), key=lambda error: error.value)
    equal = [
        work
        for work in works
        if work.error.value - least.value <= 2.0 * math.hypot(work.error.error, least.error)
    ]
    return min(equal, key=lambda work: work.time.value)

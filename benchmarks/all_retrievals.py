"""Error against run time of all retrievals, on one page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from benchmarks.accuracy import elastic, homogeneous, multiangle, network
from benchmarks.harness.figure import Figure, share
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Chapter, Effort, Results, Study, Work, frame
from benchmarks.harness.timing import CPU_TIME
from benchmarks.harness.verdicts import Score, Scores

_RMSE: Final = "RMSE"
STRONGEST: Final = "Ours beside the strongest peer"
_DRAWN: Final = frozenset({"background of 100000 counts", "3 x 2 beams, plume, noise 5 %"})
"""Settings drawn for a retrieval, if not its first."""
Works = Mapping[str, Sequence[Work]]
"""Works by retrieval."""


def measure_all(effort: Effort, *, data: Path | None = None) -> Study:
    """Measure error against run time of all retrievals.

    Parameters
    ----------
    effort : Effort
    data : Path, optional
        Folder of published signals, for the elastic retrieval.

    Raises
    ------
    CampaignError
        If the folder holds no such files.
    RawFormatError
        If a published file cannot be read.
    """
    studies = {
        "homogeneous path": homogeneous.measure_homogeneous(effort),
        "elastic inversion": elastic.measure_elastic_accuracy(effort, data=data),
        "scans over zenith angle": multiangle.measure_multiangle(effort),
        "networks of lidars": network.measure_network(effort),
    }
    chapters = [
        _prefixed(chapter, name) for name, study in studies.items() for chapter in study.chapters
    ]
    works = {name: study.works for name, study in studies.items()}
    return Study(
        "All retrievals: error against run time",
        effort.date,
        [_overview(works), *chapters],
        [work for group in works.values() for work in group],
    )


def _prefixed(chapter: Chapter, name: str) -> Chapter:
    """Return a chapter with the retrieval in its titles and file names, which makes them unique."""
    word = name.split(maxsplit=1)[0]
    return replace(
        chapter,
        title=f"{word.capitalize()}: {chapter.title}",
        results=[replace(r, title=f"{word.capitalize()}: {r.title}") for r in chapter.results],
        charts=[replace(chart, name=f"{word}-{chart.name}") for chart in chapter.charts],
    )


def _overview(works: Works) -> Chapter:
    return Chapter(
        "Error against run time, all retrievals",
        "All methods of all retrievals, with common baselines and iterative peers, on "
        "simulated profiles with known truth. Root mean square error over the profiles that a "
        "method does not reject; CPU time per profile on one core. The chapters below describe "
        "the simulations and give bias, coverage and flags.",
        [
            Results(
                "The most accurate of our methods and of the peers",
                best_methods(works),
                "Of methods whose errors differ by less than 2 Monte Carlo errors, the fastest. "
                "One setting of each retrieval; the tables below list all. 95 %: share of truths "
                "in the stated interval. In brackets: Monte Carlo standard error.",
                case="error of",
            ),
            Results(
                STRONGEST,
                against_peers(works),
                "All settings that peers solve too. Ratios of ours over that of the peer; equal if "
                "the errors differ by less than 2 Monte Carlo errors.",
                case="error of",
                method="ours",
            ),
            *(
                Results(
                    f"{retrieval.capitalize()}: all methods",
                    {(f"{work.quantity}; {work.setting}", _named(work)): _score(work)
                     for work in group},
                    case="error of",
                    folded=True,
                )
                for retrieval, group in works.items()
            ),
        ],
        [_chart(retrieval, group) for retrieval, group in works.items()],
    )  # fmt: skip


def _named(work: Work) -> str:
    return work.method if work.ours else f"peer: {work.method}"


def _score(work: Work) -> Score:
    coverage = None if work.coverage is None else share(work.coverage)
    return {_RMSE: work.error, "95 %": coverage, CPU_TIME: work.time}


def _drawn_setting(settings: Sequence[str]) -> str:
    return next((setting for setting in settings if setting in _DRAWN), settings[0])


def best_methods(works: Works) -> Scores:
    """Return the best of our methods and of the peers for each retrieval and quantity.

    Of methods whose errors differ by less than 2 Monte Carlo errors, the best is the fastest.
    """
    scores: Scores = {}
    for retrieval, every in works.items():
        for quantity in dict.fromkeys(work.quantity for work in every):
            group = [w for w in every if w.quantity == quantity and not w.informed]
            setting = _drawn_setting([work.setting for work in group])
            for ours in (True, False):
                rivals = [work for work in group if work.ours is ours and work.setting == setting]
                if rivals:
                    best = _best(rivals)
                    scores[f"{retrieval}, {setting}: {quantity}", _named(best)] = _score(best)
    return scores


def against_peers(works: Works) -> Scores:
    """Return the most accurate of our methods beside that of the peers, in every setting."""
    scores: Scores = {}
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


def _compared(ours: Work, peer: Work) -> Score:
    """Return the ratios of error and time of a method of ours to those of a peer, and words."""
    ratio = ours.error.value / peer.error.value
    scatter = math.hypot(ours.error.error / ours.error.value, peer.error.error / peer.error.value)
    faster = ours.time.value <= peer.time.value
    away = (ratio - 1.0) / (ratio * scatter) if scatter else math.copysign(math.inf, ratio - 1.0)
    accuracy = (
        "equal error" if abs(away) < 2.0 else "less accurate" if away > 0 else "more accurate"
    )
    return {
        "peer": peer.method,
        "error, ratio": Figure(ratio, ratio * scatter),
        "time, ratio": ours.time.value / peer.time.value,
        "ours is": f"{accuracy}, {'faster' if faster else 'slower'}",
    }


def _best(works: Sequence[Work]) -> Work:
    least = min((work.error for work in works), key=lambda error: error.value)
    equal = [
        work
        for work in works
        if work.error.value - least.value <= 2.0 * math.hypot(work.error.error, least.error)
    ]
    return min(equal, key=lambda work: work.time.value)


def _chart(retrieval: str, works: Sequence[Work]) -> Chart:
    quantity = works[0].quantity
    drawn = [work for work in works if work.quantity == quantity]
    settings = list(dict.fromkeys(work.setting for work in drawn if not work.ours))
    last = _drawn_setting(settings)
    chosen = {settings[0], last if last != settings[0] else settings[-1]}
    scores = {(work.setting, work.method): _score(work) for work in drawn if work.setting in chosen}
    return Chart(
        "all-" + retrieval.replace(" ", "-"),
        f"{retrieval.capitalize()}: RMSE of {quantity} against CPU time",
        "Bars of 2 Monte Carlo standard errors. Hollow: peers, and methods that know more than the "
        "profile or solve only a part. The steps join the methods that no other beats in both "
        "error and time.",
        frame(scores),
        _RMSE,
        {work.method for work in drawn if not work.ours or work.informed},
        gain=1.0,
    )

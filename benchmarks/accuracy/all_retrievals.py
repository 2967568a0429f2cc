"""Error against run time of all retrievals, on one page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from benchmarks.accuracy import elastic, homogeneous, multiangle, network
from benchmarks.accuracy.comparison import drawn_setting, method_name, score_of
from benchmarks.harness.figure import Figure, Score, Scores
from benchmarks.harness.results import Effort, Results, Study, Work

Works = Mapping[str, Sequence[Work]]
"""Works by retrieval."""


def measure_all(effort: Effort) -> Study:
    """Measure error against run time of all retrievals.

    Raises
    ------
    CampaignError
        If the folder of published signals holds no such files.
    """
    studies = {
        "homogeneous path": homogeneous.measure_homogeneous(effort),
        "elastic inversion": elastic.measure_elastic_accuracy(effort),
        "scans over zenith angle": multiangle.measure_multiangle(effort),
        "networks of lidars": network.measure_network(effort),
    }
    works = {name: study.works for name, study in studies.items()}
    best = Results(
        "The most accurate of our methods and of the peers",
        best_methods(works),
        "Of methods whose errors differ by less than 2 Monte Carlo errors, the fastest. One "
        "setting of each retrieval; the tables below list all. 95 %: share of truths in the stated "
        "interval. In brackets: Monte Carlo standard error.",
        case="error of",
    )
    beside = Results(
        "Ours beside the strongest peer",
        against_peers(works),
        "All settings that peers solve too. Ratios of ours over that of the peer; equal if the "
        "errors differ by less than 2 Monte Carlo errors.",
        case="error of",
        method="ours",
    )
    tables = [replace(study.results[0], folded=True) for study in studies.values()]
    others = [
        replace(results, title=f"{name.split()[0].capitalize()}: {results.title}")
        for name, study in studies.items()
        for results in study.results[1:]
    ]
    charts = [chart for study in studies.values() for chart in study.charts]
    every = [work for group in works.values() for work in group]
    return Study([best, beside, *tables, *others], charts, every)


def best_methods(works: Works) -> Scores:
    """Return the best of our methods and of the peers for each retrieval and quantity.

    Of methods whose errors differ by less than 2 Monte Carlo errors, the best is the fastest.
    """
    scores: Scores = {}
    for retrieval, every in works.items():
        for quantity in dict.fromkeys(work.quantity for work in every):
            group = [w for w in every if w.quantity == quantity and not w.informed]
            setting = drawn_setting([work.setting for work in group])
            for ours in (True, False):
                rivals = [work for work in group if work.ours is ours and work.setting == setting]
                if rivals:
                    best = _best(rivals)
                    scores[f"{retrieval}, {setting}: {quantity}", method_name(best)] = score_of(
                        best
                    )
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
    equal = abs(ratio - 1.0) < 2.0 * ratio * scatter
    accuracy = "equal error" if equal else "less accurate" if ratio > 1.0 else "more accurate"
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

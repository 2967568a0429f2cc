"""Error against run time of all retrievals, on one page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from benchmarks.accuracy import elastic, homogeneous, multiangle, network
from benchmarks.harness.figure import Figure, Score, Scores, Work
from benchmarks.harness.results import Effort, Results, Study


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
    beside = Results(
        "Ours beside the strongest peer",
        against_peers({name: study.works for name, study in studies.items()}),
        "All settings that peers solve too. Of methods whose errors differ by less than 2 Monte "
        "Carlo errors, the fastest; none that knows more than the profile. Ratios of ours over "
        "that of the peer; equal if the errors differ by less than 2 Monte Carlo errors.",
        case="error of",
        method="ours",
    )
    others = [
        replace(results, title=f"{name.split()[0].capitalize()}: {results.title}")
        for name, study in studies.items()
        for results in study.results[1:]
    ]
    tables = [study.results[0] for study in studies.values()]
    charts = [chart for study in studies.values() for chart in study.charts]
    works = [work for study in studies.values() for work in study.works]
    return Study([beside, *tables, *others], charts, works)


def against_peers(works: Mapping[str, Sequence[Work]]) -> Scores:
    """Return the most accurate of our methods beside that of the peers, in every setting.

    Parameters
    ----------
    works : mapping of sequences of Work
        By retrieval.
    """
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

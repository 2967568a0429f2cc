"""The stability benchmark: rates of false values without a flag."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.rows import Chapter, Results, Scores, Study, rows_of_scores, share_text
from lidarops.bench.stability import (
    random_elastic,
    random_homogeneous,
    random_networks,
    random_scans,
    random_signals,
)
from lidarops.bench.stability.random_scenes import (
    ALL,
    FALSE,
    FINE,
    SATISFIED,
    VIOLATED,
    VISIBLE,
    ScoredValues,
    Verdict,
    collect,
)
from lidarops.figures.wording import counted


@dataclass(frozen=True, slots=True)
class Draws:
    """Random scenes of one retrieval."""

    retrieval: str
    score: Callable[[int, int], Iterator[tuple[ScoredValues, int]]]
    """Returns the values of a cluster, given its number and the number of profiles."""
    profiles: int
    """Number per cluster and class; they share their geometry."""
    clusters: int
    quick: int
    """Number of clusters of a quick run."""
    needless: float
    """Largest share of needless flags where the model holds."""

    def score_cluster(self, cluster: int) -> Iterator[tuple[ScoredValues, int]]:
        """Return the values of a cluster."""
        return self.score(cluster, self.profiles)


DRAWS: Final = (
    Draws("homogeneous", random_homogeneous.score_homogeneous, 1000, 400, 15, 1e-3),
    Draws("signal chain", random_signals.score_signals, 50, 1500, 60, 0.05),
    Draws("elastic", random_elastic.score_elastic, 20, 1500, 40, 0.05),
    Draws("multi-angle", random_scans.score_scans, 8, 2000, 60, 0.13),
    Draws("scans of any and of calm air", random_scans.score_scan_methods, 8, 750, 40, 0.13),
    Draws("network", random_networks.score_networks, 50, 800, 30, 0.05),
)


def measure_stability(effort: Effort, draws: tuple[Draws, ...] = DRAWS) -> Study:
    """Return the rates of false values in random scenes.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    """
    chapters = []
    for draw in draws:
        clusters = draw.quick if effort.quick else draw.clusters
        tally = collect(draw.score_cluster, clusters, effort.progress)
        chapters.append(_chapter(draw.retrieval, tally.rates(draw.needless)))
    return Study("Stability: false values without a flag", effort.date, chapters)


_NOTE: Final = (
    "In brackets: Monte Carlo standard error in the last digits, from independently drawn "
    "geometries. Not rejected: no flag rejects the value. Not uncertain: no flag marks the stated "
    "error as uncertain. Undetectable: the misfit of the violation is below "
    f"{VISIBLE:g} standard deviations of the noise. Even the best test that knows the shape of the "
    "violation, but not its sign, misses 7 % or more of these at our rate of false alarms (half at "
    "3.5 deviations). The target applies to the rest, as a share of all. Share of the detectable: "
    "false values among those whose violation is detectable but raised no flag. Target, undecided: "
    "the share exceeds it by less than 2 Monte Carlo errors. Rejected but accurate: differs by "
    f"less than {FINE:g} errors. Needlessly flagged: flagged although the value can be determined."
)


def _chapter(name: str, scores: Scores) -> Chapter:
    scenes = max(
        int(str(score["scenes"])) for (_, failure), score in scores.items() if failure == ALL
    )
    return Chapter(
        f"False values: {name}",
        f"{counted(scenes, 'random scene')}. A value is false if it differs from the "
        f"truth by more than {FALSE:g} stated standard errors. Targets for values that no "
        f"flag rejects: {share_text(SATISFIED)} where the model holds, by random errors alone; "
        f"{share_text(VIOLATED)} elsewhere, with the stated systematic errors, excluding "
        "values that flags mark as uncertain and violations that no test can reliably "
        f"detect. {targets(scores)}",
        [
            Results(
                f"Values that differ by more than {FALSE:g} stated errors: {name}",
                rows_of_scores(scores),
                _NOTE,
                case="quantity",
                method="class",
            )
        ],
    )


def targets(scores: Scores) -> str:
    """Return which classes miss their targets, and for which that is undecided."""
    sentences = []
    for verdict, words in ((Verdict.MISSED, "Missed"), (Verdict.UNDECIDED, "Undecided")):
        names = [
            f"{failure} ({quantity})"
            for (quantity, failure), score in scores.items()
            if failure != ALL and verdict in str(score["target"])
        ]
        if names:
            sentences.append(f"{words}: {', '.join(names)}.")
    return " ".join(sentences) or "All targets are met."

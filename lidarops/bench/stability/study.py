"""The stability benchmark: rates of false values without a flag."""

from __future__ import annotations

from collections import Counter
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
    BROKEN,
    COVERED,
    FALSE,
    FINE,
    HELD,
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
    Draws("signal chain", random_signals.score_signals, 50, 1500, 400, 0.05),
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
    chapters, missed = [], []
    for draw in draws:
        clusters = draw.quick if effort.quick else draw.clusters
        scores = collect(draw.score_cluster, clusters, effort.progress).rates(draw.needless)
        chapters.append(_chapter(draw.retrieval, scores))
        missed += missed_targets(draw.retrieval, scores)
    return Study("Stability: false values without a flag", effort.date, chapters, missed=missed)


_NOTE: Final = (
    "In brackets: Monte Carlo standard error in the last digits, from independently drawn "
    "geometries. Not rejected: no flag rejects the value. Not uncertain: no flag marks the stated "
    f"error as uncertain. Within {COVERED:g}: values that are not rejected and within this number "
    "of stated random errors; 95 % for correct errors where the model holds. The target applies to "
    "everything drawn: to random errors alone where the model holds, else to values that are not "
    "uncertain, with the stated systematic errors. Undecided: the share exceeds it by less than "
    "2 Monte Carlo errors. Undetectable, which explains but does not excuse: the misfit of "
    f"the violation is below {VISIBLE:g} standard deviations of the noise. Even the best test that "
    "knows the shape of the violation, but not its sign, misses 7 % or more of these at our rate "
    "of false alarms (half at 3.5 deviations). Share of the detectable: false values among those "
    "whose violation is detectable but raised no flag. Rejected but accurate: differs by "
    f"less than {FINE:g} errors. Needlessly flagged: flagged although the value can be determined; "
    "extinction of a signal that dies within a bin is judged by the transmission of one bin."
)


def _chapter(name: str, scores: Scores) -> Chapter:
    drawn: Counter[str] = Counter()
    for (quantity, failure), score in scores.items():
        if failure in {HELD, BROKEN}:
            drawn[quantity] += int(str(score["scenes"]))
    return Chapter(
        f"False values: {name}",
        f"{counted(max(drawn.values()), 'random scene')}. A value is false if it differs from the "
        f"truth by more than {FALSE:g} stated standard errors. Targets for values that no "
        f"flag rejects: {share_text(SATISFIED)} where the model holds, by random errors alone; "
        f"{share_text(VIOLATED)} of everything drawn elsewhere, with the stated systematic errors, "
        f"excluding values that flags mark as uncertain. {targets(scores)}",
        [
            Results(
                results_title(name),
                rows_of_scores(scores),
                _NOTE,
                case="quantity",
                method="class",
            )
        ],
    )


def results_title(retrieval: str) -> str:
    """Return the title of the table of a retrieval."""
    return f"Values that differ by more than {FALSE:g} stated errors: {retrieval}"


def targets(scores: Scores) -> str:
    """Return which classes miss their targets, and for which that is undecided."""
    sentences = []
    for verdict, words in ((Verdict.MISSED, "Missed"), (Verdict.UNDECIDED, "Undecided")):
        names = [name for name, _ in _with_verdict(scores, verdict)]
        if names:
            sentences.append(f"{words}: {', '.join(names)}.")
    return " ".join(sentences) or "All targets are met."


def missed_targets(retrieval: str, scores: Scores) -> list[str]:
    """Return the classes whose share of false or needlessly flagged values is above the target."""
    return [
        f"{retrieval}: {name}, target {target}"
        for name, target in _with_verdict(scores, Verdict.MISSED)
    ]


def _with_verdict(scores: Scores, verdict: Verdict) -> Iterator[tuple[str, str]]:
    """Yield class and target where the verdict on a target is this one."""
    for (quantity, failure), score in scores.items():
        target = str(score["target"])
        if verdict in target:
            yield f"{failure} ({quantity})", target

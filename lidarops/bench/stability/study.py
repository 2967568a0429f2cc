"""The stability benchmark: rates of false values without a flag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.rows import (
    CPU_TIME,
    Chapter,
    Results,
    Scores,
    Study,
    cpu_time,
    rows_of_scores,
    share_text,
)
from lidarops.bench.harness.timing import cpu_seconds
from lidarops.bench.harness.verdicts import Verdict, unmet
from lidarops.bench.stability import (
    flag_rates,
    random_elastic,
    random_homogeneous,
    random_networks,
    random_raman,
    random_scans,
    random_sections,
    random_signals,
)
from lidarops.bench.stability.random_scenes import (
    BROKEN,
    COVERED,
    FALSE,
    FALSE_TARGET,
    FINE,
    HALF,
    HELD,
    SATISFIED,
    TARGETS,
    VIOLATED,
    VISIBLE,
    ScoredValues,
    collect,
)
from lidarops.bench.stability.reproducibility import measure_reproducibility
from lidarops.bench.stability.second_look import measure_second_look
from lidarops.figures.wording import counted

LONGEST: Final = 1200.0
"""s, most CPU time of the whole benchmark."""
COST: Final = "CPU time of the parts"
FLAGS: Final = "Flags of few photon counts, and bits that decide alone"
REPRODUCIBLE: Final = "Order of profiles, machine and work"
WHOLE: Final = "all parts"


@dataclass(frozen=True, slots=True)
class Draws:
    """Random scenes of one retrieval."""

    retrieval: str
    score: Callable[[int, int], Iterator[tuple[ScoredValues, int]]]
    """Returns the values of a cluster, given its number and the number of profiles."""
    profiles: int
    """Number per cluster and class; they share their geometry."""
    clusters: int
    """Enough to decide most targets, within the CPU time of all parts."""
    quick: int
    """Number of clusters of a quick run, which decides little."""
    needless: float | None = None
    """Largest share of needless flags where the model holds; None without a target."""
    pooled: bool = False
    """Whether to add the classes where the model holds together, and all others."""

    def score_cluster(self, cluster: int) -> Iterator[tuple[ScoredValues, int]]:
        """Return the values of a cluster."""
        return self.score(cluster, self.profiles)


def _blocks(draw_air: object, length: int, clusters: int) -> Draws:
    name = getattr(draw_air, "__name__", "")
    score = partial(random_networks.score_short_blocks, draw_air=draw_air, length=length)
    return Draws(f"networks, {name}, blocks of {length}", score, 6, clusters, 4)


def _scans(length: int) -> Draws:
    score = partial(random_scans.score_short_scans, length=length)
    return Draws(f"scans, blocks of {length}", score, 8, 400, 4)


DRAWS: Final = (
    Draws("homogeneous", random_homogeneous.score_homogeneous, 1000, 400, 4, 1e-3, pooled=True),
    Draws("signal chain", random_signals.score_signals, 50, 500, 20, 0.05, pooled=True),
    Draws("elastic", random_elastic.score_elastic, 20, 400, 6, 0.05, pooled=True),
    Draws("multi-angle", random_scans.score_scans, 8, 400, 6, 0.13, pooled=True),
    Draws("scans of any and of calm air", random_scans.score_scan_methods, 8, 400, 6, pooled=True),
    Draws("network", random_networks.score_networks, 50, 300, 4, 0.05, pooled=True),
    Draws("Raman", random_raman.score_raman, 8, 1000, 6, pooled=True),
    Draws("short sections", random_sections.score_short_sections, 300, 600, 6),
    Draws("correlated noise", random_sections.score_correlated_noise, 60, 400, 6),
    Draws("near the cut", random_sections.score_near_the_cut, 1000, 400, 6),
    Draws("dying signals", random_sections.score_dying_signals, 300, 2500, 6),
    Draws("quiet digitizers", random_signals.score_digitizers, 5, 60, 6),
    _scans(1),
    _scans(2),
    Draws("scans of photon counts", random_scans.score_counted_scans, 8, 250, 6),
    _blocks(random_networks.plume, 1, 2000),
    _blocks(random_networks.plume, 2, 1500),
    _blocks(random_networks.plume, 3, 1500),
    _blocks(random_networks.homogeneous, 1, 700),
    _blocks(random_networks.layered, 1, 1000),
    Draws("networks, varying lidar ratio", random_networks.score_lidar_ratios, 6, 200, 4),
)


def measure_stability(effort: Effort, draws: tuple[Draws, ...] = DRAWS) -> Study:
    """Return the rates of false values in random scenes, and what each part costs.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    """
    chapters, missed, costs = [], [], {}
    for draw in draws:
        begin = cpu_seconds()
        clusters = draw.quick if effort.quick else draw.clusters
        tally = collect(draw.score_cluster, clusters, effort.progress)
        scores = tally.rates(draw.needless, pooled=draw.pooled)
        chapters.append(_chapter(draw.retrieval, scores))
        missed += missed_targets(draw.retrieval, scores)
        costs[draw.retrieval] = cpu_seconds() - begin
    others, of_flags = _others(effort, costs)
    chapters += others
    missed += missed_targets("flags", of_flags)
    missed += missed_targets("cost", cost_scores(costs))
    return Study("Stability: false values without a flag", effort.date, chapters, missed=missed)


def _others(effort: Effort, costs: dict[str, float]) -> tuple[list[Chapter], Scores]:
    """Return the chapters without random scenes, and the scores of flags; add their costs."""
    begin = cpu_seconds()
    flags = flag_rates.flag_rates(2 if effort.quick else 60)
    costs["flags"] = cpu_seconds() - begin
    begin = cpu_seconds()
    sizes = (2, 1) if effort.quick else (60, 6)
    changes = measure_reproducibility(*sizes)
    changes |= measure_second_look(3 if effort.quick else 30)
    costs["order and machine"] = cpu_seconds() - begin
    return [
        Chapter(
            FLAGS,
            "How many profiles of few photon counts are flagged although the model holds, and how"
            " many values of homogeneous paths a single bit rejects.",
            [Results(FLAGS, rows_of_scores(flags), case="flag", method="condition")],
        ),
        Chapter(
            REPRODUCIBLE,
            "How far values change with the order of the profiles of a block, and with the kernel"
            " of linear algebra; how much of the solver's time its second look at the bins takes.",
            [Results(REPRODUCIBLE, rows_of_scores(changes), method="figure")],
        ),
        Chapter(
            COST,
            "CPU time with child processes and compilation.",
            [Results(COST, rows_of_scores(cost_scores(costs)), method="part")],
        ),
    ], flags


def cost_scores(costs: dict[str, float]) -> Scores:
    """Return the CPU times of the parts, s, and whether their sum is short enough."""
    total = sum(costs.values())
    verdict = Verdict.MET if total <= LONGEST else Verdict.MISSED
    scores: Scores = {
        ("", name): {CPU_TIME: cpu_time(1e9 * seconds), FALSE_TARGET: None}
        for name, seconds in costs.items()
    }
    target = f"{LONGEST / 60.0:g} min {verdict}"
    scores["", WHOLE] = {CPU_TIME: cpu_time(1e9 * total), FALSE_TARGET: target}
    return scores


_NOTE: Final = (
    "In brackets: Monte Carlo standard error in the last digits, from independently drawn "
    "geometries; with few events, half of the 95 % limit for as many independent values. Not "
    "rejected: no flag rejects the value. Not uncertain: no flag marks the stated error as "
    f"uncertain. Within {COVERED:g} and within 1: values that are not rejected and within this "
    "number of stated random errors; 95 % and 68 % for correct errors where the model holds. "
    "Stated / median error: 1.48 for correct errors. The target of false values applies to "
    "everything drawn: to random errors alone where the model holds, else to values that are not "
    "uncertain, with the stated systematic errors. A target is met or missed if 2 Monte Carlo "
    "errors do not change that, else undecided. Undetectable, which explains but does not excuse: "
    f"the misfit of the violation is below {VISIBLE:g} standard deviations of the noise. Even the "
    "best test that knows the shape of the violation, but not its sign, misses 7 % or more of "
    f"these at our rate of false alarms; half or more of those below {HALF:g}. Share of the "
    "detectable: false values among those whose violation is detectable but raised no flag. "
    f"Rejected but accurate: differs by less than {FINE:g} errors. Needlessly flagged: flagged "
    "although the value can be determined; extinction of a signal that dies within a bin is judged "
    "by the transmission of one bin; a value of a network, by its stated error. Own targets are "
    "ours, chosen after measuring."
)


def _chapter(name: str, scores: Scores) -> Chapter:
    drawn: Counter[str] = Counter()
    pooled = {HELD, BROKEN} & {failure for _, failure in scores}
    for (quantity, failure), score in scores.items():
        if failure in pooled or not pooled:
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
    """Return the classes with a share outside a target."""
    return [
        f"{retrieval}: {name}, {target}" for name, target in _with_verdict(scores, Verdict.MISSED)
    ]


def _with_verdict(scores: Scores, verdict: Verdict) -> Iterator[tuple[str, str]]:
    """Yield class and target where the verdict on a target is this one."""
    for (quantity, failure), score in scores.items():
        for target in TARGETS:
            if unmet(score.get(target)) is verdict:
                place = f" ({quantity})" if quantity else ""
                yield f"{failure}{place}", f"{target} {score[target]}"

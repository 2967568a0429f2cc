"""The stability benchmark: rates of false values without a flag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from benchmarks.harness.benchmark import Effort
from benchmarks.harness.figure import cpu_time, share_text
from benchmarks.harness.rows import CPU_TIME, Scores, rows_of_scores
from benchmarks.harness.study import Chapter, Results, Study
from benchmarks.harness.timing import cpu_seconds
from benchmarks.harness.verdicts import Judgement, Verdict
from benchmarks.stability import (
    flag_rates,
    random_elastic,
    random_homogeneous,
    random_networks,
    random_raman,
    random_scans,
    random_sections,
    random_signals,
)
from benchmarks.stability.random_scenes import (
    BROKEN,
    COVERED,
    FALSE,
    FINE,
    HALF,
    HELD,
    SATISFIED,
    TARGET,
    TARGETS,
    VIOLATED,
    VISIBLE,
    ScoredValues,
    collect,
)
from benchmarks.stability.reasons import Unmet, read_reasons, why
from benchmarks.stability.reproducibility import measure_reproducibility
from lidarops.errors import CampaignError
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
    case: str
    """Name by which the command runs this part with others."""
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


def _blocks(
    draw_air: random_networks.DrawAir, air: str, length: int, clusters: int, profiles: int = 6
) -> Draws:
    name = f"{air}, blocks of {length}"
    score = partial(random_networks.score_short_blocks, draw_air=draw_air, name=name, length=length)
    return Draws(f"networks, {name}", "network", score, profiles, clusters, 4)


def _scans(length: int) -> Draws:
    score = partial(random_scans.score_short_scans, length=length)
    return Draws(f"scans, blocks of {length}", "multiangle", score, 8, 400, 4)


DRAWS: Final = (
    Draws(
        "homogeneous",
        "homogeneous",
        random_homogeneous.score_homogeneous,
        1000,
        400,
        4,
        1e-3,
        pooled=True,
    ),
    Draws("signal chain", "signal", random_signals.score_signals, 50, 500, 20, 0.05, pooled=True),
    Draws("elastic", "elastic", random_elastic.score_elastic, 20, 400, 6, 0.05, pooled=True),
    Draws("multi-angle", "multiangle", random_scans.score_scans, 8, 400, 6, 0.13, pooled=True),
    Draws(
        "scans of any and of calm air",
        "multiangle",
        random_scans.score_scan_methods,
        8,
        400,
        6,
        pooled=True,
    ),
    Draws(
        "network",
        "network",
        partial(random_networks.score_networks, of_all=300),
        50,
        700,
        4,
        0.05,
        pooled=True,
    ),
    Draws("Raman", "raman", random_raman.score_raman, 8, 500, 6, pooled=True),
    Draws("short sections", "homogeneous", random_sections.score_short_sections, 300, 600, 6),
    Draws("correlated noise", "homogeneous", random_sections.score_correlated_noise, 60, 400, 6),
    Draws("near the cut", "homogeneous", random_sections.score_near_the_cut, 1000, 400, 6),
    Draws("dying signals", "homogeneous", random_sections.score_dying_signals, 300, 2500, 6),
    Draws("quiet digitizers", "signal", random_signals.score_digitizers, 5, 60, 6),
    _scans(1),
    _scans(2),
    Draws("scans of photon counts", "multiangle", random_scans.score_counted_scans, 8, 250, 6),
    _blocks(random_networks.plume, "plume", 1, 2000),
    _blocks(random_networks.plume, "plume", 2, 1500),
    _blocks(random_networks.plume, "plume", 3, 1500),
    _blocks(random_networks.homogeneous, "homogeneous", 1, 2000, 3),
    _blocks(random_networks.layered, "layered", 1, 2500, 3),
    Draws(
        "networks, varying lidar ratio", "network", random_networks.score_lidar_ratios, 6, 200, 4
    ),
)


def measure_stability(
    effort: Effort, draws: tuple[Draws, ...] = DRAWS, case: str | None = None
) -> Study:
    """Return the rates of false values in random scenes, and what each part costs.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    case : str, optional
        Only parts of this case, or the part of this name; None for all.

    Raises
    ------
    CampaignError
        If no part has this case or name.
    """
    selected = [draw for draw in draws if case in {None, draw.case, draw.retrieval}]
    others = [other for other in OTHERS if case in {None, other.case}]
    if not selected and not others:
        names = dict.fromkeys([draw.case for draw in draws] + [other.case for other in OTHERS])
        raise CampaignError(
            f"no case {case!r}",
            remedy=f"choose: {' or '.join(names)}, or a part such as {draws[-1].retrieval!r}",
        )
    chapters: list[Chapter] = []
    targets_unmet: list[Unmet] = []
    costs: dict[str, float] = {}
    for draw in selected:
        begin = cpu_seconds()
        clusters = draw.quick if effort.quick else draw.clusters
        tally = collect(draw.score_cluster, clusters, effort.progress)
        scores = tally.rates(draw.needless, pooled=draw.pooled)
        chapters.append(_chapter(draw.retrieval, scores))
        targets_unmet += unmet_targets(draw.retrieval, scores)
        costs[draw.retrieval] = cpu_seconds() - begin
    for other in others:
        begin = cpu_seconds()
        scores = other.measure(effort)
        chapters.append(other.chapter(scores))
        targets_unmet += unmet_targets(other.title, scores)
        costs[other.name] = cpu_seconds() - begin
    of_cost = cost_scores(costs, whole=case is None)
    chapters.append(
        Chapter(
            COST,
            "CPU time with child processes and compilation.",
            [Results(COST, rows_of_scores(of_cost), method="part")],
        )
    )
    targets_unmet += unmet_targets(COST, of_cost)
    missed = [one for one in targets_unmet if one.judgement.verdict is Verdict.MISSED]
    reasons = read_reasons()
    return Study(
        "Stability: false values without a flag", effort.date, chapters,
        missed=[str(one) for one in missed],
        unnamed=[str(one) for one in missed if reasons and not why(one, reasons)],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Other:
    """A part without random scenes."""

    case: str
    name: str
    title: str
    text: str
    measure: Callable[[Effort], Scores]
    line: str
    """Heading of the column of cases."""
    method: str
    """Heading of the column of methods."""

    def chapter(self, scores: Scores) -> Chapter:
        """Return the table of the part."""
        rows = rows_of_scores(scores)
        results = Results(self.title, rows, case=self.line, method=self.method)
        return Chapter(self.title, self.text, [results])


def _flag_scores(effort: Effort) -> Scores:
    return flag_rates.flag_rates(2 if effort.quick else 60)


def _order_scores(effort: Effort) -> Scores:
    return measure_reproducibility(*((2, 1) if effort.quick else (60, 6)))


OTHERS: Final = (
    _Other(
        "flags",
        "flags",
        FLAGS,
        "How many profiles of few photon counts are flagged although the model holds, and how"
        " many values of homogeneous paths a single bit rejects.",
        _flag_scores,
        "flag",
        "condition",
    ),
    _Other(
        "order",
        "order and machine",
        REPRODUCIBLE,
        "How far values change with the order of the profiles of a block, and with the kernel of "
        "linear algebra.",
        _order_scores,
        "case",
        "figure",
    ),
)


def cost_scores(costs: dict[str, float], *, whole: bool = True) -> Scores:
    """Return the CPU times of the parts, s, and whether the sum of all parts is short enough."""
    total = sum(costs.values())
    verdict = Verdict.MET if total <= LONGEST else Verdict.MISSED
    scores: Scores = {
        ("", name): {CPU_TIME: cpu_time(1e9 * seconds), TARGET: None}
        for name, seconds in costs.items()
    }
    target = Judgement(f"{LONGEST / 60.0:g} min", verdict)
    if whole:
        scores["", WHOLE] = {CPU_TIME: cpu_time(1e9 * total), TARGET: target}
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
    targets_unmet = unmet_targets("", scores)
    sentences = []
    for verdict, words in ((Verdict.MISSED, "Missed"), (Verdict.UNDECIDED, "Undecided")):
        names = [one.place for one in targets_unmet if one.judgement.verdict is verdict]
        if names:
            sentences.append(f"{words}: {', '.join(names)}.")
    return " ".join(sentences) or "All targets are met."


def unmet_targets(part: str, scores: Scores) -> list[Unmet]:
    """Return the targets of a part that are missed or undecided."""
    return [
        Unmet(part, quantity, name, target, judgement)
        for (quantity, name), score in scores.items()
        for target in TARGETS
        if isinstance(judgement := score.get(target), Judgement) and not judgement.met
    ]

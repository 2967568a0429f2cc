"""The stability benchmark: rates of false values without a flag."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

from benchmarks.harness import figure, rates
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.scenes import (
    elastic_skies,
    homogeneous_paths,
    lidar_networks,
    raman_skies,
    recorded_signals,
    scans,
)

LONGEST: Final = 1200.0
"""s, most CPU time of the whole benchmark."""
COST: Final = "CPU time of the parts"
FLAGS: Final = "Flags of few photon counts"
LIGHT: Final = "Profiles without light of the laser"
DEAD_TIMES: Final = "Estimated dead times that are missing or differ by more than 2 stated errors"
WHOLE: Final = "all parts"
_NOTE: Final = (
    f"A value is false if it differs from the truth by more than {rates.FALSE:g} stated standard "
    f"errors. Targets for values that no flag rejects: {figure.share_text(rates.SATISFIED)} where "
    f"the model holds, by random errors alone; {figure.share_text(rates.VIOLATED)} of everything "
    "drawn elsewhere, with the stated systematic errors, excluding values that flags mark as "
    "uncertain. In brackets: Monte Carlo standard error in the last digits, from independently "
    "drawn geometries; with few events, half of the 95 % limit for as many independent values. "
    "Not rejected: no flag rejects the value. Not uncertain: no flag marks the stated error as "
    f"uncertain. Within {rates.COVERED:g} and within 1: values that are not rejected and within "
    "this number of stated random errors; 95 % and 68 % for correct errors where the model "
    "holds. Stated / median error: 1.48 for correct errors. A target is met or missed if 2 Monte "
    "Carlo errors do not change that, else undecided. Undetectable, which explains but does not "
    f"excuse: the misfit of the violation is below {rates.VISIBLE:g} standard deviations of the "
    "noise. Even the best test that knows the shape of the violation, but not its sign, misses 7 "
    f"% or more of these at our rate of false alarms; half or more of those below {rates.HALF:g}. "
    "Needlessly flagged: flagged although the value can be determined; extinction of a signal "
    "that dies within a bin is judged by the transmission of one bin; a value of a network or of "
    "Raman signals, by its stated error. Own targets are ours, chosen after measuring."
)


@dataclass(frozen=True, slots=True)
class Draws:
    """Random scenes of one retrieval."""

    name: str
    case: str
    """Name by which the command runs this part with others."""
    score: Callable[[int, int], Iterator[rates.ScoredValues]]
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

    @property
    def title(self) -> str:
        """Title of the table."""
        return f"Values that differ by more than {rates.FALSE:g} stated errors: {self.name}"

    def measure(self, effort: Effort) -> Results:
        """Return the rates of false values."""
        clusters = self.quick if effort.quick else self.clusters
        counted = rates.collect(lambda k: self.score(k, self.profiles), clusters, effort.progress)
        scores = rates.rates(counted, self.needless, pooled=self.pooled)
        return Results(self.title, scores, _NOTE, case="quantity", method="class")


@dataclass(frozen=True, slots=True)
class Other:
    """A part without random scenes."""

    name: str
    case: str
    title: str
    score: Callable[[bool], figure.Scores]
    """Returns the scores, given whether the run is quick."""
    columns: tuple[str, str]
    """Headings of the columns of cases and methods."""

    def measure(self, effort: Effort) -> Results:
        """Return the scores."""
        return Results(self.title, self.score(effort.quick), "", *self.columns)


def _blocks(
    draw_air: lidar_networks.DrawAir, air: str, length: int, clusters: int, profiles: int = 6
) -> Draws:
    name = f"{air}, blocks of {length}"
    score = partial(lidar_networks.score_short_blocks, draw_air=draw_air, name=name, length=length)
    return Draws(f"networks, {name}", "network", score, profiles, clusters, 4)


def _scans(length: int) -> Draws:
    score = partial(scans.score_short_scans, length=length)
    return Draws(f"scans, blocks of {length}", "multiangle", score, 8, 400, 4)


_paths, _scanned, _networks = homogeneous_paths, scans, lidar_networks
DRAWS: Final = (
    Draws("homogeneous", "homogeneous", _paths.score_homogeneous, 1000, 400, 4, 1e-3, pooled=True),
    Draws("signal chain", "signal", recorded_signals.score_signals, 50, 500, 20, 0.05, pooled=True),
    Draws("elastic", "elastic", elastic_skies.score_elastic, 20, 400, 6, 0.05, pooled=True),
    Draws("multi-angle", "multiangle", _scanned.score_scans, 8, 400, 6, 0.13, pooled=True),
    Draws("network", "network", partial(_networks.score_networks, of_all=300), 50, 700, 4, 0.05,
          pooled=True),
    Draws("Raman", "raman", raman_skies.score_raman, 8, 500, 6, 0.05, pooled=True),
    Draws("short sections", "homogeneous", _paths.score_short_sections, 300, 600, 6),
    Draws("correlated noise", "homogeneous", _paths.score_correlated_noise, 60, 400, 6),
    Draws("near the cut", "homogeneous", _paths.score_near_the_cut, 1000, 400, 6),
    Draws("dying signals", "homogeneous", _paths.score_dying_signals, 300, 2500, 6),
    Draws("quiet digitizers", "signal", recorded_signals.score_digitizers, 5, 60, 6),
    _scans(1),
    _scans(2),
    Draws("scans of photon counts", "multiangle", _scanned.score_counted_scans, 8, 250, 6),
    _blocks(_networks.plume, "plume", 1, 2000),
    _blocks(_networks.plume, "plume", 2, 1500),
    _blocks(_networks.plume, "plume", 3, 1500),
    _blocks(_networks.homogeneous, "homogeneous", 1, 2000, 3),
    _blocks(_networks.layered, "layered", 1, 2500, 3),
    Draws("networks, varying lidar ratio", "network", _networks.score_lidar_ratios, 6, 600, 4),
)  # fmt: skip
OTHERS: Final = (
    Other("flags", "flags", FLAGS,
          lambda quick: homogeneous_paths.few_count_scores(2 if quick else 60),
          ("flag", "condition")),
    Other("dead times", "signal", DEAD_TIMES,
          lambda quick: recorded_signals.dead_time_scores(2 if quick else 310),
          ("record", "scene")),
    Other("light", "light", LIGHT,
          lambda quick: recorded_signals.light_scores(10 if quick else 200),
          ("profiles", "condition")),
)  # fmt: skip


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
    """
    results: list[Results] = []
    unmet: list[rates.Unmet] = []
    costs: dict[str, float] = {}
    parts: tuple[Draws | Other, ...] = (*draws, *OTHERS)
    for part in parts:
        if case in {None, part.case, part.name}:
            begin = figure.cpu_seconds()
            results.append(part.measure(effort))
            unmet += unmet_targets(part.title.rpartition(": ")[2], results[-1].scores)
            costs[part.name] = figure.cpu_seconds() - begin
    of_cost = cost_scores(costs, whole=case is None)
    note = "CPU time with child processes and compilation."
    results.append(Results(COST, of_cost, note, method="part"))
    unmet += unmet_targets(COST, of_cost)
    missed = [str(one) for one in unmet if one.judgement.verdict is figure.Verdict.MISSED]
    return Study(results, missed=missed)


CASES: Final[dict[str, Callable[[Effort], Study]]] = {
    "all": measure_stability,
    **{part.case: partial(measure_stability, case=part.case) for part in (*DRAWS, *OTHERS)},
    **{part.name: partial(measure_stability, case=part.name) for part in (*DRAWS, *OTHERS)},
}
"""The benchmark of all parts, of those of a case, and of each."""


def cost_scores(costs: Mapping[str, float], *, whole: bool = True) -> figure.Scores:
    """Return the CPU times of the parts, s, and whether the sum of all parts is short enough."""
    total = sum(costs.values())
    scores: figure.Scores = {
        ("", name): {figure.CPU_TIME: figure.cpu_time(1e9 * seconds), rates.TARGET: None}
        for name, seconds in costs.items()
    }
    if whole:
        verdict = figure.Verdict.MET if total <= LONGEST else figure.Verdict.MISSED
        target = figure.Judgement(f"{LONGEST / 60.0:g} min", verdict)
        scores["", WHOLE] = {figure.CPU_TIME: figure.cpu_time(1e9 * total), rates.TARGET: target}
    return scores


def unmet_targets(part: str, scores: figure.Scores) -> list[rates.Unmet]:
    """Return the targets of a part that are missed or undecided."""
    return [
        rates.Unmet(part, quantity, name, target, judgement)
        for (quantity, name), score in scores.items()
        for target in rates.TARGETS
        if isinstance(judgement := score.get(target), figure.Judgement) and not judgement.met
    ]

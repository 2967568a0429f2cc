"""Error against run time of all retrievals, on one page."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.accuracy import elastic, homogeneous, multiangle, network
from benchmarks.harness.benchmark import Effort
from benchmarks.harness.charts import error_against_time
from benchmarks.harness.drawing import Chart
from benchmarks.harness.figure import Figure, cpu_time, share
from benchmarks.harness.rows import CPU_TIME, Row, Score, Scores, rows_of, rows_of_scores
from benchmarks.harness.study import Chapter, Results, Study, Work
from benchmarks.harness.timing import least_times

_PROFILES: Final = 500
_BINS: Final = 4096
_CHANNELS: Final = 12
_ROUNDS: Final = 9
_RMSE: Final = "RMSE"
STRONGEST: Final = "Ours beside the strongest peer"
_SHOWN: Final = frozenset({"background of 100000 counts", "3 x 2 beams, plume, noise 5 %"})
"""Settings shown for a retrieval, if not its first."""


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


def _minimal_operations() -> Scores:
    profiles = np.random.default_rng(0).random((_PROFILES, _BINS), np.float32)
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        file = Path(folder) / "counts"
        file.write_bytes(np.zeros((_CHANNELS, _BINS), np.int32).tobytes())
        times = least_times({"memory": lambda: np.max(profiles), "file": file.read_bytes}, _ROUNDS)
    memory = f"read a profile of {_BINS} float32 in memory (np.max)"
    files = f"read a file of {_CHANNELS} channels of {_BINS} bins from the page cache"
    return {
        ("", memory): {CPU_TIME: cpu_time(1e9 * times["memory"] / _PROFILES)},
        ("", files): {CPU_TIME: cpu_time(1e9 * times["file"])},
    }


def _overview(works: Mapping[str, Sequence[Work]]) -> Chapter:
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
            Results(
                "Minimal operations, measured in the same run",
                rows_of_scores(_minimal_operations()),
                method="operation",
            ),
            *(
                Results(
                    f"{retrieval.capitalize()}: all methods",
                    [
                        row
                        for work in group
                        for row in _rows(work, f"{work.quantity}; {work.setting}")
                    ],
                    case="error of",
                    folded=True,
                )
                for retrieval, group in works.items()
            ),
        ],
        [_chart(retrieval, group) for retrieval, group in works.items()],
    )


def _rows(work: Work, case: str) -> list[Row]:
    method = work.method if work.ours else f"peer: {work.method}"
    coverage = None if work.coverage is None else share(work.coverage)
    return rows_of(case, method, {_RMSE: work.error, "95 %": coverage, CPU_TIME: work.time})


def _shown(settings: Sequence[str]) -> str:
    return next((setting for setting in settings if setting in _SHOWN), settings[0])


def best_methods(works: Mapping[str, Sequence[Work]]) -> list[Row]:
    """Return the best of our methods and of the peers for each retrieval and quantity.

    Of methods whose errors differ by less than 2 Monte Carlo errors, the best is the fastest.
    """
    rows: list[Row] = []
    for retrieval, every in works.items():
        for quantity in dict.fromkeys(work.quantity for work in every):
            group = [w for w in every if w.quantity == quantity and not w.informed]
            setting = _shown([work.setting for work in group])
            for ours in (True, False):
                rivals = [work for work in group if work.ours is ours and work.setting == setting]
                if rivals:
                    rows += _rows(_best(rivals), f"{retrieval}, {setting}: {quantity}")
    return rows


def against_peers(works: Mapping[str, Sequence[Work]]) -> list[Row]:
    """Return the most accurate of our methods beside that of the peers, in every setting."""
    rows: list[Row] = []
    for retrieval, every in works.items():
        settings = dict.fromkeys((work.quantity, work.setting) for work in every)
        for quantity, setting in settings:
            group = [
                work
                for work in every
                if (work.quantity, work.setting) == (quantity, setting) and not work.informed
            ]
            ours, peers = ([work for work in group if work.ours is of] for of in (True, False))
            if ours and peers:
                best, peer = _best(ours), _best(peers)
                rows += rows_of(
                    f"{retrieval}, {setting}: {quantity}", best.method, _beside(best, peer)
                )
    return rows


def _beside(ours: Work, peer: Work) -> Score:
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
    settings = list(dict.fromkeys(work.setting for work in drawn))
    last = _shown(settings)
    chosen = {settings[0], last if last != settings[0] else settings[-1]}
    chart = error_against_time(
        "all-" + retrieval.replace(" ", "-"),
        [
            row
            for work in drawn
            if work.setting in chosen
            for row in rows_of(work.setting, work.method, {_RMSE: work.error, CPU_TIME: work.time})
        ],
        _RMSE,
        hollow={work.method for work in drawn if not work.ours or work.informed},
        gain=1.0,
    )
    return replace(chart, title=f"{retrieval.capitalize()}: RMSE of {quantity} against CPU time")

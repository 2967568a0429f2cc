"""The page of all retrievals: complete, without name clashes, with the results of its parts."""

from __future__ import annotations

from functools import partial

import pytest

from lidarops.bench import all_retrievals, overview, registry
from lidarops.bench.accuracy import (
    elastic,
    homogeneous,
    multiangle_cases,
    multiangle_scores,
    network,
)
from lidarops.bench.accuracy.multiangle_scores import StudySize
from lidarops.bench.harness import results, rows
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.rows import MonteCarloFigure

SMALL = StudySize(blocks=2, profiles=4, slow=1, published=20, random=4)


@pytest.fixture(scope="module")
def output():
    """Return the output for few profiles."""
    steps = []
    small = {
        (homogeneous, "measure_homogeneous"): partial(homogeneous.measure_homogeneous, profiles=64),
        (elastic, "measure_elastic_accuracy"): partial(elastic.measure_elastic_accuracy, draws=4),
        (multiangle_scores, "measure_multiangle"): partial(
            multiangle_scores.measure_multiangle, size=SMALL
        ),
        (network, "measure_network"): partial(
            network.measure_network, profiles=25, peer_profiles=4
        ),
    }
    with pytest.MonkeyPatch.context() as patch:
        for (module, name), measure in small.items():
            patch.setattr(module, name, measure)
        scenes = (multiangle_cases.clear(3000.0, bins=25), multiangle_cases.cloud())
        patch.setattr(multiangle_cases, "scan_scenes", lambda: scenes)
        effort = Effort(quick=True, repeats=1, date="2024-01-01", progress=steps.append)
        result = registry.run_benchmark("accuracy", None, [], effort)
    assert len(steps) > 40
    return result


def test_every_retrieval_has_our_methods_and_peers(output):
    works = output.result.works
    for retrieval in (overview.HOMOGENEOUS, overview.ELASTIC, overview.SCANS, overview.NETWORKS):
        works_of_retrieval = [work for work in works if work.retrieval == retrieval]
        assert {work.ours for work in works_of_retrieval} == {True, False}, retrieval
        assert all(work.nanoseconds > 0 and work.error.value > 0 for work in works_of_retrieval)


def test_rows_hold_the_figures_of_the_retrievals(output):
    works = {(w.setting, w.quantity, w.method): w for w in output.result.works}
    scene = output.result.multiangle.scenes[0]
    score = next(score for score in scene.scores if score.method == "joint")
    row = works[scene.label, "optical depth", "joint"]
    assert (row.error, row.nanoseconds) == (score.rmse, score.nanoseconds)
    case = output.result.network.cases[0]
    method, networked = next(iter(case.scores.items()))
    networks = [
        w for w in output.result.works if w.retrieval == overview.NETWORKS and w.method == method
    ]
    assert networks[0].nanoseconds == pytest.approx(1e3 * networked.microseconds)
    assert networks[0].error == networked.rmse


def test_the_first_table_shows_the_best_method_without_prior_knowledge(output):
    table = overview.best_methods(output.result.works)
    methods = [row[1] for row in table.rows]
    assert any(method.startswith("peer: ") for method in methods)
    names = [method.removeprefix("known_shape") for method in methods]
    assert not any("known_" in name or "from 6 km" in name for name in names)
    scans = [work for work in output.result.works if work.retrieval == overview.SCANS]
    first = [work for work in scans if work.setting == scans[0].setting and work.ours]
    best = min(first, key=lambda work: work.error.value)
    shown_methods = [row[1] for row in table.rows if row[0].startswith(overview.SCANS)]
    (shown,) = (work for work in first if work.method in shown_methods)
    assert shown.error.value <= best.error.value + 3.0 * (shown.error.error + best.error.error)
    assert shown.nanoseconds <= best.nanoseconds


def test_of_equally_accurate_methods_the_first_table_shows_the_fastest():
    def work(method: str, error: float, nanoseconds: float) -> overview.WorkPrecision:
        measured = MonteCarloFigure(error, 0.01)
        return overview.WorkPrecision(
            "paths", "all", "extinction", method, ours=True, error=measured, coverage=None,
            nanoseconds=nanoseconds,
        )  # fmt: skip

    works = [work("slow", 1.0, 90.0), work("fast", 1.02, 9.0), work("rough", 1.2, 1.0)]
    ((method, *_),) = overview.best_methods(works).rows
    assert method == "fast"


def test_page_and_figures_are_written_once_each(output, tmp_path):
    page = registry.write_benchmark(output, tmp_path)
    text = page.read_text(encoding="utf-8")
    titles = [chapter.title for chapter in output.report.parts]
    charts = [chart.name for chapter in output.report.parts for chart in chapter.charts]
    assert len(set(titles)) == len(titles)
    assert len(set(charts)) == len(charts)
    assert all(f"{name}.svg" in text and (tmp_path / f"{name}.svg").is_file() for name in charts)
    assert "http://" not in text
    assert "https://" not in text
    read = results.load(all_retrievals.AllRetrievals, tmp_path / "result.json")
    assert read.works == output.result.works


def test_minimal_operations_are_measured(output):
    assert [floor.nanoseconds > 0 for floor in output.result.baselines] == [True, True]


@pytest.mark.parametrize(
    ("nanoseconds", "text"), [(3.21, "3.21 ns"), (4.2e3, "4.2 µs"), (5e6, "5 ms"), (2e9, "2 s")]
)
def test_times_have_a_suitable_unit(nanoseconds, text):
    assert rows.format_time(nanoseconds) == text

"""The page of all retrievals: complete, without name clashes, with the results of its parts."""

from __future__ import annotations

from functools import partial

import pytest

from benchmarks.__main__ import measure_all
from benchmarks.accuracy import comparison, elastic, homogeneous, multiangle, network
from benchmarks.harness.figure import Figure, Work, cpu_time
from benchmarks.harness.results import Effort
from benchmarks.scenes import scans

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def study():
    """Return the study of few profiles."""
    steps = []
    small = {
        (homogeneous, "measure_homogeneous"): {"profiles": 64},
        (elastic, "measure_elastic_accuracy"): {"draws": 4},
        (multiangle, "measure_multiangle"): {"blocks": 2, "profiles": 4},
        (network, "measure_network"): {"profiles": 25, "peer_profiles": 4},
    }
    with pytest.MonkeyPatch.context() as patch:
        for (module, name), size in small.items():
            patch.setattr(module, name, partial(getattr(module, name), **size))
        scenes = (scans.clear(3000.0, bins=25), scans.cloud())
        patch.setattr(scans, "scan_scenes", lambda: scenes)
        effort = Effort(quick=True, progress=steps.append)
        result = measure_all(effort)
    assert len(steps) == 20
    return result


def _all_methods(study, retrieval):
    return study.figures(f"{retrieval.capitalize()}: all methods")


@pytest.mark.parametrize(
    "retrieval", ["homogeneous path", "elastic inversion", "scans over zenith angle"]
)
def test_every_retrieval_has_our_methods_and_peers(study, retrieval):
    rows = _all_methods(study, retrieval)
    methods = {method for _, method, _ in rows}
    assert {method.startswith("peer: ") for method in methods} == {True, False}
    assert all(row.value > 0 for (_, _, name), row in rows.items() if name == "RMSE")


def test_rows_hold_the_figures_of_the_retrievals(study):
    rows = _all_methods(study, "scans over zenith angle")
    scene = scans.clear(3000.0).label
    (joint,) = (work for work in study.works if (work.setting, work.method) == (scene, "joint"))
    compared = rows[f"optical depth; {scene}", "joint", "RMSE"]
    assert (compared.value, compared.error) == (joint.error.value, joint.error.error)


def test_of_equally_accurate_methods_the_fastest_is_compared_and_none_that_knows_more():
    def work(method: str, error: float, nanoseconds: float, **more: bool) -> Work:
        time = cpu_time(nanoseconds)
        return Work("all", "extinction", method, Figure(error, 0.01), None, time, **more)

    works = [
        work("slow", 1.0, 90.0), work("fast", 1.02, 9.0), work("rough", 1.2, 1.0),
        work("informed", 0.5, 1.0, informed=True), work("peer", 1.0, 5.0, ours=False),
    ]  # fmt: skip
    assert {name for _, name in comparison.against_peers({"paths": works})} == {"fast"}


def test_where_a_peer_is_ahead_the_table_says_so():
    def work(method: str, error: float, nanoseconds: float, *, ours: bool = True) -> Work:
        time = cpu_time(nanoseconds)
        return Work("all", "depth", method, Figure(error, 0.02), None, time, ours=ours)

    def beside(*works: Work) -> dict[str, object]:
        return next(iter(comparison.against_peers({"x": works}).values()), {})

    ours, peer = work("ours", 1.0, 50.0), work("peer", 1.02, 10.0, ours=False)
    row = beside(ours, peer)
    assert row["ours is"] == "equal error, slower"
    assert row["time, ratio"] == pytest.approx(5.0)
    assert beside(ours, work("peer", 0.8, 60.0, ours=False))["ours is"] == "less accurate, faster"
    assert beside(ours, work("peer", 1.4, 60.0, ours=False))["ours is"] == "more accurate, faster"
    assert beside(ours) == {}


def test_tables_and_figures_are_written_once_each(study, tmp_path):
    study.write(tmp_path)
    charts = [chart.name for chart in study.charts]
    tables = [results.title for results in study.results]
    assert len(set(charts)) == len(charts)
    assert len(set(tables)) == len(tables)
    assert all((tmp_path / f"{name}.svg").is_file() for name in charts)

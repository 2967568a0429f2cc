"""Rows of results: text of values, tables and charts."""

from __future__ import annotations

import json

import pytest

from benchmarks.harness.charts import error_against_time, panel
from benchmarks.harness.figure import Figure, Unit, cpu_time, share, with_error
from benchmarks.harness.rows import CPU_TIME, Row, by_method, rows_of_scores
from benchmarks.harness.study import Chapter, Results, Study
from benchmarks.harness.tables import table
from lidarops.errors import CatalogError


def results():
    return rows_of_scores(
        {
            (case, method): {
                "profiles": 20,
                "RMSE": rmse,
                "95 %": coverage,
                CPU_TIME: cpu_time(time),
            }
            for case, method, rmse, coverage, time in (
                ("clear", "ours", Figure(2e-3, 1e-4).times(1e3), share(Figure(0.95, 0.004)), 3e3),
                ("clear", "peer", Figure(1e-3, 1e-4).times(1e3), None, 5e6),
                ("cloud", "peer", Figure(4e3), None, 1e3),
            )
        }
    )


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (2.0817, 0.019, "2.08(2)"),
        (-0.0126, 0.0009, "-0.0126(9)"),
        (51.2, 12.0, "51(12)"),
        (-22.4, 1.6, "-22(2)"),
        (2.737, 0.0, "2.74"),
        (2.737, 1e-16, "2.74"),
        (12345.6, 0.0, "12,346"),
        (-0.00001, 0.0005, "0.0000(5)"),
    ],
)
def test_errors_are_given_in_units_of_the_last_digit(value, error, text):
    assert with_error(value, error) == text


def test_a_table_has_a_line_for_each_case_and_method():
    whole = table("Scores", results(), "A note.", case="air")
    assert whole.columns == ("air", "method", "profiles", "RMSE", "95 %", CPU_TIME)
    assert whole.rows == (
        ("clear", "ours", "20", "2.0(1)", "95.0(4) %", "3 µs"),
        ("clear", "peer", "20", "1.0(1)", "-", "5 ms"),
        ("cloud", "peer", "20", "4,000", "-", "1 µs"),
    )
    assert table("Scores", results()[:8]).columns[0] == "method"
    assert table("Scores", results()[4:]).columns[0] == "case"
    turned = table("Scores", by_method(results(), "RMSE"), method="case")
    assert turned.columns == ("case", "ours", "peer")
    assert turned.rows == (("clear", "2.0(1)", "1.0(1)"), ("cloud", "-", "4,000"))


@pytest.mark.parametrize(
    ("share", "text"), [(0.9996, ">99.9 %"), (1.0, "100 %"), (0.0, "0 %"), (3e-5, "0.003 %")]
)
def test_only_a_share_of_1_is_100_percent(share, text):
    (line,) = table("Shares", [Row("", "m", "share", share, unit=Unit.SHARE)]).rows
    assert line == ("m", text)


def test_a_chart_has_the_same_series_in_all_panels():
    drawn = error_against_time("work", results(), "RMSE", hollow={"peer"})
    clear, cloud = drawn.panels
    assert [series.label for series in cloud.series] == ["ours", "peer"]
    assert cloud.series[0].x == ()
    ours, peer = clear.series
    assert (ours.x, ours.y) == ((3.0,), (2.0,))
    assert (*ours.low, *ours.high) == pytest.approx((1.8, 2.2))
    assert (peer.hollow, ours.hollow) == (True, False)
    assert clear.front == ((3.0, 2.0),)
    assert (clear.y_label, cloud.y_label) == ("RMSE", "")
    assert clear.x_label == "CPU time (µs)"


def test_cases_that_are_numbers_are_an_axis():
    rows = [Row(f"{size}", "m", name, size * 2.0) for size in (1, 10) for name in ("a", "b")]
    along = panel("", rows, ("a", "b"), x="number of files", joined=True)
    assert [(s.label, s.x, s.y) for s in along.series] == [
        ("a", (1.0, 10.0), (2.0, 20.0)),
        ("b", (1.0, 10.0), (2.0, 20.0)),
    ]
    assert along.x_label == "number of files"


def test_a_study_has_one_json_and_one_page(tmp_path):
    chapter = Chapter(
        "Errors",
        "About them.",
        [Results("Shown", results()), Results("Folded", results()[:4], folded=True)],
    )
    study = Study("Title", "2024-01-01", [chapter])
    assert study.figures("Shown")["cloud", "peer", "RMSE"].value == 4e3
    page = study.write(tmp_path / "sub")
    text = page.read_text()
    assert text.index("About them.") < text.index("<caption>Shown") < text.index("<details>")
    assert text.index("<details>") < text.index("<caption>Folded")
    content = json.loads((page.parent / "result.json").read_text())
    assert (content["title"], content["date"]) == ("Title", "2024-01-01")
    row = content["tables"]["Folded"][1]
    assert (row["case"], row["method"], row["quantity"]) == ("clear", "ours", "RMSE")
    assert (row["value"], row["error"], row["unit"]) == (2.0, 0.1, "")
    with pytest.raises(CatalogError, match="cannot be written"):
        study.write(page / "sub")


@pytest.mark.parametrize(
    ("nanoseconds", "text"), [(3.21, "3.21 ns"), (4.2e3, "4.2 µs"), (5e6, "5 ms"), (2e9, "2 s")]
)
def test_times_have_a_suitable_unit(nanoseconds, text):
    (line,) = table("Times", [Row("", "m", "time", nanoseconds, unit=Unit.TIME)]).rows
    assert line == ("m", text)

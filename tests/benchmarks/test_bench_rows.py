"""Rows of results: text of values, tables and charts."""

from __future__ import annotations

import json

import pytest

from benchmarks.harness.figure import CPU_TIME, Figure, Work, cpu_time, share, with_error
from benchmarks.harness.plots import Chart, draw
from benchmarks.harness.results import Results, Study, frame, table
from lidarops.errors import CatalogError

pytestmark = pytest.mark.slow


def results():
    return {
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


def lines(shown):
    """Return the rows of a table as tuples."""
    return [*shown.itertuples(index=False, name=None)]


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
    rows = frame(results())
    whole = table(rows, case="air")
    assert [*whole.columns] == ["air", "method", "profiles", "RMSE", "95 %", CPU_TIME]
    assert lines(whole) == [
        ("clear", "ours", "20", "2.0(1)", "95.0(4) %", "3 µs"),
        ("clear", "peer", "20", "1.0(1)", "-", "5 ms"),
        ("cloud", "peer", "20", "4,000", "-", "1 µs"),
    ]
    assert table(rows[:8]).columns[0] == "method"
    assert table(rows[4:]).columns[0] == "case"
    assert [*table(rows[:4]).columns[:2]] == ["method", "profiles"]


@pytest.mark.parametrize(
    ("value", "text"), [(0.9996, ">99.9 %"), (1.0, "100 %"), (0.0, "0 %"), (3e-5, "0.003 %")]
)
def test_only_a_share_of_1_is_100_percent(value, text):
    assert lines(table(frame({("", "m"): {"share": share(value)}}))) == [("m", text)]


@pytest.mark.parametrize(
    ("nanoseconds", "text"), [(3.21, "3.21 ns"), (4.2e3, "4.2 µs"), (5e6, "5 ms"), (2e9, "2 s")]
)
def test_times_have_a_suitable_unit(nanoseconds, text):
    assert lines(table(frame({("", "m"): {"time": cpu_time(nanoseconds)}}))) == [("m", text)]


WORKS = [
    Work(case, "depth", method, Figure(rmse, 0.1), None, cpu_time(time), ours=method == "ours")
    for case, method, rmse, time in (
        ("clear", "ours", 2.0, 3e3), ("clear", "peer", 1.0, 5e6), ("cloud", "peer", 4.0, 1e3),
    )
]  # fmt: skip


def test_a_chart_names_methods_and_cases_and_is_drawn_alike_each_time():
    chart = Chart("work", "Errors & times", WORKS)
    drawn = draw(chart)
    assert drawn == draw(chart)
    text = drawn.decode()
    assert all(f">{word}<" in text for word in ("ours", "peer", "clear", "cloud"))
    assert "Errors &amp; times" in text


def test_a_study_writes_its_json_and_charts(tmp_path):
    tables = [Results("Shown", results()), Results("Noted", results(), "A note.")]
    charts = [Chart("work", "Errors", WORKS)]
    study = Study(tables, charts, date="2024-01-01")
    assert study.figures("Shown")["cloud", "peer", "RMSE"].value == 4e3
    written = study.write(tmp_path / "sub")
    assert (written.parent / "work.svg").is_file()
    content = json.loads(written.read_text())
    assert content["date"] == "2024-01-01"
    assert content["notes"] == {"Shown": "", "Noted": "A note."}
    row = content["tables"]["Noted"][1]
    assert (row["case"], row["method"], row["quantity"]) == ("clear", "ours", "RMSE")
    assert (row["value"], row["error"], row["unit"]) == (2.0, 0.1, "")
    with pytest.raises(CatalogError, match="cannot be written"):
        study.write(written / "sub")

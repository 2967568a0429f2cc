"""Rows of results: text of values, tables and charts."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from lidarops.bench.harness.rows import (
    CPU_TIME,
    MonteCarloFigure,
    Quantity,
    Row,
    Unit,
    error_against_time,
    panel,
    rows_of,
    table,
    table_of_methods,
    with_error,
)


@dataclass(frozen=True)
class Score:
    rmse: MonteCarloFigure
    coverage: tuple[MonteCarloFigure, ...] | None
    nanoseconds: float
    profiles: int = 20


OF_SCORE = (
    Quantity("profiles", "profiles"),
    Quantity("RMSE", "rmse", factor=1e3),
    Quantity("95 %", "coverage.1", Unit.SHARE),
    Quantity(CPU_TIME, "nanoseconds", Unit.TIME),
)
WITHIN = (MonteCarloFigure(0.7, 0.01), MonteCarloFigure(0.95, 0.004))


def results():
    rows = rows_of("clear", "ours", Score(MonteCarloFigure(2e-3, 1e-4), WITHIN, 3e3), OF_SCORE)
    rows += rows_of("clear", "peer", Score(MonteCarloFigure(1e-3, 1e-4), None, 5e6), OF_SCORE)
    return rows + rows_of("cloud", "peer", Score(MonteCarloFigure(4.0, 0.0), None, 1e3), OF_SCORE)


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
    by_method = table_of_methods("Scores", results(), "RMSE")
    assert by_method.columns == ("case", "ours", "peer")
    assert by_method.rows == (("clear", "2.0(1)", "1.0(1)"), ("cloud", "-", "4,000"))


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

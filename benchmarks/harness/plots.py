"""Charts of benchmarks by matplotlib."""

from __future__ import annotations

import io
from collections.abc import Container, Iterable
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.harness.figure import CPU_TIME, Unit

_DRAWN: Final = {Unit.NUMBER: (1.0, ""), Unit.SHARE: (100.0, " (%)"), Unit.TIME: (1e-3, " (µs)")}
"""Factor and unit in which values are drawn."""
_MARKS: Final = "osD^vP*X<>hp"
_STYLE: Final[dict[Any, Any]] = {
    "svg.hashsalt": "lidarops",
    "svg.fonttype": "none",
    "axes.grid": True,
    "grid.alpha": 0.3,
    "font.size": 9.0,
}


@dataclass(frozen=True, slots=True)
class Chart:
    """An error against the CPU time with a panel for each case, or the CPU time of methods."""

    name: str
    """Of the file, without suffix."""
    title: str
    rows: pd.DataFrame
    """Results with the columns of `benchmarks.harness.results.COLUMNS`."""
    quantity: str
    """Drawn against the CPU time; the CPU time itself is drawn with a line for each method."""
    hollow: Container[str] = ()
    """Methods that are peers, or know more than the profile; the front leaves them out."""


def draw(chart: Chart) -> bytes:
    """Return a chart as an SVG."""
    with mpl.rc_context(_STYLE):
        figure = Figure(layout="constrained")
        (_draw_times if chart.quantity == CPU_TIME else _draw_errors)(chart, figure)
        figure.suptitle(chart.title)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Title": chart.title})
    return stream.getvalue()


def _wide(chart: Chart, quantity: str) -> pd.DataFrame:
    """Return the rows of a quantity in the unit in which it is drawn, by case and method."""
    rows = chart.rows[(chart.rows["quantity"] == quantity) & chart.rows["value"].notna()]
    factor = [_DRAWN[Unit(unit)][0] for unit in rows["unit"]]
    drawn = rows.assign(value=rows["value"] * factor, error=rows["error"] * factor)
    return drawn.set_index(["case", "method"])


def _draw_errors(chart: Chart, figure: Figure) -> None:
    times = _wide(chart, CPU_TIME)[["value"]].rename(columns={"value": "value_of_time"})
    both = times.join(_wide(chart, chart.quantity)).dropna(subset="value")
    cases = both.index.unique("case")
    looks = {method: (f"C{k % 10}", _MARKS[k % len(_MARKS)])
             for k, method in zip(count(), both.index.unique("method"))}  # fmt: skip
    figure.set_size_inches(3.0 + 3.2 * len(cases), 4.2)
    panels = np.atleast_1d(np.asarray(figure.subplots(1, len(cases), sharey=True)))
    for axes, case in zip(panels, cases, strict=True):
        drawn = both.loc[case]
        for method, row in drawn.iterrows():
            colour, mark = looks[str(method)]
            # A bar that reaches 0 cannot be drawn on a logarithmic axis.
            bar = [[min(2.0 * row["error"], 0.9 * row["value"])], [2.0 * row["error"]]]
            fill = "none" if method in chart.hollow else colour
            axes.errorbar([row["value_of_time"]], [row["value"]], bar, label=method, ls="",
                          marker=mark, color=colour, markerfacecolor=fill)  # fmt: skip
        solid = drawn[[method not in chart.hollow for method in drawn.index]]
        ranked = solid.sort_values(["value_of_time", "value"])[["value_of_time", "value"]]
        # Of the front, no faster method has as small an error.
        front = ranked[ranked["value"] < ranked["value"].cummin().shift(fill_value=np.inf)]
        axes.step(*front.to_numpy(float).T, where="post", color="0.5", lw=0.8, zorder=0)
        axes.set(xscale="log", yscale="log", title=case, xlabel=f"{CPU_TIME} (µs)")
    panels[0].set_ylabel(chart.quantity + _DRAWN[Unit(both["unit"].iloc[0])][1])
    _add_legend(figure, panels)


def _draw_times(chart: Chart, figure: Figure) -> None:
    times = _wide(chart, CPU_TIME)["value"]
    methods = [*times.index.unique("method")]
    figure.set_size_inches(8.0, 1.6 + 0.32 * len(methods))
    axes = figure.subplots()
    for k, case in enumerate(times.index.unique("case")):
        own = times[case]
        fill = "none" if k % 2 else f"C{k}"
        axes.plot(own, [methods.index(method) for method in own.index], ls="", label=case,
                  marker=_MARKS[k], color=f"C{k}", markerfacecolor=fill)  # fmt: skip
    axes.set(xscale="log", xlabel=f"{CPU_TIME} (µs)", yticks=range(len(methods)))
    axes.set_yticklabels(methods)
    axes.invert_yaxis()
    _add_legend(figure, [axes])


def _add_legend(figure: Figure, panels: Iterable[Any]) -> None:
    handles: dict[str, Any] = {}
    for axes in panels:
        drawn, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, drawn, strict=True))
    columns = max(110 // (8 + max(map(len, handles))), 1)
    figure.legend([*handles.values()], [*handles], loc="outside lower center", ncols=columns)

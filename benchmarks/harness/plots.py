"""Charts of benchmarks by matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.figure import CPU_TIME, Work

_MARKS: Final = "osD^vP*X<>hp"
_MICROSECOND: Final = 1e3
"""ns."""
_STYLE: Final[dict[Any, Any]] = {
    "svg.hashsalt": "lidarops",
    "svg.fonttype": "none",
    "axes.grid": True,
    "grid.alpha": 0.3,
    "font.size": 9.0,
}


@dataclass(frozen=True, slots=True)
class Chart:
    """Errors against the CPU time, with a panel for each setting."""

    name: str
    """Of the file, without suffix."""
    title: str
    works: Sequence[Work]
    """Marks of peers, and of methods that know more than the profile, are hollow; the front leaves
    them out."""


def draw(chart: Chart) -> bytes:
    """Return a chart as an SVG."""
    settings, methods = (
        list(dict.fromkeys(getattr(work, name) for work in chart.works))
        for name in ("setting", "method")
    )
    with mpl.rc_context(_STYLE):
        figure = Figure((3.0 + 3.2 * len(settings), 4.2), layout="constrained")
        panels = np.atleast_1d(np.asarray(figure.subplots(1, len(settings), sharey=True)))
        handles: dict[str, Any] = {}
        for axes, setting in zip(panels, settings, strict=True):
            drawn = [work for work in chart.works if work.setting == setting]
            handles |= {
                work.method: _mark(axes, work, methods.index(work.method)) for work in drawn
            }
            axes.step(*_front(drawn).T, where="post", color="0.5", lw=0.8, zorder=0)
            axes.set(xscale="log", yscale="log", title=setting, xlabel=f"{CPU_TIME} (µs)")
        panels[0].set_ylabel("RMSE")
        columns = max(110 // (8 + max(map(len, handles))), 1)
        figure.legend([*handles.values()], [*handles], loc="outside lower center", ncols=columns)
        figure.suptitle(chart.title)
        stream = io.BytesIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Title": chart.title})
    return stream.getvalue()


def _mark(axes: Any, work: Work, number: int) -> Any:
    """Draw the error of a method with its bar; return the handle for a legend."""
    value, error = work.error.value, 2.0 * work.error.error
    # A bar that reaches 0 cannot be drawn on a logarithmic axis.
    bar, colour = [[min(error, 0.9 * value)], [error]], f"C{number % 10}"
    fill = colour if work.ours and not work.informed else "none"
    return axes.errorbar(
        [work.time.value / _MICROSECOND], [value], bar, ls="", color=colour, markerfacecolor=fill,
        marker=_MARKS[number % len(_MARKS)],
    )  # fmt: skip


def _front(works: Sequence[Work]) -> Any:
    """Return time, µs, and error of the methods of which no faster one has as small an error."""
    front: list[tuple[float, float]] = []
    for work in sorted(works, key=lambda work: (work.time.value, work.error.value)):
        if work.ours and not work.informed and (not front or work.error.value < front[-1][1]):
            front.append((work.time.value / _MICROSECOND, work.error.value))
    return np.reshape(front, (-1, 2))

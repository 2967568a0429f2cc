"""The figure of products of any kind in reports: their main variable against time."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Final

from matplotlib.figure import Figure

from lidarops.figures import panels
from lidarops.figures.any_kind import read_main_variable
from lidarops.figures.kind_figures import ReportFigure, ReportFigures, preferred_variables
from lidarops.figures.product_figures import described, draw_series
from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.series_data import NumberedSeries, join
from lidarops.figures.wording import counted
from lidarops.kinds import kinds
from lidarops.netcdf.variables import QUALITY_FLAG, layout_of


def _figures(group: Group, sources: Sources) -> Iterator[ReportFigure]:
    read = functools.partial(read_main_variable, kind=group.kind, most=panels.SECTIONS)
    found = sources.read_all(group, _variables(group.kind), [read] * len(group.members))
    known = [main for main in found if main is not None]
    if known:
        first = known[0]
        joined = join(part for main in known if main.name == first.name for part in main.series)
        yield ReportFigure(
            group.kind,
            f"{first.title} against time: {group.label}; {counted(len(known), 'scene')}.",
            _draw,
            joined[: panels.SECTIONS],
        )


def _variables(kind: str) -> tuple[str, ...]:
    """Return the variables of which one may be the main variable, with their errors."""
    data = layout_of(kind).data if kind in kinds() else ()
    names = dict.fromkeys([*(row.name for row in data if row.uncertain), *preferred_variables()])
    return "time", QUALITY_FLAG, *names, *(f"{name}_standard_error" for name in names)


def _draw(series: Sequence[NumberedSeries], *, title: str = "") -> Figure:
    (name,) = series[0].estimates
    figure, _ = draw_series(series, (name,), title=title, heights=(3.0,))
    return described(figure, f"{title}: {name} against time.")


REPORT: Final = ReportFigures(_figures)

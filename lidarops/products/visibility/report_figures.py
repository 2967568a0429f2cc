"""The figures of the ``visibility`` product in reports: a map of beams, and series at crossings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lidarops.figures import panels, product_figures
from lidarops.figures.kind_figures import ReportFigure, ReportFigures
from lidarops.figures.product_figures import described
from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.series_data import NumberedSeries, compare, join
from lidarops.figures.wording import counted
from lidarops.products.visibility.figure_data import (
    CROSSING_VARIABLES,
    MAP_VARIABLES,
    NetworkMap,
    instruments_of,
    read_crossings,
    read_map,
)

_COLORS: Final = "cividis"
"""Perceptually uniform; readable with colour vision deficiency and in grey."""
_LINES: Final = ("-", "--", "-.", ":")
CROSSINGS: Final = panels.SECTIONS
"""Most crossings in one figure of series."""


def _figures(group: Group, sources: Sources) -> Iterator[ReportFigure]:
    read = [
        partial(read_crossings, instruments=instruments_of(scene)) for scene, _ in group.members
    ]
    by_scene = list(sources.read_all(group, CROSSING_VARIABLES, read, with_truth=True))
    series = join(crossing for crossings in by_scene for crossing in crossings)
    sources.compare(group, (compare(crossing, "extinction") for crossing in series))
    if not series:
        return
    read_network = partial(read_map, instruments=instruments_of(group.members[0][0]))
    network = sources.read_first(group, MAP_VARIABLES, read_network)
    if network is not None:
        yield ReportFigure(
            "network",
            f"Beams, crossings and median visibility at the crossings: {group.label}.",
            draw_map,
            network,
        )
    for first in range(0, len(series), CROSSINGS):
        few = series[first : first + CROSSINGS]
        yield ReportFigure(
            "visibility",
            f"Visibility and extinction at the crossings, with standard errors:"
            f" {group.label}, {', '.join(crossing.label for crossing in few)}.",
            draw_crossings,
            few,
        )


REPORT: Final = ReportFigures(_figures, compares=True)


def draw_map(network: NetworkMap, *, title: str = "") -> Figure:
    """Draw the beams of a network and their crossings.

    Parameters
    ----------
    network : NetworkMap
        From `lidarops.products.visibility.figure_data.read_map`.
    title : str, optional

    Returns
    -------
    Figure
        The colour of a crossing is its median visibility over time, also written beside it. A
        crossing without a value is hollow. Line styles distinguish instruments.
    """
    figure = Figure(figsize=(7.4, 6.2), dpi=product_figures.DPI, layout="constrained")
    panel = figure.subplots()
    panels.title(figure, title)
    panel.set_aspect("equal", adjustable="datalim")
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_xlabel(network.axes[0])
    panel.set_ylabel(network.axes[1])
    _beams(panel, network)
    known = network.visibility[np.isfinite(network.visibility)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    scale = Normalize(low - 0.02 * high, high + 0.02 * high)
    for number, place, value in zip(
        network.numbers, network.crossings, network.visibility, strict=True
    ):
        has = bool(np.isfinite(value))
        panel.plot(
            *place,
            marker="o",
            markersize=11,
            markerfacecolor=colormaps[_COLORS](scale(value)) if has else "white",
            markeredgecolor=panels.INK,
            zorder=3,
            gid="crossing",
        )
        panel.annotate(
            f"{number}: {value:.3g} km" if has else f"{number}: no value",
            place,
            xytext=(9, 7),
            textcoords="offset points",
            fontsize=9,
            color=panels.INK,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
            zorder=4,
        )
    panels.legend(panel, columns=2)
    medians = "; ".join(
        f"crossing {number}: {value:.3g} km, {counted(used, 'value')}"
        for number, value, used in zip(
            network.numbers, network.visibility, network.used, strict=True
        )
    )
    return described(
        figure,
        f"{title}: map of {counted(len(network.ends), 'beam')} of"
        f" {counted(len(set(network.instruments)), 'instrument')}, with the median visibility"
        f" at each crossing. {medians}.",
    )


def _beams(panel: Axes, network: NetworkMap) -> None:
    order = list(dict.fromkeys(network.instruments))
    for start, end, name in zip(network.stations, network.ends, network.instruments, strict=True):
        turn = order.index(name)
        panel.plot(
            *np.stack([start, end]).T,
            color=panels.GREY,
            linewidth=1.2,
            linestyle=_LINES[turn % len(_LINES)],
            gid="beam",
        )
        known = panel.get_legend_handles_labels()[1]
        panel.plot(
            *start,
            marker=("^", "s", "D", "v")[turn % 4],
            markersize=8,
            color=panels.INK,
            linestyle=_LINES[turn % len(_LINES)],
            label="_" if name in known else name,
            gid="station",
        )


def draw_crossings(series: Sequence[NumberedSeries], *, title: str = "") -> Figure:
    """Draw visibility and extinction at crossings against time.

    Parameters
    ----------
    series : sequence of NumberedSeries
        One to `CROSSINGS`.
    title : str, optional

    Returns
    -------
    Figure
        With 1-sigma errors (random and systematic), flagged values marked, and the truth as a
        black dashed line.
    """
    quantities = ("visibility", "extinction")
    figure, axes = product_figures.draw_series(series, quantities, title=title, heights=(2.6, 2.6))
    for panel in axes:
        # Neither quantity is ever negative.
        panel.set_ylim(bottom=max(0.0, panel.get_ylim()[0]))
    words = []
    for crossing in series:
        good = ~crossing.rejected
        values = crossing.estimates["visibility"].value[good]
        values = values[np.isfinite(values)]
        span = f"{values.min():.3g} to {values.max():.3g} km" if values.size else "no value"
        words.append(f"{crossing.label}: {span}, {int((~good).sum())} of {good.size} rejected")
    return described(
        figure,
        f"{title}: visibility and extinction at the crossings against time. {'; '.join(words)}.",
    )

"""Figures of networks: a map of beams and crossings, and the series at each crossing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lidarops.figures import panels
from lidarops.figures.network_data import CrossingSeries, NetworkMap
from lidarops.figures.time_axis import time_axis
from lidarops.figures.wording import counted, visible

_DPI: Final = 150
_COLORS: Final = "cividis"
"""Perceptually uniform; readable with colour vision deficiency and in grey."""
_LINES: Final = ("-", "--", "-.", ":")
CROSSINGS: Final = panels.SECTIONS
"""Most crossings in one figure of series."""


def draw_map(network: NetworkMap, *, title: str = "") -> Figure:
    """Draw the beams of a network and their crossings.

    Parameters
    ----------
    network : NetworkMap
        From `lidarops.figures.network_data.read_map`.
    title : str, optional

    Returns
    -------
    Figure
        The colour of a crossing is its median visibility over time, also written beside it. A
        crossing without a value is hollow. Line styles distinguish instruments.
    """
    figure = Figure(figsize=(7.4, 6.2), dpi=_DPI, layout="constrained")
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
    figure.set_label(
        visible(
            f"{title}: map of {counted(len(network.ends), 'beam')} of"
            f" {counted(len(set(network.instruments)), 'instrument')}, with the median visibility"
            f" at each crossing. {medians}."
        )
    )
    return figure


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


def draw_series(series: Sequence[CrossingSeries], *, title: str = "") -> Figure:
    """Draw visibility and extinction at crossings against time.

    Parameters
    ----------
    series : sequence of CrossingSeries
        One to `CROSSINGS`.
    title : str, optional

    Returns
    -------
    Figure
        With 1-sigma errors (random and systematic), flagged values marked, and the truth as a
        black dashed line.
    """
    axis = time_axis(np.unique(np.concatenate([crossing.time for crossing in series])))
    figure = Figure(figsize=(10.0, 6.3), dpi=_DPI, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    panels.title(figure, title)
    panels.estimates(upper, axis, series, "visibility")
    panels.estimates(lower, axis, series, "extinction")
    for panel in (upper, lower):
        # Neither quantity is ever negative.
        panel.set_ylim(bottom=max(0.0, panel.get_ylim()[0]))
    panels.time_ticks([upper, lower], axis)
    panels.legend(upper)
    panels.legend(lower, other=upper)
    words = []
    for crossing in series:
        good = ~crossing.rejected
        values = crossing.estimates["visibility"].value[good]
        values = values[np.isfinite(values)]
        span = f"{values.min():.3g} to {values.max():.3g} km" if values.size else "no value"
        words.append(f"{crossing.label}: {span}, {int((~good).sum())} of {good.size} rejected")
    figure.set_label(
        visible(
            f"{title}: visibility and extinction at the crossings against time. {'; '.join(words)}."
        )
    )
    return figure

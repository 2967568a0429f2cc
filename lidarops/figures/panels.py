"""Elements of figures: axes, lines, marks and images, each drawn into one panel.

Colours are distinguishable with colour vision deficiency (Okabe and Ito). Markers and line styles
differ too, so that figures are readable in grey.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Colormap, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from lidarops.figures.raster import Raster, colour_limits, joined, share_with_care
from lidarops.figures.series_data import TimeSeries, compare, normalised_error, thin
from lidarops.figures.time_axis import TimeAxis, Times, segments
from lidarops.figures.wording import counted, percent, visible
from lidarops.flags import Quality, Severity

Floats = NDArray[np.float64]

INK: Final = "#222222"
GREY: Final = "#767676"

_POINTS: Final = 1500
"""More profiles than this are drawn as block means."""
_MARKS: Final = 300
"""Most flagged values that are drawn."""
_BARS: Final = 150
"""Most points with error bars; more points get a band."""
_FAR_OFF: Final = 10.0
"""Larger normalised errors are drawn at this value."""
_REJECT_COLOR: Final = "#000000"
_AXIS_UNITS: Final = {"extinction": ("km$^{-1}$", 1.0e3)}
_IMAGE_UNITS: Final = {
    "mV m2": "mV m$^2$",
    "MHz m2": "MHz m$^2$",
    "m-1 sr-1": "m$^{-1}$ sr$^{-1}$",
}


@dataclass(frozen=True, slots=True)
class _Style:
    color: str
    marker: str
    line: Literal["-", "--", "-."]


_STYLES: Final = (
    _Style("#0072B2", "o", "-"),
    _Style("#D55E00", "s", "--"),
    _Style("#009E73", "^", "-."),
)

SECTIONS: Final = len(_STYLES)
"""Most sections in one panel; more cannot be distinguished."""


def title(figure: Figure, words: str) -> None:
    """Write a title at the left. Dollar signs do not start a formula: names come from files."""
    words = " ".join(visible(words).split())
    figure.suptitle(words, x=0.008, ha="left", fontsize=11.5, color=INK, parse_math=False)


def nothing(panel: Axes, words: str) -> None:
    """Write into a panel why it is empty."""
    panel.text(0.5, 0.5, words, ha="center", va="center", transform=panel.transAxes, color=GREY)


def legend(
    panel: Axes,
    handles: Sequence[Artist] = (),
    *,
    columns: int = 3,
    other: Axes | None = None,
) -> None:
    """Write the legend above a panel, without the labels of an `other` panel."""
    labels = other.get_legend_handles_labels()[1] if other is not None else []
    shown = list(handles) or [
        handle
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
        if label not in labels
    ]
    if shown:
        panel.legend(
            handles=shown,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.02),
            ncols=min(columns, len(shown)),
            fontsize=8.5,
            frameon=False,
            borderaxespad=0.2,
            borderpad=0.0,
            handlelength=1.8,
            columnspacing=1.6,
        )


def time_ticks(panels: Sequence[Axes], axis: TimeAxis) -> None:
    """Label the common time axis of panels, below the last panel."""
    ticks = axis.ticks()
    for panel in panels:
        panel.set_xlim(*axis.limits)
        if axis.breaks.size <= 60:
            for position in axis.breaks:
                panel.axvline(position, color=GREY, linewidth=0.8, linestyle=(0, (1, 2)))
    panels[-1].set_xticks([tick.x for tick in ticks], [tick.label for tick in ticks])
    note = "; gaps cut out at the dotted lines" if axis.broken else ""
    panels[-1].set_xlabel(f"time (UTC{note})")


# Retrieved values ----------------------------------------------------------------------------


def estimates(panel: Axes, axis: TimeAxis, sections: Sequence[TimeSeries], quantity: str) -> None:
    """Draw a retrieved quantity of up to `SECTIONS` sections, with flags and truth."""
    _calm(panel)
    units, scale = _AXIS_UNITS.get(quantity, (sections[0].estimates[quantity].units, 1.0))
    panel.set_ylabel(f"{quantity} ({units})")
    panel.yaxis.set_major_locator(MaxNLocator(6))
    limits = _limits(sections, quantity, scale)
    panel.set_ylim(*limits)
    for section, style in zip(sections, _STYLES, strict=False):
        _values(panel, axis, section, quantity, scale, style)
    _truth(panel, axis, sections, quantity, scale)
    for care in (True, False):
        _marks(panel, axis, sections, quantity, scale, care=care)


def _calm(panel: Axes) -> None:
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(axis="y", color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)


def _values(
    panel: Axes, axis: TimeAxis, section: TimeSeries, quantity: str, scale: float, style: _Style
) -> None:
    drawn = thin(section, _POINTS)
    if drawn.time.size == 0:
        return
    estimate = drawn.estimates[quantity]
    x, value, error = _with_gaps(
        drawn.time, axis, scale * estimate.value, scale * estimate.standard_error
    )
    profiles = round(int((section.flag == 0).sum()) / drawn.time.size)
    means = f", means of {profiles} profiles" if profiles > 1 else ""
    few = drawn.time.size <= _BARS
    panel.plot(
        x,
        value,
        color=style.color,
        linewidth=0.9,
        linestyle=style.line,
        marker=style.marker if few else None,
        markersize=3.5,
        label=f"{section.label}{means}, $\\pm$1 standard error",
        gid=f"values-{quantity}",
    )
    if few:
        bars = np.where(np.isfinite(error), error, 0.0)
        panel.errorbar(
            x, value, yerr=bars, fmt="none", ecolor=style.color, elinewidth=1.0, capsize=1.5
        )
    else:
        low, high = value - error, value + error
        panel.fill_between(x, low, high, color=style.color, alpha=0.3, linewidth=0)


def _truth(
    panel: Axes, axis: TimeAxis, sections: Sequence[TimeSeries], quantity: str, scale: float
) -> None:
    label = "simulated truth"
    for section in sections:
        truth = section.estimates[quantity].truth
        if np.isfinite(truth).any():
            some = slice(None, None, -(-truth.size // _POINTS))
            x, value = _with_gaps(section.time[some], axis, scale * truth[some])
            panel.plot(
                x,
                value,
                color="black",
                linewidth=1.0,
                linestyle=(0, (4, 2)),
                label=label,
                zorder=4,
                gid=f"truth-{quantity}",
            )
            label = "_"


def _marks(
    panel: Axes,
    axis: TimeAxis,
    sections: Sequence[TimeSeries],
    quantity: str,
    scale: float,
    *,
    care: bool,
) -> None:
    """Mark the values that a quality bit rejects, or those to use with care."""
    chosen = [(s.flag != 0) & ~s.rejected if care else s.rejected for s in sections]
    times = np.concatenate([s.time[c] for s, c in zip(sections, chosen, strict=True)])
    values = scale * np.concatenate(
        [s.estimates[quantity].value[c] for s, c in zip(sections, chosen, strict=True)]
    )
    if times.size == 0:
        return
    low, high = panel.get_ylim()
    finite = np.isfinite(values)
    beyond = finite & ((values < low) | (values > high))
    some = _subset(np.flatnonzero(finite), _MARKS)
    every = -(-int(finite.sum()) // _MARKS)
    counts = f"{times.size:,}" + (f" (1 of {every} drawn)" if every > 1 else "")
    notes = [f"{beyond.sum():,} off the axis, drawn at its edge"] if beyond.any() else []
    notes += [f"{(~finite).sum():,} without a value"] if not finite.all() else []
    what = "use with care" if care else "flagged, do not use"
    (marks,) = panel.plot(
        axis.x(times[some]),
        np.clip(values[some], low, high),
        linestyle="none",
        clip_on=False,
        marker="o" if care else "X",
        markersize=5.5 if some.size < 100 else 4.0,
        markerfacecolor="none",
        markeredgecolor=INK if care else GREY,
        markeredgewidth=0.8,
        zorder=1.9,
        label="\n".join([f"{what}: {counts}", *notes]),
        gid=f"{'care' if care else 'flagged'}-{quantity}",
    )
    # Marks at the edge extend beyond the panel; the layout must not make room for them.
    marks.set_in_layout(False)


def _subset(index: NDArray[np.intp], at_most: int) -> NDArray[np.intp]:
    return index[:: max(1, -(-index.size // at_most))]


def _limits(sections: Sequence[TimeSeries], quantity: str, scale: float) -> tuple[float, float]:
    """Return limits that contain every usable value with its error bar."""
    edges: list[Floats] = []
    for section in sections:
        estimate = section.estimates[quantity]
        use = ~section.rejected
        error = np.where(np.isfinite(estimate.standard_error), estimate.standard_error, 0.0)
        edges += [(estimate.value - error)[use], (estimate.value + error)[use], estimate.truth]
    inside = _finite(edges)
    if inside.size == 0:
        rejected = _finite([section.estimates[quantity].value for section in sections])
        inside = np.percentile(rejected, [2.0, 98.0]) if rejected.size else np.array([0.0, 1.0])
    low, high = scale * float(inside.min()), scale * float(inside.max())
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _finite(parts: Sequence[Floats]) -> Floats:
    values = np.concatenate(parts)
    return values[np.isfinite(values)]


def _with_gaps(time: Times, axis: TimeAxis, *values: Floats) -> tuple[Floats, ...]:
    """Return positions and values with NaN at gaps, so that no line crosses a gap."""
    cuts = [stretch.start for stretch in segments(time)][1:]
    x = axis.x(time)
    return np.insert(x, cuts, x[cuts]), *(np.insert(value, cuts, np.nan) for value in values)


def scores(panel: Axes, axis: TimeAxis, sections: Sequence[TimeSeries], quantity: str) -> None:
    """Draw (retrieved - truth) / standard error of the unflagged values of sections."""
    _calm(panel)
    panel.set_ylabel(f"{quantity}\n(retrieved $-$ truth) / $\\sigma$", fontsize=9)
    largest = 4.0
    for section, style in zip(sections, _STYLES, strict=False):
        comparison = compare(section, quantity)
        if comparison is None:
            continue
        score = np.where(section.flag == 0, normalised_error(section, quantity), np.nan)
        known = np.flatnonzero(np.isfinite(score))
        size = np.abs(score[known])
        largest = max(largest, min(_FAR_OFF, 1.1 * float(size.max(initial=0.0))))
        far = int((size > _FAR_OFF).sum())
        # Values beyond 3 are always drawn, the others thinned.
        shown = np.union1d(_subset(known, 4 * _POINTS), known[size > 3.0])
        panel.plot(
            axis.x(section.time[shown]),
            np.clip(score[shown], -_FAR_OFF, _FAR_OFF),
            linestyle="none",
            marker=style.marker,
            markersize=3.0,
            markeredgewidth=0,
            color=style.color,
            alpha=0.8,
            label=(
                f"{section.label}: {percent(comparison.within_3)} of {comparison.count:,} within 3"
                + (f"\n{far:,} beyond {_FAR_OFF:g}, drawn there" if far else "")
            ),
            gid=f"score-{quantity}",
        )
    panel.axhline(0.0, color=INK, linewidth=0.8)
    panel.axhspan(-1.0, 1.0, color=GREY, alpha=0.13, linewidth=0)
    for level in (-3.0, 3.0):
        panel.axhline(level, color=INK, linewidth=1.0, linestyle="--")
    panel.set_ylim(-largest, largest)
    legend(panel)


# Signals -------------------------------------------------------------------------------------


def image(
    figure: Figure,
    panel: Axes,
    axis: TimeAxis,
    rasters: Sequence[Raster],
    label: str = "range-corrected\nsignal",
    along: str = "range",
) -> str:
    """Draw rasters into a panel with a colour bar; return a description in words.

    The panel begins at the ground along ``range``, and at the first row along ``altitude``.
    """
    full = max(float(raster.edges[-1]) for raster in rasters)
    reach = max(raster.reach for raster in rasters)
    far = min(full, 1.2 * reach) if reach > 0 else full
    cut = joined([raster.shown_to(far) for raster in rasters])
    panel.set_ylabel(f"{along} (km)")
    first = min(float(raster.edges[0]) for raster in cut)
    panel.set_ylim((min(0.0, first) if along == "range" else first) / 1e3, far / 1e3)
    panel.spines[["top", "right"]].set_visible(False)
    meshes = _signal(panel, axis, cut)
    if meshes:
        bar = figure.colorbar(meshes[0], ax=panel, pad=0.01, extend="both", fraction=0.05)
        units = _IMAGE_UNITS.get(cut[0].units, cut[0].units)
        bar.set_label(f"{label} ({units})")
    else:
        nothing(panel, "no usable signal above zero")
    for raster in cut:
        _rejected(panel, axis, raster)
    _cloud_bases(panel, axis, cut)
    _altitude_axis(panel, rasters)
    return _notes(panel, rasters, far, full)


def _signal(panel: Axes, axis: TimeAxis, rasters: Sequence[Raster]) -> list[QuadMesh]:
    limits = colour_limits(np.concatenate([raster.mean[~raster.flagged] for raster in rasters]))
    if limits is None:
        return []
    low, high = limits
    norm = LogNorm(low, high)
    # Without the dark end of viridis, because rejected bins are black.
    colors = ListedColormap(colormaps["viridis"](np.linspace(0.15, 1.0, 256)), name="signal")
    # On the logarithmic scale, means at or below zero take the lowest colour.
    return [
        _blocks(panel, axis, raster, np.where(raster.mean <= 0, low, raster.mean), colors, norm)
        for raster in rasters
    ]


def _rejected(panel: Axes, axis: TimeAxis, raster: Raster) -> None:
    if raster.flagged.any():
        marks = np.where(raster.flagged, 1.0, np.nan)
        mesh = _blocks(panel, axis, raster, marks, ListedColormap([_REJECT_COLOR]), None)
        mesh.set_gid("flagged-signal")


def _cloud_bases(panel: Axes, axis: TimeAxis, rasters: Sequence[Raster]) -> None:
    known = [(raster.middle, raster.clouds) for raster in rasters]
    time = np.concatenate([middle[np.isfinite(base)] for middle, base in known])
    base = np.concatenate([base[np.isfinite(base)] for _, base in known])
    if base.size:
        panel.plot(
            axis.x(time),
            base / 1e3,
            linestyle="none",
            marker="v",
            markersize=4.5,
            markerfacecolor="white",
            markeredgecolor="black",
            markeredgewidth=0.8,
            gid="cloud-base",
        )


def _blocks(
    panel: Axes,
    axis: TimeAxis,
    raster: Raster,
    values: Floats,
    colors: Colormap,
    norm: LogNorm | None,
) -> QuadMesh:
    """Draw the columns of a raster, with empty columns at gaps."""
    left, right = axis.x(raster.start), axis.x(raster.stop)
    gaps = 1 + np.flatnonzero(left[1:] - right[:-1] > 1e-9)
    edges = np.append(np.insert(left, gaps, right[gaps - 1]), right[-1])
    filled = np.ma.masked_invalid(np.insert(values, gaps, np.nan, axis=0))
    return panel.pcolormesh(edges, raster.edges / 1e3, filled.T, cmap=colors, norm=norm)


def _notes(panel: Axes, rasters: Sequence[Raster], far: float, full: float) -> str:
    bits = dict.fromkeys(bit for raster in rasters for bit in raster.bits)
    rejecting = [bit.word for bit in sorted(bits) if bit.severity is Severity.REJECT]
    caring = [bit.word for bit in sorted(bits) if bit.severity is Severity.CARE]
    handles: list[Artist] = []
    notes: list[str] = []
    if any(raster.flagged.any() for raster in rasters):
        names = ", ".join(word for word in rejecting if word != Quality.INPUT_MISSING.word)
        notes.append(f"black: flagged {names}")
        handles.append(Patch(color=_REJECT_COLOR, label=_wrapped(f"flagged: {names}")))
    clouds = sum(int(np.isfinite(raster.clouds).sum()) for raster in rasters)
    if clouds:
        label = f"base of the lowest cloud or dense layer, in {counted(clouds, 'column')}"
        notes.append(f"triangles: {label}")
        handles.append(
            Line2D(
                [],
                [],
                linestyle="none",
                marker="v",
                markerfacecolor="white",
                markeredgecolor="black",
                label=label,
            )
        )
    if far < full:
        notes.append(f"shown to {far / 1e3:.3g} of {full / 1e3:.3g} km: noise dominates beyond")
    care = share_with_care(rasters)
    if care > 0:
        notes.append(f"{percent(care)} of all bins: use with care ({', '.join(caring)})")
    if notes[len(handles) :]:
        words = _wrapped("; ".join(notes[len(handles) :]))
        handles.append(Line2D([], [], linestyle="none", label=words))
    if handles:
        legend(panel, handles, columns=1)
    return "; ".join(notes) or f"shown to its full range of {full / 1e3:.3g} km"


def _wrapped(words: str) -> str:
    return textwrap.fill(words, 110)


def _altitude_axis(panel: Axes, rasters: Sequence[Raster]) -> None:
    lines = {raster.altitude for raster in rasters}
    line = lines.pop() if len(lines) == 1 else None
    # Along a nearly horizontal beam, altitude is not a useful axis.
    if line is None or abs(line[1]) < 0.05:
        return
    start, slope = line[0] / 1e3, line[1]

    def altitude(km: ArrayLike) -> Floats:
        return start + slope * np.asarray(km, dtype=np.float64)

    def along_range(km: ArrayLike) -> Floats:
        return (np.asarray(km, dtype=np.float64) - start) / slope

    panel.secondary_yaxis(1.0, functions=(altitude, along_range)).set_ylabel("altitude (km)")


def background(panel: Axes, axis: TimeAxis, rasters: Sequence[Raster]) -> None:
    """Draw the background against time with its standard error."""
    _calm(panel)
    panel.set_ylabel(f"background\n({rasters[0].background_units})")
    order = np.argsort(np.concatenate([raster.start for raster in rasters]), kind="stable")
    middle = np.concatenate([raster.middle for raster in rasters])[order]
    level = np.concatenate([raster.background for raster in rasters])[order]
    spread = np.concatenate([raster.background_error for raster in rasters])[order]
    x, value, error = _with_gaps(middle, axis, level, spread)
    color = _STYLES[0].color
    panel.fill_between(x, value - error, value + error, color=color, alpha=0.3, linewidth=0)
    panel.plot(
        x,
        value,
        color=color,
        linewidth=0.9,
        marker="." if x.size <= _BARS else None,
        markersize=3.0,
        gid="values-background",
    )

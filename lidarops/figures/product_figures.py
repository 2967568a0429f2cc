"""Figures of products of all kinds, and their conversion to PNG files.

Figures are built from `matplotlib.figure.Figure` directly, without the global state of matplotlib,
so that any thread may draw. Times are UTC. `alt_text` describes a figure in words.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lidarops.figures import panels, profile_panels, scan_panels
from lidarops.figures.profile_data import Profile
from lidarops.figures.raster import Raster, read_raster
from lidarops.figures.scan_data import ScanProfile, ScanResiduals
from lidarops.figures.series_data import QUANTITIES, Section, compare, join, read_sections
from lidarops.figures.time_axis import Times, time_axis
from lidarops.figures.wording import bit_name, counted, percent, visible
from lidarops.flags import Quality, Severity

DPI: Final = 150


def draw_retrieval(sections: Sequence[Section], *, title: str = "") -> Figure:
    """Draw retrieved extinction and background of sections against time.

    Parameters
    ----------
    sections : sequence of Section
        One to `panels.SECTIONS`, of one instrument and channel, joined in time.
    title : str, optional

    Returns
    -------
    Figure
        Unflagged values of each section with 1-sigma bars or a band, rejected values as hollow
        grey crosses, the truth as a black dashed line. Extinction in km-1.
    """
    axis = time_axis(_times(sections))
    figure, (upper, lower) = _stack((3.0, 2.2), title)
    panels.estimates(upper, axis, sections, "extinction")
    panels.estimates(lower, axis, sections, "background")
    panels.time_ticks([upper, lower], axis)
    panels.legend(upper)
    panels.legend(lower, other=upper)
    words = f"{title}: retrieved extinction and background against time."
    return _described(figure, f"{words} {_retrieved(sections)}.")


def draw_comparison(sections: Sequence[Section], *, title: str = "") -> Figure:
    """Draw (retrieved - truth) / standard error of unflagged values against time.

    Parameters
    ----------
    sections : sequence of Section
        One to `panels.SECTIONS`, of one instrument and channel, joined in time.
    title : str, optional

    Returns
    -------
    Figure
        One panel per quantity with a truth, with lines at +-3 and the share of values within.
    """
    axis = time_axis(_times(sections))
    comparisons = {
        name: [c for section in sections if (c := compare(section, name)) is not None]
        for name in QUANTITIES
    }
    known = [name for name in QUANTITIES if comparisons[name]] or ["extinction"]
    figure, stack = _stack((1.9,) * len(known), title)
    for panel, quantity in zip(stack, known, strict=True):
        panels.scores(panel, axis, sections, quantity)
    panels.time_ticks(stack, axis)
    words = [
        f"{c.quantity} {c.section}: {percent(c.within_3)} of {c.count} within 3 standard errors"
        for name in known
        for c in comparisons[name]
    ]
    text = "; ".join(words) or "no unflagged value has a truth"
    return _described(
        figure, f"{title}: difference from the truth in standard errors against time. {text}."
    )


def draw_quicklook(rasters: Sequence[Raster], *, title: str = "") -> Figure:
    """Draw the range-corrected signal against time and range, and the background below.

    Parameters
    ----------
    rasters : sequence of Raster
        At least one, of one instrument and channel.
    title : str, optional

    Returns
    -------
    Figure
        Block means on a logarithmic colour scale, up to the range where noise dominates. Rejected
        bins are black, gaps white.
    """
    figure, (upper, lower) = _stack((3.9, 1.2), title)
    axis = time_axis(_middles(rasters))
    words = panels.image(figure, upper, axis, rasters)
    panels.background(lower, axis, rasters)
    panels.time_ticks([upper, lower], axis)
    return _described(
        figure, f"{title}: range-corrected signal against time and range, and background. {words}."
    )


def draw_backscatter(rasters: Sequence[Raster], *, title: str = "") -> Figure:
    """Draw attenuated backscatter as `draw_quicklook`, with triangles at the lowest cloud bases."""
    figure, (upper, lower) = _stack((3.9, 1.2), title)
    axis = time_axis(_middles(rasters))
    words = panels.image(figure, upper, axis, rasters, "attenuated\nbackscatter")
    panels.background(lower, axis, rasters)
    panels.time_ticks([upper, lower], axis)
    return _described(
        figure, f"{title}: attenuated backscatter against time and range, and background. {words}."
    )


def error_budget_figure(profile: Profile, *, title: str = "") -> Figure:
    """Draw a mean backscatter profile and its error budget.

    Parameters
    ----------
    profile : Profile
        From `lidarops.figures.profile_data.clearest_profile`.
    title : str, optional

    Returns
    -------
    Figure
    """
    figure = Figure(figsize=(10.0, 5.4), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    moment = str(profile.time.astype("datetime64[s]")).replace("T", " ") + " UTC"
    panels.title(figure, f"{title}, {moment}, lidar ratio {profile.lidar_ratio:g} sr")
    profile_panels.backscatter(left, profile)
    profile_panels.error_budget_panels(right, profile)
    for panel in (left, right):
        panels.legend(panel, columns=2)
    bottom, top = (edge / 1e3 for edge in profile.reference)
    return _described(
        figure,
        f"{title}: particle backscatter against range at {moment} with its standard error,"
        f" and the errors from noise, background, reference, lidar ratio and molecules. Reference"
        f" window {bottom:.3g} to {top:.3g} km.",
    )


def scan_profile(profile: ScanProfile, *, title: str = "") -> Figure:
    """Draw optical depth and extinction of one cycle of a scan against altitude.

    Parameters
    ----------
    profile : ScanProfile
        From `lidarops.figures.scan_data.clearest_cycle`.
    title : str, optional

    Returns
    -------
    Figure
        With 1-sigma bands, lighter bands that include the largest error from a horizontal
        gradient, marks at flagged values, a line at the reach, and the truth as a black dashed
        line.
    """
    figure = Figure(figsize=(10.0, 5.8), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    moment = str(profile.time.astype("datetime64[s]")).replace("T", " ") + " UTC"
    panels.title(figure, f"{title}, {moment}")
    scan_panels.against_altitude(left, profile, "optical_depth")
    scan_panels.against_altitude(right, profile, "extinction")
    left.set_ylabel("altitude (km)")
    panels.legend(left, columns=2)
    panels.legend(right, columns=2, other=left)
    return _described(
        figure,
        f"{title}: optical depth and extinction against altitude at {moment}, with standard"
        f" errors and the largest errors from a horizontal gradient. {_scanned(profile)}.",
    )


def scan_residuals(residuals: ScanResiduals, *, title: str = "") -> Figure:
    """Draw the residuals of the fit over zenith angles against beam and altitude.

    Parameters
    ----------
    residuals : ScanResiduals
        From `lidarops.figures.scan_data.read_residuals`.
    title : str, optional

    Returns
    -------
    Figure
        Means over cycles on a diverging colour scale around 0; below, the root mean square by
        beam. For horizontally homogeneous air there is no pattern and no difference between the
        sides.
    """
    figure, (upper, lower) = _stack((3.9, 1.5), title)
    limit = scan_panels.residual_map(figure, upper, residuals)
    scan_panels.residual_rms(lower, residuals)
    panels.legend(lower)
    rms = np.where(np.isfinite(residuals.rms), residuals.rms, -np.inf)
    worst, top = int(np.argmax(rms)), float(residuals.edges[-1]) / 1e3
    return _described(
        figure,
        f"{title}: residuals of the signal against zenith angle of the beam and altitude to"
        f" {top:.3g} km, mean of {counted(residuals.cycles, 'cycle')}; colours to {limit:.2g}"
        f" percent. The root mean square is largest, {rms[worst]:.2g} percent, at a zenith angle"
        f" of {residuals.zenith_angle[worst]:.3g} degrees.",
    )


def draw_extinction(rasters: Sequence[Raster], *, title: str = "") -> Figure:
    """Draw the extinction of scans against time and altitude as `draw_quicklook`."""
    figure, (panel,) = _stack((3.9,), title)
    axis = time_axis(_middles(rasters))
    words = panels.image(figure, panel, axis, rasters, "extinction")
    panel.set_ylabel("altitude (km)")
    panel.set_ylim(bottom=min(float(raster.edges[0]) for raster in rasters) / 1e3)
    panels.time_ticks([panel], axis)
    return _described(figure, f"{title}: extinction against time and altitude. {words}.")


def flags_overview(shares: Mapping[str, Mapping[Quality, float]], *, title: str = "") -> Figure:
    """Draw the share of values that carry each quality bit, by product.

    Parameters
    ----------
    shares : mapping
        Label of a product -> bit -> share of its values, 0 to 1. At least one product.
    title : str, optional

    Returns
    -------
    Figure
        A shaded table of percentages; only bits that occur.
    """
    bits = [bit for bit in Quality if any(share.get(bit, 0.0) > 0 for share in shares.values())]
    labels = [" ".join(visible(label).split()) for label in shares]
    width = 1.5 + 0.085 * max(len(label) for label in labels) + 0.8 * max(len(bits), 5)
    figure = Figure(figsize=(width, 1.9 + 0.32 * len(labels)), dpi=DPI, layout="constrained")
    panel = figure.subplots()
    panels.title(figure, title)
    if not bits:
        panel.set_axis_off()
        panels.nothing(panel, "no value of any product carries a quality bit")
        return _described(figure, f"{title}: no value carries a quality bit.")
    values = np.array([[share.get(bit, 0.0) for bit in bits] for share in shares.values()])
    panel.imshow(values, cmap="Blues", vmin=0.0, vmax=1.3, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        ink = "white" if value > 0.8 else panels.INK if value > 0 else panels.GREY
        panel.text(column, row, percent(value), ha="center", va="center", fontsize=8.5, color=ink)
    names = [bit_name(b) + ("" if b.severity is Severity.REJECT else " *") for b in bits]
    panel.set_xticks(range(len(bits)), names, rotation=30, ha="right", fontsize=9)
    panel.set_yticks(range(len(labels)), labels, fontsize=9, parse_math=False)
    panel.tick_params(length=0)
    panel.spines[:].set_visible(False)
    panel.set_xlabel("share of values; bits with *: use with care, others: do not use")
    row, column = np.unravel_index(int(values.argmax()), values.shape)
    return _described(
        figure,
        f"{title}: share of values by quality bit. The largest share is"
        f" {percent(values[row, column])}, {bit_name(bits[column])} in {labels[row]}.",
    )


def overview(
    homogeneous: xr.Dataset,
    truth: xr.Dataset | None,
    signal: xr.Dataset | None,
    *,
    instrument: str = "",
) -> Figure:
    """Draw one day in two panels: retrieved extinction, and a quicklook of the signal.

    Parameters
    ----------
    homogeneous : Dataset
        Product of kind ``homogeneous``; join the products of several scenes along time.
    truth : Dataset or None
        Truth of a simulated campaign.
    signal : Dataset or None
        Product of kind ``signal`` of any instrument; without it, there is no second panel.
    instrument : str, optional
        Instrument, to select its truth.

    Returns
    -------
    Figure
        1200 x 600 pixels.

    Raises
    ------
    ProductError
        If a product is not of its kind.
    """
    sections = join(read_sections(homogeneous, truth, instrument=instrument))[: panels.SECTIONS]
    rasters = [] if signal is None else [read_raster(signal)]
    # 120 dots per inch, because the figure is shown smaller than in a report.
    figure = Figure(figsize=(10.0, 5.0), dpi=120, layout="constrained")
    stack = list(figure.subplots(1 + len(rasters), 1, sharex=True, squeeze=False)[:, 0])
    axis = time_axis(np.union1d(_times(sections), _middles(rasters)))
    panels.estimates(stack[0], axis, sections, "extinction")
    panels.legend(stack[0], columns=4)
    words = f"Retrieved extinction against time. {_retrieved(sections)}."
    if rasters:
        description = panels.image(figure, stack[1], axis, rasters)
        words = f"{words} Below, range-corrected signal against time and range. {description}."
    panels.time_ticks(stack, axis)
    return _described(figure, words)


@dataclass(frozen=True, slots=True)
class Sketch:
    """A figure to draw. Can be pickled, for another process."""

    draw: Callable[..., Figure]
    """Called with the content and the title."""
    content: object
    title: str


@dataclass(frozen=True, slots=True)
class Rendered:
    """A figure as a PNG file with its description."""

    png: bytes
    alt: str
    """Description in words."""


def render(figure: Figure) -> Rendered:
    """Convert a figure to PNG with its description; equal figures give equal bytes."""
    buffer = io.BytesIO()
    alt = alt_text(figure)
    FigureCanvasAgg(figure)
    figure.savefig(
        buffer,
        format="png",
        metadata={"Software": None, "Description": alt},
        # Higher levels save at most 4 % of size and cost 8 % of the drawing time.
        pil_kwargs={"compress_level": 3},
    )
    return Rendered(buffer.getvalue(), alt)


def draw_figure(_: object, sketch: Sketch) -> Rendered:
    """Draw and render a sketch; the first argument (data of the process) is not used."""
    return render(sketch.draw(sketch.content, title=sketch.title))


def alt_text(figure: Figure) -> str:
    """Return the description of a figure in words."""
    return str(figure.get_label())


def _stack(heights: tuple[float, ...], title: str) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(10.0, 1.1 + sum(heights)), dpi=DPI, layout="constrained")
    stack = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)
    panels.title(figure, title)
    return figure, list(stack[:, 0])


def _described(figure: Figure, words: str) -> Figure:
    figure.set_label(visible(words))
    return figure


def _times(sections: Sequence[Section]) -> Times:
    return np.unique(np.concatenate([section.time for section in sections]))


def _middles(rasters: Sequence[Raster]) -> Times:
    middles = [raster.middle for raster in rasters]
    return np.unique(np.concatenate([*middles, np.array([], dtype="datetime64[ns]")]))


def _retrieved(sections: Sequence[Section]) -> str:
    words = []
    for section in sections:
        estimate, good = section.estimates["extinction"], section.flag == 0
        values = 1e3 * estimate.value[good & np.isfinite(estimate.value)]
        reach = f"{values.min():.3g} to {values.max():.3g} per km" if values.size else "no value"
        flagged = int((~good).sum())
        words.append(f"{section.label}: {reach} unflagged, {flagged} of {good.size} flagged")
    return "; ".join(words)


def _scanned(profile: ScanProfile) -> str:
    values = profile.estimates["extinction"].value
    known = 1e3 * values[np.isfinite(values)]
    span = f"{known.min():.3g} to {known.max():.3g} per km" if known.size else "no usable value"
    flagged, bits = int((profile.flag != 0).sum()), scan_panels.bits_in_words(profile)
    words = [f"extinction {span}", f"{flagged} of {profile.flag.size} altitudes flagged"]
    words[-1] += f" ({bits})" if bits else ""
    if np.isfinite(profile.reach):
        words.append(f"reach {profile.reach / 1e3:.3g} km")
    if profile.truth is not None:
        words.append("with the simulated truth")
    return "; ".join(words)

"""Figures of products.

They are built from `matplotlib.figure.Figure` directly, so that no global state of matplotlib
is changed and any thread may draw. Times are UTC, and every figure says in words what it
shows: `alt_text`.
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
from lidarops.figures.raster import COLUMNS, Raster, read_raster
from lidarops.figures.scan_data import ScanProfile, ScanResiduals, read_extinction
from lidarops.figures.series_data import QUANTITIES, Section, compare, join, read_sections
from lidarops.figures.time_axis import Times, time_axis
from lidarops.figures.wording import bit_name, counted, percent, visible
from lidarops.flags import Quality, Severity

DPI: Final = 150


def retrieval(
    products: Sequence[xr.Dataset],
    truth: xr.Dataset | None = None,
    *,
    title: str = "",
    instrument: str = "",
    channel: str = "",
) -> Figure:
    """Draw extinction and background of homogeneous products against time.

    Parameters
    ----------
    products : sequence of Dataset
        Kind ``homogeneous``, of one instrument and channel, at least one profile in all.
    truth : Dataset, optional
        Of a simulated campaign.
    title : str, optional
    instrument, channel : str, optional
        Whose truth to draw.

    Returns
    -------
    Figure
        Unflagged values with 1-sigma bars or band for every section, flagged ones as hollow
        grey crosses, the truth in black. Extinction in km-1. `alt_text` describes it.

    Raises
    ------
    ProductError
        Where a product is not of this kind.
    """
    sections = [
        section
        for product in products
        for section in read_sections(product, truth, instrument=instrument, channel=channel)
    ]
    return draw_retrieval(join(sections), title=title)


def draw_retrieval(sections: Sequence[Section], *, title: str = "") -> Figure:
    """Draw extinction and background of joined sections; see `retrieval`.

    Parameters
    ----------
    sections : sequence of Section
        One to `panels.SECTIONS`, of one instrument and channel.
    title : str, optional
    """
    axis = time_axis(_times(sections))
    figure, (upper, lower) = _stack((3.0, 2.2), title)
    panels.estimates(upper, axis, sections, "extinction")
    panels.estimates(lower, axis, sections, "background")
    panels.time_ticks([upper, lower], axis)
    panels.legend(upper)
    panels.legend(lower, besides=upper)
    words = f"{title}: retrieved extinction and background against time."
    return _described(figure, f"{words} {_retrieved(sections)}.")


def truth_comparison(
    products: Sequence[xr.Dataset],
    truth: xr.Dataset,
    *,
    title: str = "",
    instrument: str = "",
    channel: str = "",
) -> Figure:
    """Draw (retrieved - truth) / standard error of unflagged values against time.

    Parameters
    ----------
    products, truth, title, instrument, channel
        As in `retrieval`.

    Returns
    -------
    Figure
        One panel for every quantity with a truth, with lines at +-3 and the share of values
        within.

    Raises
    ------
    ProductError
        Where a product is not of this kind.
    """
    sections = [
        section
        for product in products
        for section in read_sections(product, truth, instrument=instrument, channel=channel)
    ]
    return draw_comparison(join(sections), title=title)


def draw_comparison(sections: Sequence[Section], *, title: str = "") -> Figure:
    """Draw normalised errors of joined sections; see `truth_comparison`.

    Parameters
    ----------
    sections : sequence of Section
        One to `panels.SECTIONS`, of one instrument and channel.
    title : str, optional
    """
    axis = time_axis(_times(sections))
    found = {
        name: [c for section in sections if (c := compare(section, name)) is not None]
        for name in QUANTITIES
    }
    known = [name for name in QUANTITIES if found[name]] or ["extinction"]
    figure, stack = _stack((1.9,) * len(known), title)
    for panel, quantity in zip(stack, known, strict=True):
        panels.scores(panel, axis, sections, quantity)
    panels.time_ticks(stack, axis)
    words = [
        f"{c.quantity} {c.section}: {percent(c.within_3)} of {c.count} within 3 standard errors"
        for name in known
        for c in found[name]
    ]
    text = "; ".join(words) or "no unflagged value has a truth"
    return _described(
        figure, f"{title}: difference from the truth in standard errors against time. {text}."
    )


def quicklook(products: Sequence[xr.Dataset], *, title: str = "") -> Figure:
    """Draw the range-corrected signal against time and range, and the background beneath.

    Parameters
    ----------
    products : sequence of Dataset
        Kind ``signal``, of one instrument and channel; may be lazy.
    title : str, optional

    Returns
    -------
    Figure
        Block means on a logarithmic colour scale, to the range where the signal drowns in
        noise; rejected bins black, gaps white.

    Raises
    ------
    ProductError
        Where a product is not of this kind.
    """
    profiles = -(-sum(product.sizes.get("time", 0) for product in products) // COLUMNS)
    return draw_quicklook([read_raster(p, profiles=profiles) for p in products], title=title)


def draw_quicklook(rasters: Sequence[Raster], *, title: str = "") -> Figure:
    """Draw rasters of one instrument and channel, at least one; see `quicklook`."""
    figure, (upper, lower) = _stack((3.9, 1.2), title)
    axis = time_axis(_middles(rasters))
    words = panels.image(figure, upper, axis, rasters)
    panels.background(lower, axis, rasters)
    panels.time_ticks([upper, lower], axis)
    return _described(
        figure, f"{title}: range-corrected signal against time and range, and background. {words}."
    )


def backscatter_quicklook(products: Sequence[xr.Dataset], *, title: str = "") -> Figure:
    """Draw attenuated backscatter against time and range, with clouds, and the background.

    Parameters
    ----------
    products : sequence of Dataset
        Kind ``elastic``, of one instrument and channel; may be lazy.
    title : str, optional

    Returns
    -------
    Figure
        As `quicklook`, with a triangle at the base of the lowest cloud.

    Raises
    ------
    ProductError
        Where a product is not of this kind.
    """
    rasters = [read_raster(p, quantity="attenuated_backscatter") for p in products]
    return draw_backscatter(rasters, title=title)


def draw_backscatter(rasters: Sequence[Raster], *, title: str = "") -> Figure:
    """Draw rasters of attenuated backscatter; see `backscatter_quicklook`."""
    figure, (upper, lower) = _stack((3.9, 1.2), title)
    axis = time_axis(_middles(rasters))
    words = panels.image(figure, upper, axis, rasters, "attenuated\nbackscatter")
    panels.background(lower, axis, rasters)
    panels.time_ticks([upper, lower], axis)
    return _described(
        figure, f"{title}: attenuated backscatter against time and range, and background. {words}."
    )


def error_budget_figure(profile: Profile, *, title: str = "") -> Figure:
    """Draw one mean profile of backscatter, and what its error is made of.

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
        f"{title}: backscatter of particles against range at {moment} with its standard error,"
        f" and the errors by noise, background, reference, lidar ratio and molecules. Reference"
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
        With 1-sigma bands, and lighter ones to which the largest error by a horizontal gradient
        is added; flagged values marked, the reach as a line, the truth in black dashes.
    """
    figure = Figure(figsize=(10.0, 5.8), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    moment = str(profile.time.astype("datetime64[s]")).replace("T", " ") + " UTC"
    panels.title(figure, f"{title}, {moment}")
    scan_panels.against_altitude(left, profile, "optical_depth")
    scan_panels.against_altitude(right, profile, "extinction")
    left.set_ylabel("altitude (km)")
    panels.legend(left, columns=2)
    panels.legend(right, columns=2, besides=left)
    return _described(
        figure,
        f"{title}: optical depth and extinction against altitude at {moment}, with standard"
        f" errors and the largest errors by a horizontal gradient. {_scanned(profile)}.",
    )


def scan_residuals(residuals: ScanResiduals, *, title: str = "") -> Figure:
    """Draw what the fit over angles leaves, against beam and altitude.

    Parameters
    ----------
    residuals : ScanResiduals
        From `lidarops.figures.scan_data.read_residuals`.
    title : str, optional

    Returns
    -------
    Figure
        Means over cycles on a diverging colour scale around 0, and beneath, the root mean
        square by beam. Air in level layers leaves neither pattern nor sides that differ.
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


def extinction_quicklook(products: Sequence[xr.Dataset], *, title: str = "") -> Figure:
    """Draw the extinction of multi-angle products against time and altitude.

    Parameters
    ----------
    products : sequence of Dataset
        Kind ``multiangle``, of one instrument and channel; may be lazy.
    title : str, optional

    Returns
    -------
    Figure
        As `quicklook`, without a background.

    Raises
    ------
    ProductError
        Where a product is not of this kind.
    """
    profiles = -(-sum(product.sizes.get("time", 0) for product in products) // COLUMNS)
    return draw_extinction([read_extinction(p, profiles=profiles) for p in products], title=title)


def draw_extinction(rasters: Sequence[Raster], *, title: str = "") -> Figure:
    """Draw rasters of extinction, at least one; see `extinction_quicklook`."""
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
        A table of percentages, shaded; only bits that occur.
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
    panel.set_xlabel("share of values; bits with * ask for care, the others reject")
    row, column = np.unravel_index(int(values.argmax()), values.shape)
    return _described(
        figure,
        f"{title}: share of values by quality bit. The largest is {percent(values[row, column])}"
        f" {bit_name(bits[column])} in {labels[row]}.",
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
        Of a simulated campaign.
    signal : Dataset or None
        Product of kind ``signal`` of any instrument; the second panel is left out where None.
    instrument : str, optional
        Whose truth to draw.

    Returns
    -------
    Figure
        1200 x 600 pixels.

    Raises
    ------
    ProductError
        Where a product is not of its kind.
    """
    sections = join(read_sections(homogeneous, truth, instrument=instrument))[: panels.SECTIONS]
    rasters = [] if signal is None else [read_raster(signal)]
    # 120 dots per inch suit the smaller text around a figure on a page.
    figure = Figure(figsize=(10.0, 5.0), dpi=120, layout="constrained")
    stack = list(figure.subplots(1 + len(rasters), 1, sharex=True, squeeze=False)[:, 0])
    axis = time_axis(np.union1d(_times(sections), _middles(rasters)))
    panels.estimates(stack[0], axis, sections, "extinction")
    panels.legend(stack[0], columns=4)
    words = f"Retrieved extinction against time. {_retrieved(sections)}."
    if rasters:
        seen = panels.image(figure, stack[1], axis, rasters)
        words = f"{words} Below, the range-corrected signal against time and range. {seen}."
    panels.time_ticks(stack, axis)
    return _described(figure, words)


@dataclass(frozen=True, slots=True)
class Sketch:
    """A figure that is still to be drawn; goes to another process, so all of it can be pickled."""

    draw: Callable[..., Figure]
    """Called with what is to be seen, and the title."""
    of: object
    title: str


@dataclass(frozen=True, slots=True)
class Rendered:
    """A figure as a file."""

    png: bytes
    alt: str
    """What it shows, in words."""


def render(figure: Figure) -> Rendered:
    """Return a figure of this module as PNG with its words; equal figures give equal bytes."""
    buffer = io.BytesIO()
    alt = alt_text(figure)
    FigureCanvasAgg(figure)
    figure.savefig(
        buffer,
        format="png",
        metadata={"Software": None, "Description": alt},
        # To make the files smaller by another 4 % takes a twelfth of the time to draw them.
        pil_kwargs={"compress_level": 3},
    )
    return Rendered(buffer.getvalue(), alt)


def draw_figure(_: object, sketch: Sketch) -> Rendered:
    """Return what comes of a sketch, in whatever process."""
    return render(sketch.draw(sketch.of, title=sketch.title))


def alt_text(figure: Figure) -> str:
    """Return what a figure of this module shows, in words."""
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
    middles = [r.start + (r.stop - r.start) / 2 for r in rasters]
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
    span = f"{known.min():.3g} to {known.max():.3g} per km" if known.size else "none to use"
    flagged, bits = int((profile.flag != 0).sum()), scan_panels.bits_in_words(profile)
    words = [f"extinction {span}", f"{flagged} of {profile.flag.size} altitudes flagged"]
    words[-1] += f" ({bits})" if bits else ""
    if np.isfinite(profile.reach):
        words.append(f"reach {profile.reach / 1e3:.3g} km")
    if profile.truth is not None:
        words.append("with the truth of the simulation")
    return "; ".join(words)

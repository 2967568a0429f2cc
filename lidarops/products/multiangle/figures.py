"""The figures of the ``multiangle`` product: extinction, one scan cycle, residuals, images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, ProductSource, View, image_view
from lidarops.figures.panels import (
    Axis,
    Band,
    Curve,
    Figure,
    Image,
    Layer,
    Mark,
    Palette,
    Panel,
    Tick,
    codes_of,
    finite,
    number,
    percentile_axis,
    span_in_words,
)
from lidarops.figures.series_panels import Quantity
from lidarops.figures.wording import counted, utc
from lidarops.kinds import flags_of
from lidarops.products.multiangle.figure_data import (
    CYCLE_VARIABLES,
    QUANTITIES,
    RESIDUAL_VARIABLES,
    ScanProfile,
    ScanResiduals,
    clearest_cycle,
    read_residuals,
)
from lidarops.products.multiangle.scan_images import (
    VARIABLES,
    draw_scan_images,
    read_scan_image,
)

Floats = NDArray[np.float64]

_SCALES: Final = {
    "vertical_optical_depth": (1.0, "vertical optical depth from the lidar"),
    "total_extinction": (1e3, "total extinction (km⁻¹)"),
}
_EXTINCTION: Final = ImageQuantity("total extinction", 1e3, "km⁻¹", limits=(0.01, 10.0))
"""From clean air at the ground to fog."""
_HEIGHT: Final = 366
_MARKS: Final = 30
"""About the largest number of marks of one kind in a panel."""
_UNCLEAR: Final = 10.0
"""Lower quartiles of the errors beyond which an error does not set the axis."""
_USUAL: Final = 0.97
"""Share of the residuals inside the colour scale."""
_LEAST: Final = 0.01
"""Percent, smallest end of the colour scale."""
_BEAM_TICKS: Final = 24
_NAMED_PLANES: Final = 8
_MAP: Final = 306
"""Height of the map of residuals."""


def _read_cycle(product: xr.Dataset, source: ProductSource) -> ScanProfile | None:
    return clearest_cycle(product, source.truth, instrument=source.instrument)


def _read_residuals(product: xr.Dataset, _: ProductSource) -> ScanResiduals | None:
    return read_residuals(product)


def _draw_cycle(profiles: Sequence[ScanProfile]) -> list[Figure]:
    """Return optical depth and extinction of one scan cycle against altitude."""
    profile = profiles[0]
    extinction = span_in_words(1e3 * profile.estimates["total_extinction"].value, "km⁻¹")
    bits = flags_of("multiangle").raised(int(np.bitwise_or.reduce(profile.flag)))
    names = f" ({', '.join(bit.word for bit in bits)})" if bits else ""
    flagged = int((profile.flag != 0).sum())
    words = [
        f"Extinction {extinction}",
        f"{flagged} of {profile.flag.size} altitudes flagged{names}",
    ]
    if np.isfinite(profile.reach):
        words.append(f"reach {profile.reach / 1e3:.3g} km")
    caption = f"Scan cycle at {utc(profile.time)} (most unflagged values)"
    z = profile.altitude / 1e3
    ground = z[0] if profile.truth is None else min(z[0], profile.truth.edges[0] / 1e3)
    y = Axis("altitude (km)", float(ground), float(z[-1] + 0.02 * (z[-1] - ground) or z[-1] + 1.0))
    panels = tuple(_cycle(profile, name, y) for name in QUANTITIES)
    return [Figure(caption, "; ".join(words), panels, beside=True)]


def _cycle(profile: ScanProfile, quantity: str, y: Axis) -> Panel:
    """Return a quantity of one cycle with its errors, flags, reach and truth."""
    scale, label = _SCALES[quantity]
    estimate, z = profile.estimates[quantity], profile.altitude / 1e3
    of_channel = {cause: np.nan_to_num(part) for cause, part in estimate.of_channel.items()}
    value = scale * estimate.value
    error = scale * np.sqrt(
        estimate.standard_error**2 + sum(part**2 for part in of_channel.values())
    )
    words = ", with the ".join(["standard error", *(n for n, v in of_channel.items() if v.any())])
    whole = error + scale * np.nan_to_num(estimate.gradient_error)
    truth = _truth(profile, quantity, scale)
    # A truth beyond the reach, such as a cloud, does not set the axis.
    reached = truth.y <= np.fmin(profile.reach, profile.altitude[-1]) / 1e3
    clear = _clear(value, error)
    spans = [(value - error)[clear], (value + error)[clear], truth.x[reached]]
    if not finite(spans).size:
        spans = [scale * estimate.rejected]
    x = percentile_axis(label, spans, share=0.5, room=0.08)
    layers: list[Layer] = [
        Band(
            z, value - whole, value + whole, "c0 wide", upright=True, label="largest gradient error"
        ),
        Band(z, value - error, value + error, upright=True, label=words),
        Curve(value, z, label="retrieved"),
        truth,
        *_flagged(profile, quantity, scale, x),
    ]
    if np.isfinite(profile.reach):
        level = np.full(2, profile.reach / 1e3)
        reach = f"reach, {profile.reach / 1e3:.3g} km"
        layers.append(Curve(np.array([x.low, x.high]), level, "ink thin d3", label=reach))
    return Panel(x, y, tuple(layers), _HEIGHT)


def _clear(value: Floats, error: Floats) -> NDArray[np.bool_]:
    """Return which values set the axis: not those whose errors would hide all others."""
    known = np.isfinite(value) & np.isfinite(error)
    if not known.any():
        return known
    low, middle = np.percentile(error[known], [25.0, 50.0])
    usual = np.abs(value[known & (error <= middle)]).max()
    return np.asarray(known & (error <= max(_UNCLEAR * low, usual)))


def _truth(profile: ScanProfile, quantity: str, scale: float) -> Curve:
    """Return the truth, empty if unknown; means over cells are steps."""
    truth = profile.truth
    if truth is None:
        return Curve(np.array([]), np.array([]))
    late = round((truth.time - profile.time) / np.timedelta64(1, "m"))
    label = f"truth at zenith angle {truth.zenith_angle:.3g}°, {late:+d} min"
    if quantity == "vertical_optical_depth":
        return Curve(scale * truth.optical_depth, truth.edges / 1e3, "ink d1", label=label)
    edges = np.repeat(truth.edges / 1e3, 2)[1:-1]
    return Curve(scale * np.repeat(truth.extinction, 2), edges, "ink d1", label=label)


def _flagged(profile: ScanProfile, quantity: str, scale: float, x: Axis) -> list[Curve]:
    """Return marks at values to use with care, values not to use, altitudes without a value."""
    estimate, z = profile.estimates[quantity], profile.altitude / 1e3
    known, rejected = np.isfinite(estimate.value), np.isfinite(estimate.rejected)
    marks = []
    for where, value, style, mark, words in (
        (
            profile.with_care & known,
            scale * estimate.value,
            "ink hollow",
            Mark.DISC,
            "use with care",
        ),
        (rejected, scale * estimate.rejected, "soft hollow", Mark.CROSS, "do not use"),
        (~known & ~rejected, np.full(z.size, x.low), "soft", Mark.DASH, "no value"),
    ):
        index = np.flatnonzero(where)
        if index.size:
            some = index[:: -(-index.size // _MARKS)]
            label = f"{words}: {counted(index.size, 'altitude')}"
            marks.append(Curve(value[some], z[some], style, mark, joined=False, label=label))
    return marks


def _draw_residuals(contents: Sequence[ScanResiduals]) -> list[Figure]:
    """Return the residuals against beam and altitude, and below their rms by beam.

    For horizontally homogeneous air there is no pattern and no difference between the sides.
    """
    residuals = contents[0]
    limit = max(_usual(residuals), _LEAST)
    beams = np.arange(residuals.zenith_angle.size, dtype=np.float64)
    ticks = tuple(
        Tick(float(k), number(float(f"{residuals.zenith_angle[k]:.3g}")))
        for k in _marked_beams(residuals.plane)
    )
    x = Axis(_beam_label(residuals), -0.5, beams.size - 0.5, ticks=ticks)
    y = Axis("altitude (km)", float(residuals.edges[0]) / 1e3, float(residuals.edges[-1]) / 1e3)
    image = Image(
        codes_of(0.5 + 0.5 * residuals.mean.T / limit),
        beams - 0.5,
        beams + 0.5,
        residuals.edges / 1e3,
        Palette.SIGNED,
    )
    planes = [
        Curve(np.full(2, cut + 0.5), np.array([y.low, y.high]), "ink thin")
        for cut in np.flatnonzero(np.diff(residuals.plane))
    ]
    bar = Axis("residual, 100 ln(signal / fit) (%)", -limit, limit)
    upper = Panel(x, y, (image, *planes), height=_MAP, bar=bar)
    lower = Panel(x, Axis("rms (%)", 0.0, _top(residuals)), _rms(residuals, beams), height=110)
    rms = np.where(np.isfinite(residuals.rms), residuals.rms, -np.inf)
    worst = int(np.argmax(rms))
    words = (
        f"Mean of {counted(residuals.cycles, 'cycle')}, colours to {limit:.2g} percent; the root"
        f" mean square is largest, {rms[worst]:.2g} percent, at a zenith angle of"
        f" {residuals.zenith_angle[worst]:.3g} degrees{_sides(residuals)}"
    )
    return [Figure("Residuals of the fit against zenith angle and altitude", words, (upper, lower))]


def _usual(residuals: ScanResiduals) -> float:
    """Return the absolute mean residual below which `_USUAL` of all residuals lie.

    Cells that few cycles reach count little, because they are mostly noise.
    """
    size, count = np.abs(residuals.mean).ravel(), residuals.count.ravel()
    order = np.argsort(np.where(count > 0, size, np.inf), kind="stable")
    share = np.cumsum(count[order])
    return float(size[order[np.searchsorted(share, _USUAL * share[-1])]])


def _top(residuals: ScanResiduals) -> float:
    return 1.1 * float(finite([residuals.rms]).max()) or 1.0


def _rms(residuals: ScanResiduals, beams: Floats) -> tuple[Layer, ...]:
    """Return the rms residual of every beam, and the part that does not average out."""
    # Of a volume, each cycle may hold other beams.
    many = not np.allclose(residuals.rms, residuals.rms_of_mean, equal_nan=True)
    label = "single cycles" if many else "one cycle of each beam"
    single = Curve(beams, residuals.rms, mark=Mark.DISC, joined=False, label=label)
    if not many:
        return (single,)
    label = f"mean of {residuals.cycles:,} cycles"
    mean = Curve(beams, residuals.rms_of_mean, "c1", Mark.SQUARE, joined=False, label=label)
    return single, mean


def _marked_beams(plane: NDArray[np.intp]) -> list[int]:
    """Return the beams that have a tick: the same ones of each plane."""
    starts = np.flatnonzero(np.diff(plane, prepend=-1))
    shown = starts[:: -(-starts.size // _BEAM_TICKS)]
    ends = [*starts[1:], plane.size]
    members = [range(start, ends[np.searchsorted(starts, start)]) for start in shown]
    step = -(-max(map(len, members)) * len(members) // _BEAM_TICKS)
    return [beam for own in members for beam in own[::step]]


def _beam_label(residuals: ScanResiduals) -> str:
    """Return the label of the axis of beams, which is short enough for a thumbnail."""
    if np.isnan(residuals.azimuths).any():
        return "zenith angle (°), azimuth not known"
    if len(residuals.azimuths) == 1:
        return f"zenith angle (°), positive toward {residuals.azimuths[0]:.4g}°"
    return "zenith angle of the beam (°)"


def _sides(residuals: ScanResiduals) -> str:
    """Return the azimuths of the positive zenith angles of several planes, as they are drawn."""
    if len(residuals.azimuths) < 2:
        return ""
    beams = np.bincount(residuals.plane)
    sides = [
        ("unknown" if np.isnan(azimuth) else f"{azimuth:.4g}")
        + (" (one beam)" if number == 1 else "")
        for azimuth, number in zip(residuals.azimuths, beams, strict=True)
    ]
    more = ", ..." if len(sides) > _NAMED_PLANES else ""
    return (
        "; from left to right, positive zenith angles point toward azimuth"
        f" {', '.join(sides[:_NAMED_PLANES])}{more} degree"
    )


FIGURES: Final = KindFigures(
    (
        image_view("multiangle", "total_extinction", _EXTINCTION, "altitude"),
        View("scan-profile", CYCLE_VARIABLES, _read_cycle, _draw_cycle, first=True),
        View("scan-image", VARIABLES, read_scan_image, draw_scan_images, first=True),
        View("scan-residuals", RESIDUAL_VARIABLES, _read_residuals, _draw_residuals, first=True),
    ),
    preferred="vertical_optical_depth",
    values=(Quantity("total_extinction", 1e3, "km⁻¹"), Quantity("vertical_optical_depth", 1.0, "")),
)

"""Panels of multi-angle products: the profile of a cycle, and residuals of the fit by beam."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from lidarops.figures.panels import GREY, INK
from lidarops.figures.wording import counted
from lidarops.kinds import flags_of
from lidarops.products.multiangle.figure_data import ProfileEstimate, ScanProfile, ScanResiduals

Floats = NDArray[np.float64]

_BLUE: Final = "#0072B2"
_VERMILION: Final = "#D55E00"
_SCALES: Final = {
    "optical_depth": (1.0, "optical depth from the lidar"),
    "extinction": (1.0e3, "extinction (km$^{-1}$)"),
}
_MARKS: Final = 30
"""About the largest number of marks of one kind in a panel."""
_COLORS: Final = "berlin"
"""Diverging, perceptually uniform, readable with colour vision deficiency (Crameri)."""
_HATCHED: Final = 0.25
"""Cells below this share of the negative colour scale are hatched, because both ends of a diverging
scale look alike in grey."""
_USUAL: Final = 0.97
"""Share of the residuals inside the colour scale."""
_LEAST: Final = 0.01
"""Percent, smallest end of the colour scale."""
_BEAM_TICKS: Final = 24


def against_altitude(panel: Axes, profile: ScanProfile, quantity: str) -> None:
    """Draw a quantity of one cycle with its errors, flags, reach and truth.

    Parameters
    ----------
    panel : Axes
    profile : ScanProfile
    quantity : {"optical_depth", "extinction"}
    """
    scale, label = _SCALES[quantity]
    estimate, z = profile.estimates[quantity], profile.altitude / 1e3
    value, error = scale * estimate.value, scale * estimate.standard_error
    whole = error + scale * estimate.gradient_error
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.fill_betweenx(
        z,
        value - whole,
        value + whole,
        facecolor=_BLUE,
        edgecolor=_BLUE,
        alpha=0.18,
        linewidth=0.8,
        linestyle=":",
        label="plus largest error from a gradient",
        gid=f"gradient-{quantity}",
    )
    panel.fill_betweenx(
        z,
        value - error,
        value + error,
        color=_BLUE,
        alpha=0.4,
        linewidth=0,
        label="$\\pm$1 standard error",
        gid=f"error-{quantity}",
    )
    panel.plot(value, z, color=_BLUE, linewidth=1.2, label="retrieved", gid=f"values-{quantity}")
    _truth(panel, profile, quantity, scale)
    panel.set_xlim(*_limits(profile, quantity, scale))
    _flagged(panel, profile, quantity, scale)
    if np.isfinite(profile.reach):
        panel.axhline(
            profile.reach / 1e3,
            color=INK,
            linewidth=1.0,
            linestyle="-.",
            label=f"reach, {profile.reach / 1e3:.3g} km",
            gid="reach",
        )
    ground = profile.altitude[0] if profile.truth is None else profile.truth.edges[0]
    bottom, top = min(float(ground) / 1e3, float(z[0])), float(z[-1])
    panel.set_ylim(bottom, top + 0.02 * (top - bottom))
    panel.set_xlabel(label)


def _truth(panel: Axes, profile: ScanProfile, quantity: str, scale: float) -> None:
    known = _true_line(profile, quantity)
    if known is None or profile.truth is None:
        return
    value, z = known
    late = float((profile.truth.time - profile.time) / np.timedelta64(1, "m"))
    panel.plot(
        scale * value,
        z / 1e3,
        color="black",
        linewidth=1.1,
        linestyle=(0, (4, 2)),
        zorder=4,
        label=f"truth at zenith angle {profile.truth.zenith_angle:.3g}°, {late:+.0f} min",
        gid=f"truth-{quantity}",
    )


def _true_line(profile: ScanProfile, quantity: str) -> tuple[Floats, Floats] | None:
    """Return values and altitudes of the truth; means over cells as steps."""
    truth = profile.truth
    if truth is None:
        return None
    if quantity == "optical_depth":
        return truth.optical_depth, truth.edges
    return np.repeat(truth.extinction, 2), np.repeat(truth.edges, 2)[1:-1]


def _limits(profile: ScanProfile, quantity: str, scale: float) -> tuple[float, float]:
    low, high = _reached(profile.estimates[quantity])
    known = _true_line(profile, quantity)
    if known is not None:
        value, z = known
        # Only up to the reach, so that a cloud above it does not set the axis.
        top = np.fmin(profile.reach, profile.altitude[-1])
        shown = value[np.isfinite(value) & (z <= top)]
        low, high = np.min([low, *shown]), np.max([high, *shown])
    margin = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    return scale * float(low - margin), scale * float(high + margin)


def _reached(estimate: ProfileEstimate) -> tuple[float, float]:
    if not np.isfinite(estimate.value).any():
        return _span(estimate.rejected, 0.0 * estimate.rejected)
    low, high = _span(estimate.value, estimate.standard_error)
    systematic = np.nan_to_num(estimate.gradient_error)
    # The systematic error widens the axis to three times the profile at most.
    outer = _span(estimate.value, estimate.standard_error + systematic)
    return max(outer[0], 2 * low - high), min(outer[1], 2 * high - low)


def _span(value: Floats, error: Floats) -> tuple[float, float]:
    """Return limits that contain the error bars except those of a few noisy altitudes."""
    ends = np.concatenate([value - error, value + error, value])
    known = ends[np.isfinite(ends)]
    low, high = np.percentile(known, [0.5, 99.5]) if known.size else (0.0, 1.0)
    return float(low), float(high)


def _flagged(panel: Axes, profile: ScanProfile, quantity: str, scale: float) -> None:
    """Mark values to use with care, values not to use, and altitudes without a value."""
    estimate, z = profile.estimates[quantity], profile.altitude / 1e3
    low, high = panel.get_xlim()
    care = np.flatnonzero(profile.with_care & np.isfinite(estimate.value))
    rejected = np.flatnonzero(np.isfinite(estimate.rejected))
    empty = np.flatnonzero(~np.isfinite(estimate.value) & ~np.isfinite(estimate.rejected))
    for kind, index, x, marker, words in (
        ("care", care, scale * estimate.value, "o", "use with care"),
        ("flagged", rejected, scale * estimate.rejected, "X", "do not use"),
        ("empty", empty, np.full(z.size, low), 9, "no value"),
    ):
        if index.size == 0:
            continue
        some = index[:: -(-index.size // _MARKS)]
        (marks,) = panel.plot(
            np.clip(x[some], low, high),
            z[some],
            linestyle="none",
            clip_on=False,
            marker=marker,
            markersize=4.5,
            markerfacecolor="none",
            markeredgecolor=INK if kind == "care" else GREY,
            markeredgewidth=0.8,
            zorder=1.9,
            label=f"{words}: {counted(index.size, 'altitude')}",
            gid=f"{kind}-{quantity}",
        )
        # Marks at the edge extend beyond the panel; the layout must not make room for them.
        marks.set_in_layout(False)


def bits_in_words(profile: ScanProfile) -> str:
    """Return the names of all quality bits of a profile; empty without any."""
    bits = flags_of("multiangle").raised(int(np.bitwise_or.reduce(profile.flag)))
    return ", ".join(bit.word for bit in bits)


# Residuals -----------------------------------------------------------------------------------


def residual_map(figure: Figure, panel: Axes, residuals: ScanResiduals) -> float:
    """Draw mean residuals against beam and altitude; return the end of the colour scale (%)."""
    panel.set_facecolor("#bbbbbb")
    limit = max(_usual(residuals), _LEAST)
    across = np.arange(residuals.zenith_angle.size + 1) - 0.5
    up = residuals.edges / 1e3
    mesh = panel.pcolormesh(
        across,
        up,
        np.ma.masked_invalid(residuals.mean),
        cmap=colormaps[_COLORS],
        vmin=-limit,
        vmax=limit,
        gid="residual",
    )
    negative = np.ma.masked_where(~(residuals.mean < -_HATCHED * limit), residuals.mean)
    if not negative.mask.all():
        panel.pcolor(
            across,
            up,
            negative,
            cmap=ListedColormap(["none"]),
            edgecolor="white",
            linewidth=0,
            hatch="////",
            gid="negative",
        )
    bar = figure.colorbar(mesh, ax=panel, pad=0.01, extend="both", fraction=0.05)
    bar.set_label("residual, 100 ln(signal / fit) (%)")
    panel.set_ylabel("altitude (km)")
    panel.spines[["top", "right"]].set_visible(False)
    panel.text(
        0.0,
        1.01,
        f"hatched: below $-${_HATCHED * limit:.2g} %; light grey: no residual",
        transform=panel.transAxes,
        fontsize=8.5,
        color=INK,
    )
    _planes(panel, residuals)
    return limit


def _usual(residuals: ScanResiduals) -> float:
    """Return the absolute mean residual below which `_USUAL` of all residuals lie.

    Cells that few cycles reach count little, because they are mostly noise.
    """
    size, count = np.abs(residuals.mean).ravel(), residuals.count.ravel()
    order = np.argsort(np.where(count > 0, size, np.inf), kind="stable")
    share = np.cumsum(count[order])
    return float(size[order[np.searchsorted(share, _USUAL * share[-1])]])


def residual_rms(panel: Axes, residuals: ScanResiduals) -> None:
    """Draw the rms residual of every beam, and the part that does not average out."""
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(axis="y", color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    beams = np.arange(residuals.zenith_angle.size)
    many = residuals.cycles > 1
    panel.plot(
        beams,
        residuals.rms,
        linestyle="none",
        marker="o",
        markersize=5.0,
        color=_BLUE,
        label="single cycles" if many else "one cycle",
        gid="rms",
    )
    if many:
        panel.plot(
            beams,
            residuals.rms_of_mean,
            linestyle="none",
            marker="_",
            markersize=9.0,
            markeredgewidth=2.0,
            color=_VERMILION,
            label=f"mean of {residuals.cycles:,} cycles",
            gid="rms-of-mean",
        )
    panel.set_ylim(bottom=0.0)
    panel.yaxis.set_major_locator(MaxNLocator(4))
    panel.set_ylabel("rms (%)")
    some = beams[:: -(-beams.size // _BEAM_TICKS)]
    panel.set_xticks(
        some, [f"{residuals.zenith_angle[k]:.3g}".replace("-", "\u2212") for k in some]
    )
    panel.set_xlabel(_beam_label(residuals))
    _planes(panel, residuals)


def _planes(panel: Axes, residuals: ScanResiduals) -> None:
    for cut in 1 + np.flatnonzero(np.diff(residuals.plane)):
        panel.axvline(cut - 0.5, color=INK, linewidth=1.2, gid="plane")
    panel.set_xlim(-0.5, residuals.zenith_angle.size - 0.5)


def _beam_label(residuals: ScanResiduals) -> str:
    names = [
        "azimuth not known" if np.isnan(azimuth) else f"azimuth {azimuth:.4g}°"
        for azimuth in residuals.azimuths
    ]
    if not names:
        return "zenith angle of the beam (°)"
    toward = "; ".join(names[:4]) + ("; ..." if len(names) > 4 else "")
    return f"zenith angle of the beam (°), positive toward {toward}"

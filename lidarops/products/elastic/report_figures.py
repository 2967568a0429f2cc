"""The figures of the ``elastic`` product in reports: backscatter, a profile, its error budget."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lidarops.figures import panels
from lidarops.figures.kind_figures import ReportFigure, ReportFigures
from lidarops.figures.panels import GREY, INK
from lidarops.figures.product_figures import DPI, described, image_figures
from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.wording import utc
from lidarops.products.elastic.figure_data import PROFILE_VARIABLES, Profile, clearest_profile
from lidarops.products.elastic.figures import IMAGE

_BLUE: Final = "#0072B2"
_STYLES: Final = {
    "noise": ("signal noise", "#0072B2", "-"),
    "background": ("background", "#D55E00", "--"),
    "reference": ("reference", "#009E73", "-."),
    "lidar_ratio": ("lidar ratio", "#CC79A7", (0, (4, 1, 1, 1, 1, 1))),
    "molecular": ("molecules", "#000000", ":"),
}
_MEGA: Final = 1e6
_UNITS: Final = "Mm$^{-1}$ sr$^{-1}$"


def _figures(group: Group, sources: Sources) -> Iterator[ReportFigure]:
    yield from image_figures(IMAGE, "Attenuated backscatter, clouds and background", group, sources)
    profile = sources.read_first(group, PROFILE_VARIABLES, clearest_profile)
    if profile is not None:
        yield ReportFigure(
            "profile",
            f"Profile with the most unflagged bins in a scene, and its error budget:"
            f" {group.label}.",
            error_budget_figure,
            profile,
        )


REPORT: Final = ReportFigures(_figures)


def error_budget_figure(profile: Profile, *, title: str = "") -> Figure:
    """Draw a mean backscatter profile and its error budget.

    Parameters
    ----------
    profile : Profile
        From `lidarops.products.elastic.figure_data.clearest_profile`.
    title : str, optional

    Returns
    -------
    Figure
    """
    figure = Figure(figsize=(10.0, 5.4), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    moment = utc(profile.time)
    panels.title(figure, f"{title}, {moment}, lidar ratio {profile.lidar_ratio:g} sr")
    _backscatter(left, profile)
    _error_budget(right, profile)
    for panel in (left, right):
        panels.legend(panel, columns=2)
    bottom, top = (edge / 1e3 for edge in profile.reference)
    return described(
        figure,
        f"{title}: particle backscatter against range at {moment} with its standard error,"
        f" and the errors from noise, background, reference, lidar ratio and molecules. Reference"
        f" window {bottom:.3g} to {top:.3g} km.",
    )


def _backscatter(panel: Axes, profile: Profile) -> None:
    """Draw particle backscatter with its standard error, and molecular backscatter."""
    _against_range(panel, profile)
    r = profile.range / 1e3
    value, error = _MEGA * profile.backscatter, _MEGA * profile.standard_error
    panel.fill_betweenx(r, value - error, value + error, color=_BLUE, alpha=0.3, linewidth=0)
    panel.plot(value, r, color=_BLUE, linewidth=1.0, label="particles, $\\pm$1 standard error")
    panel.plot(
        _MEGA * profile.molecular, r, color=INK, linewidth=1.0, linestyle=":", label="molecules"
    )
    if profile.with_care.any():
        some = np.flatnonzero(profile.with_care & np.isfinite(value))[::10]
        panel.plot(
            value[some],
            r[some],
            linestyle="none",
            marker="o",
            markersize=4.0,
            markerfacecolor="none",
            markeredgecolor=INK,
            label="use with care",
        )
    panel.axvline(0.0, color=INK, linewidth=0.8)
    inside = value[np.isfinite(value)]
    if inside.size:
        # Percentiles, so that a few noisy bins do not set the axis.
        low, high = np.percentile(inside, [0.5, 99.5])
        margin = 0.15 * max(high - low, 0.1 * high)
        panel.set_xlim(low - margin, high + margin)
    panel.set_xlabel(f"backscatter ({_UNITS})")
    panel.set_ylabel("range (km)")


def _error_budget(panel: Axes, profile: Profile) -> None:
    """Draw the error from each cause, and the total standard error."""
    _against_range(panel, profile)
    r = profile.range / 1e3
    for cause, values in profile.budget.items():
        label, color, style = _STYLES[cause]
        panel.plot(_MEGA * values, r, color=color, linewidth=1.1, linestyle=style, label=label)
    total = _MEGA * profile.standard_error
    panel.plot(total, r, color=GREY, linewidth=2.2, alpha=0.6, label="standard error")
    panel.set_xscale("log")
    known = total[np.isfinite(total) & (total > 0)]
    if known.size:
        panel.set_xlim(1e-3 * known.max(), 2.0 * known.max())
    panel.set_xlabel(f"error of backscatter ({_UNITS})")


def _against_range(panel: Axes, profile: Profile) -> None:
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    bottom, top = (edge / 1e3 for edge in profile.reference)
    panel.axhspan(bottom, top, color=GREY, alpha=0.18, linewidth=0, label="reference window")
    panel.set_ylim(0.0, float(profile.range[-1]) / 1e3)

"""The figures of the ``multiangle`` product in reports: extinction, one cycle, residuals."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from lidarops.figures import panels
from lidarops.figures.kind_figures import ReportFigure, ReportFigures
from lidarops.figures.product_figures import DPI, described, image_figures, stack
from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.wording import counted, utc
from lidarops.products.multiangle import report_panels
from lidarops.products.multiangle.figure_data import (
    CYCLE_VARIABLES,
    RESIDUAL_VARIABLES,
    ScanProfile,
    ScanResiduals,
    clearest_cycle,
    read_residuals,
)
from lidarops.products.multiangle.figures import IMAGE


def _figures(group: Group, sources: Sources) -> Iterator[ReportFigure]:
    yield from image_figures(IMAGE, "Extinction over time and altitude", group, sources)
    clearest = partial(clearest_cycle, instrument=group.instrument)
    profile = sources.read_first(group, CYCLE_VARIABLES, clearest, with_truth=True)
    if profile is not None:
        yield ReportFigure(
            "scan-profile",
            f"Scan cycle with the most unflagged values in a scene: {group.label}.",
            scan_profile,
            profile,
        )
    residuals = sources.read_first(group, RESIDUAL_VARIABLES, read_residuals)
    if residuals is not None:
        yield ReportFigure(
            "scan-residuals",
            f"Residuals of the fit over zenith angle, mean over the cycles of a scene:"
            f" {group.label}.",
            scan_residuals,
            residuals,
        )


REPORT: Final = ReportFigures(_figures)


def scan_profile(profile: ScanProfile, *, title: str = "") -> Figure:
    """Draw optical depth and extinction of one cycle of a scan against altitude.

    Parameters
    ----------
    profile : ScanProfile
        From `lidarops.products.multiangle.figure_data.clearest_cycle`.
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
    moment = utc(profile.time)
    panels.title(figure, f"{title}, {moment}")
    report_panels.against_altitude(left, profile, "optical_depth")
    report_panels.against_altitude(right, profile, "extinction")
    left.set_ylabel("altitude (km)")
    panels.legend(left, columns=2)
    panels.legend(right, columns=2, other=left)
    return described(
        figure,
        f"{title}: optical depth and extinction against altitude at {moment}, with standard"
        f" errors and the largest errors from a horizontal gradient. {_scanned(profile)}.",
    )


def scan_residuals(residuals: ScanResiduals, *, title: str = "") -> Figure:
    """Draw the residuals of the fit over zenith angles against beam and altitude.

    Parameters
    ----------
    residuals : ScanResiduals
        From `lidarops.products.multiangle.figure_data.read_residuals`.
    title : str, optional

    Returns
    -------
    Figure
        Means over cycles on a diverging colour scale around 0; below, the root mean square by
        beam. For horizontally homogeneous air there is no pattern and no difference between the
        sides.
    """
    figure, (upper, lower) = stack((3.9, 1.5), title)
    limit = report_panels.residual_map(figure, upper, residuals)
    report_panels.residual_rms(lower, residuals)
    panels.legend(lower)
    rms = np.where(np.isfinite(residuals.rms), residuals.rms, -np.inf)
    worst, top = int(np.argmax(rms)), float(residuals.edges[-1]) / 1e3
    return described(
        figure,
        f"{title}: residuals of the signal against zenith angle of the beam and altitude to"
        f" {top:.3g} km, mean of {counted(residuals.cycles, 'cycle')}; colours to {limit:.2g}"
        f" percent. The root mean square is largest, {rms[worst]:.2g} percent, at a zenith angle"
        f" of {residuals.zenith_angle[worst]:.3g} degrees.",
    )


def _scanned(profile: ScanProfile) -> str:
    values = profile.estimates["extinction"].value
    known = 1e3 * values[np.isfinite(values)]
    span = f"{known.min():.3g} to {known.max():.3g} per km" if known.size else "no usable value"
    flagged, bits = int((profile.flag != 0).sum()), report_panels.bits_in_words(profile)
    words = [f"extinction {span}", f"{flagged} of {profile.flag.size} altitudes flagged"]
    words[-1] += f" ({bits})" if bits else ""
    if np.isfinite(profile.reach):
        words.append(f"reach {profile.reach / 1e3:.3g} km")
    if profile.truth is not None:
        words.append("with the simulated truth")
    return "; ".join(words)

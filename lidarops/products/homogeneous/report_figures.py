"""The figures of the ``homogeneous`` product in reports: values, and values against the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidarops.figures import panels
from lidarops.figures.kind_figures import ReportFigure, ReportFigures
from lidarops.figures.product_figures import described, draw_series, middles, stack, times
from lidarops.figures.raster import read_raster
from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.series_data import Section, compare, join
from lidarops.figures.time_axis import time_axis
from lidarops.figures.wording import counted, percent
from lidarops.products.homogeneous.figure_data import (
    QUANTITIES,
    SECTION_VARIABLES,
    read_sections,
)
from lidarops.records import Role, SceneOutcome
from lidarops.steps.conditioning import Dark


def _figures(group: Group, sources: Sources) -> Iterator[ReportFigure]:
    read = [
        partial(
            read_sections,
            instrument=group.instrument,
            channel=group.channel,
            paths=[item.path for item in scene.inputs if item.role is Role.SIGNAL],
            dark_subtracted=_dark_subtracted(scene, group.channel),
        )
        for scene, _ in group.members
    ]
    by_scene = list(sources.read_all(group, SECTION_VARIABLES, read, with_truth=True))
    unjoined = [section for sections in by_scene for section in sections]
    sections = [section for section in join(unjoined) if section.time.size > 0]
    compared = [compare(section, quantity) for section in sections for quantity in QUANTITIES]
    sources.compare(group, compared)
    for first in range(0, len(sections), panels.SECTIONS):
        few = sections[first : first + panels.SECTIONS]
        where = f"{group.label}, {', '.join(section.label for section in few)}"
        yield ReportFigure(
            "homogeneous",
            f"Extinction and background with their standard errors: {where};"
            f" {counted(len(by_scene), 'scene')}.",
            draw_retrieval,
            few,
        )
        if any(compared):
            yield ReportFigure(
                "truth",
                f"Unflagged values compared with the simulated truth: {where}.",
                draw_comparison,
                few,
            )


def _dark_subtracted(scene: SceneOutcome, channel: str) -> bool:
    steps = scene.plan.steps if scene.plan else ()
    return any(step.name == Dark.name and step.channel == channel for step in steps)


REPORT: Final = ReportFigures(_figures, compares=True)


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
    figure, _ = draw_series(sections, ("extinction", "background"), title=title)
    words = f"{title}: retrieved extinction and background against time."
    return described(figure, f"{words} {_retrieved(sections)}.")


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
    axis = time_axis(times(sections))
    comparisons = {
        name: [c for section in sections if (c := compare(section, name)) is not None]
        for name in QUANTITIES
    }
    known = [name for name in QUANTITIES if comparisons[name]] or ["extinction"]
    figure, scores = stack((1.9,) * len(known), title)
    for panel, quantity in zip(scores, known, strict=True):
        panels.scores(panel, axis, sections, quantity)
    panels.time_ticks(scores, axis)
    words = [
        f"{c.quantity} {c.section}: {percent(c.within_3)} of {c.count} within 3 standard errors"
        for name in known
        for c in comparisons[name]
    ]
    text = "; ".join(words) or "no unflagged value has a truth"
    return described(
        figure, f"{title}: difference from the truth in standard errors against time. {text}."
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
    axes = list(figure.subplots(1 + len(rasters), 1, sharex=True, squeeze=False)[:, 0])
    axis = time_axis(np.union1d(times(sections), middles(rasters)))
    panels.estimates(axes[0], axis, sections, "extinction")
    panels.legend(axes[0], columns=4)
    words = f"Retrieved extinction against time. {_retrieved(sections)}."
    if rasters:
        description = panels.image(figure, axes[1], axis, rasters)
        words = f"{words} Below, range-corrected signal against time and range. {description}."
    panels.time_ticks(axes, axis)
    return described(figure, words)


def _retrieved(sections: Sequence[Section]) -> str:
    words = []
    for section in sections:
        estimate, good = section.estimates["extinction"], section.flag == 0
        values = 1e3 * estimate.value[good & np.isfinite(estimate.value)]
        reach = f"{values.min():.3g} to {values.max():.3g} per km" if values.size else "no value"
        flagged = int((~good).sum())
        words.append(f"{section.label}: {reach} unflagged, {flagged} of {good.size} flagged")
    return "; ".join(words)

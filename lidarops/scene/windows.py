"""The bins of a channel that its products need, so that only these are read."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import Final

from lidarops.raw.header import Stretches
from lidarops.records import PlannedStep
from lidarops.retrieve.signal.counts_to_signal import MIN_NOISE_BINS
from lidarops.retrieve.signal.thresholds import THRESHOLDS
from lidarops.scene.case import ChannelCase
from lidarops.scene.channels import prepared_channels, range_offset
from lidarops.settings import SettingsModel

ANALOG_NOISE: Final = "the noise of an analog record is estimated from all its bins"


WINDOW: Final = "range_window"
"""Name of the entry of a plan by which a product states the bins that it needs."""


class WindowSettings(SettingsModel):
    """The bins that a product needs of a channel; `read_windows` joins those of all products."""

    bins: tuple[tuple[int, int], ...]
    """First bin and the one past the last, of each stretch that is read."""


def read_windows(steps: Collection[PlannedStep]) -> dict[str, Stretches]:
    """Return the channels of which only some bins are needed, with these bins."""
    windows: dict[str, list[tuple[int, int]]] = {}
    for step in steps:
        if step.name == WINDOW and not idle_window(step, steps):
            settings = WindowSettings.model_validate(step.settings)
            windows.setdefault(step.channel, []).extend(settings.bins)
    return {channel: tuple(merged(stretches)) for channel, stretches in windows.items()}


def merged(stretches: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return stretches of bins, ascending, with touching ones merged and empty ones left out."""
    kept: list[tuple[int, int]] = []
    for first, past in sorted(stretches):
        if kept and first <= kept[-1][1]:
            kept[-1] = (kept[-1][0], max(kept[-1][1], past))
        elif first < past:
            kept.append((first, past))
    return kept


def idle_window(step: PlannedStep, steps: Collection[PlannedStep]) -> str:
    """Return why a range window has no effect; empty where it has one, or for other steps.

    Such a window stays in the plan, because the plan stated in a product must not depend on the
    other products of the scene.

    Parameters
    ----------
    step : PlannedStep
    steps : collection of PlannedStep
        All steps of the scene.
    """
    if step.name != WINDOW:
        return ""
    estimates = [s for s in steps if s.name == "dead_time" and "analog" in s.settings]
    if any(step.channel in (s.channel, s.settings["analog"]) for s in estimates):
        return "the estimate of a dead time needs all bins"
    windowed = {
        (other.channel, other.product)
        for other in steps
        if other.name == WINDOW and other.instrument == step.instrument
    }
    needing = list(
        dict.fromkeys(
            other.product if other.channel == step.channel else other.channel
            for other in steps
            if other.instrument in ("", step.instrument)
            and other.product
            and step.channel in prepared_channels(steps, other.channel)
            and (other.channel, other.product) not in windowed
        )
    )
    if not needing:
        return ""
    return f"{' and '.join(needing)} need{'s' if len(needing) == 1 else ''} all bins"


def bins_with_noise(nearest: float, farthest: float, case: ChannelCase) -> tuple[int, int]:
    """Return the bins of counts between ranges in m, with those that their noise needs.

    The variance of a count is that of the mean over a share of the range on either side.

    Returns
    -------
    (int, int)
        The first bin, and the one past the last, which may lie beyond the channel.
    """
    width, offset = case.channel.bin_width, range_offset(case.channel, case.facts)

    def margin(distance: float) -> int:
        # Two for rounding.
        return max(math.ceil(THRESHOLDS.noise_window * distance / width), MIN_NOISE_BINS) + 2

    first = math.floor((nearest - offset) / width) - margin(nearest)
    return max(first, 0), math.ceil((farthest - offset) / width) + margin(farthest)


def bins_within(nearest: float, farthest: float, case: ChannelCase) -> tuple[int, int]:
    """Return the bins of counts between ranges in m, without a margin for their noise.

    For bins that are averaged: the noise at the ends then comes from fewer bins.
    """
    width, offset = case.channel.bin_width, range_offset(case.channel, case.facts)
    # Two for rounding.
    first = math.floor((nearest - offset) / width) - 2
    return max(first, 0), max(math.ceil((farthest - offset) / width) + 2, 0)

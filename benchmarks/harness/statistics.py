"""Means, shares and root mean squares with their Monte Carlo errors."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.harness.figure import Array, Figure, Mask, share

TWO_SIDED: Final = 1.959963984540054
"""Standard deviations that hold 95 percent of a normal distribution."""
SIGMAS: Final = (1.0, TWO_SIDED)
"""Standard errors within which truths are counted."""
_LIMIT_WITHOUT_EVENTS: Final = -math.log(0.05)
"""Expected events of which none are seen in 5 percent of all cases."""


def clustered_share(events: Array, trials: Array, effect: float = 1.0) -> Figure:
    """Return a share of counts in independent clusters.

    Parameters
    ----------
    events, trials : (cluster,) float
        Counts.
    effect : float
        Design effect of values of the same clusters (`design_effect`). So many values count as one
        where there are too few events to show how they scatter.
    """
    total = float(trials.sum())
    if total == 0.0:
        return share(0.0)
    value = float(events.sum()) / total
    # Without events, 2 errors are the 95 percent limit of the share: 3 over the number of values.
    least = 0.5 * _LIMIT_WITHOUT_EVENTS * effect / total
    return share(Figure(value, max(_scatter(events, trials), min(least, 0.5))))


def design_effect(events: Array, trials: Array) -> float:
    """Return the number of values in clusters that tell as much as one independent value.

    At least 1; it is the variance of the share over that of independent values.
    """
    total = float(trials.sum())
    value = float(events.sum()) / total if total else 0.0
    independent = value * (1.0 - value) / total if total else 0.0
    return max(_scatter(events, trials) ** 2 / independent, 1.0) if independent else 1.0


def _scatter(events: Array, trials: Array) -> float:
    """Return the error of a share from the scatter of its clusters."""
    total = float(trials.sum())
    value = float(events.sum()) / total
    return float(np.sqrt(np.sum((events - value * trials) ** 2))) / total


def mean_by_block(values: npt.NDArray[np.generic], kept: Mask, block: int) -> Figure | None:
    """Return the mean of kept values, with its error from the scatter between blocks.

    Parameters
    ----------
    values : (profile, ...) float or bool
    kept : (profile, ...) bool
    block : int
        Profiles of a block.

    Returns
    -------
    Figure or None
        None where nothing is kept. The mean is a ratio of sums over blocks, and so is its error.
    """
    blocks = -(-len(values) // block)
    edges = np.arange(blocks) * block
    totals = np.add.reduceat(_sums(np.where(kept, values, 0.0)), edges)
    counts = np.add.reduceat(_sums(kept.astype(np.float64)), edges)
    count = counts.sum()
    if count == 0:
        return None
    average = totals.sum() / count
    scatter = np.sum((totals - average * counts) ** 2) * blocks / max(blocks - 1, 1)
    return Figure(float(average), float(np.sqrt(scatter) / count))


def share_by_block(inside: Mask, kept: Mask, block: int) -> Figure | None:
    """Return the share of kept values that are inside, with an error above 0."""
    value = mean_by_block(inside, kept, block)
    if value is None:
        return None
    profiles = int(np.count_nonzero(_sums(kept.astype(np.float64))))
    # Half a profile keeps the error above zero where all or none are inside.
    probability = (value.value * profiles + 0.5) / (profiles + 1)
    least = math.sqrt(probability * (1 - probability) / profiles)
    return share(Figure(value.value, max(value.error, least)))


def root_by_block(errors: Array, kept: Mask, block: int) -> Figure | None:
    """Return the root mean square of kept errors, with its error from the scatter of blocks."""
    square = mean_by_block(errors**2, kept, block)
    if square is None:
        return None
    value = math.sqrt(square.value)
    return Figure(value, square.error / (2.0 * value) if value > 0 else 0.0)


def _sums(values: Array) -> Array:
    return np.asarray(values.reshape(len(values), -1).sum(axis=1))

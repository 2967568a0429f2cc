"""Thresholds of the reference window, each with what set it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Limits of the window in which a profile has the shape of clean air."""

    steps_per_window: int = 4
    """Candidates that start within the width of one. Assumed."""
    fewest_bins: int = 8
    """Bins with data. Assumed."""
    least_share: float = 0.5
    """Share of the bins of a window that must hold data. Assumed."""
    most_deviation: float = 3.0
    """Standard errors by which a window may depart from the shape of air or exceed the lowest ratio
    to it, and must exceed zero. Assumed: 1 % of clean windows fail."""
    undetected_particles: float = 1.5
    """Standard errors of the difference from the lowest ratio by which undetected particles may
    raise a window. Simulations (`test_noisy_windows_state_what_they_cannot_see`, 1000 profiles):
    of the values beside a background of 3e6 counts, 0.28 % deviate by more than 4 errors; without
    the error of the lowest ratio, 4.0 %."""
    most_windows: int = 10_000
    """Candidates; more are taken for a mistake of units. Assumed."""


THRESHOLDS: Final = Thresholds()

"""Thresholds of the reference window, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
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
    undetected_particles: float = 0.5
    """Errors of the lowest ratio by which particles that the comparison cannot show may raise a
    window beside the measured excess. With a layer of scattering ratio 1.15 in all windows but the
    lowest, less than 0.1 % of backscatter is false for 0.5, 0.44 % for 0
    (`test_a_layer_in_most_windows_gives_few_false_values`). From 1 on, more than 98 % of
    backscatter at 355 nm is covered where there is none."""
    most_noise: float = 1.3
    """Error of a window over the least one of equally clean windows, up to which a higher one is
    preferred, because particles decrease with height. In the published Raman simulation,
    particles of the best determined windows make backscatter at 532 nm too small by a quarter
    (`tests/retrieve/raman/test_raman_published.py`)."""
    most_windows: int = 10_000
    """Candidates; more are taken for a mistake of units. Assumed."""


THRESHOLDS: Final = Thresholds()

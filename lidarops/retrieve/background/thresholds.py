"""Thresholds by which backgrounds are estimated and judged, in one place."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Numbers of the background stage, dimensionless unless stated.

    The last words of each entry state what set the number; "assumed" where nothing is recorded.
    """

    tail_share: float = 0.1
    """Share of the bins, the farthest, whose mean is the background by default; usual practice."""
    fewest_bins: int = 8
    """Bins below which a mean, a fit or a test is not trusted; assumed."""
    least_known: float = 0.5
    """Least share of the bins of a background that are known. Where saturated bins are left out,
    the rest is the lower part of the noise, whose mean is phi(z) / share standard deviations of a
    bin too low (`selection_bias`): 0.8 at a half, within the noise of a bin, and 1.0 at 0.38."""

    lag_share: float = 0.4
    """Lag of the cubic over the number of bins: least scatter; benchmark of accuracy."""
    lowest_contrast: float = 10.0
    """Least curvature of the quartic at its minimum over the contribution of the noise. Below, it
    may be the wrong minimum, and the standard error is too small by a factor of 2; simulations."""
    largest_shift: float = 1.0
    """Standard errors by which signal curvature, mistaken for noise, may shift the cubic;
    assumed."""

    start_shares: tuple[float, ...] = (0.3, 0.4, 0.5, 0.6, 0.7)
    """Starts of the windows of the known shape, over the farthest usable range; assumed."""
    false_alarm: float = 1e-4
    """Probability that the residuals of a fit are called systematic where its shape is right;
    chosen."""
    rejection: float = 1e-2
    """Probability that a window is rejected where the shape is right; chosen."""
    aerosol_odds: float = 0.05
    """Odds of aerosol between the starts of two windows, before the data are seen; simulations of
    the benchmark of stability: 95 % of the backgrounds are within 1.96 standard errors, 96 % with
    0.08, 92.5 % with 0."""
    negative: float = 3.0
    """Standard errors below zero beyond which an amplitude is flagged negative; assumed."""
    largest_condition: float = 30.0
    """Standard error of the background over that of the mean of the same bins, beyond which the
    shape does not differ from a constant; assumed."""
    nearest: float = 0.6
    """Begin of the window that is compared with the tail, over the start of the tail; assumed."""
    farthest: float = 0.7
    """End of that window, over the start of the tail; assumed."""
    detected: float = 3.0
    """Standard errors by which signal before the tail is detected; assumed."""
    share_of_error: float = 0.5
    """Largest shift of a value by signal left in the tail that raises no flag, over the standard
    error of the value; assumed."""
    shape_error: float = 0.2
    """Relative error of the signal in the tail as computed from the shape of clean air, caused by
    aerosol in the far range; simulations with haze of 12 percent of the air there."""


THRESHOLDS: Final = Thresholds()

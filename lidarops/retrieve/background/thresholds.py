"""Thresholds by which backgrounds are estimated and judged, in one place."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Numbers of the background stage, dimensionless unless stated.

    The last words of each entry state what set the number; "assumed" where nothing is recorded.
    """

    tail_share: float = 0.1
    """Share of the bins, the farthest, whose mean is the background by default; usual practice."""

    lag_share: float = 0.4
    """Lag of the cubic over the number of bins: least scatter; benchmark of accuracy."""
    lowest_contrast: float = 10.0
    """Least curvature of the quartic at its minimum over the contribution of the noise. Below, it
    may be the wrong minimum, and the standard error is too small by a factor of 2; simulations."""
    largest_shift: float = 1.0
    """Standard errors by which signal curvature, mistaken for noise, may shift the cubic;
    assumed."""

    nearest_start: float = 0.3
    """Start of the longest window of the known shape, over the farthest usable range; assumed."""
    rejection: float = 1.1e-2
    """Probability that a window is rejected where the shape is right. With 1e-3, errors of clean
    ranges are 7 % smaller, but .4 instead of .3 % of elastic values beside bright sky are false;
    simulations."""
    aerosol_odds: float = 0.055
    """Odds of aerosol between the starts of two windows, before the data are seen; the same
    simulations."""
    largest_condition: float = 30.0
    """Standard error of the background over that of the mean of the same bins, beyond which the
    shape does not differ from a constant; assumed."""
    nearest: float = 0.6
    """Begin of the window that is compared with the tail, over the start of the tail; assumed."""
    farthest: float = 0.7
    """End of that window, over the start of the tail; assumed."""
    share_of_error: float = 0.5
    """Largest shift of a value by signal left in the tail that raises no flag, over the standard
    error of the value; assumed."""
    shape_error: float = 0.2
    """Relative error of the signal in the tail as computed from the shape of clean air, caused by
    aerosol in the far range; simulations with haze of 12 percent of the air there."""


THRESHOLDS: Final = Thresholds()

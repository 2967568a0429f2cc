"""Thresholds of the homogeneous path, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Limits of the search and of the tests."""

    # The search
    lowest_extinction: float = -0.3
    """1 / last range. Where extinction approaches -1 / range, the shape stops falling and a second
    minimum appears. Simulations: 7 % of the fits end there with -0.5 / length, none above this."""
    highest_optical_depth: float = 60.0
    """Over the section: the signal vanishes after two of 225 bins. Assumed."""
    largest_optical_depth: float = 300.0
    """Over the section, of a given extinction: beyond, the exponential leaves the range of floats.
    """
    least_curvature: float = 0.3
    """Curvature over that of Gauss-Newton, below which a step is one of Gauss-Newton. Assumed."""

    # The tests
    largest_relative_error: float = 0.15
    """Standard error of extinction over extinction + 1 / mean range, and over 1 / (2 bin widths).
    Simulations: above the first, coverage of the accepted values falls below 0.93; without the
    second, 18 to 19 % of the values are false where the signal falls by a factor of 400 to 1e6 in a
    bin."""
    false_alarm: float = 4e-4
    """Rate at which one test of residuals flags a profile that obeys the model. Assumed: half of
    the target of 1e-3 for needless flags."""
    fewest_differences: int = 5
    """Second differences; with fewer, the noise is estimated from the residuals. Assumed."""
    false_estimated: float = 5.7e-4
    """Share of the values beyond 4 standard errors by the scatter of an estimated noise, above
    which NOISE_UNCERTAIN marks them: fewer than 32 bins. Simulations: selection by the same noise
    adds up to 4e-4 to backgrounds, and 1e-3 is what the stability benchmark tolerates."""
    false_curved: float = 7e-4
    """Probability beyond the deviation of a curvature that `curved_widening` allows for; 3 to 4 in
    a thousand backgrounds near the limit of determination are more than 4 errors off. Simulations:
    with less, 95 % intervals hold more than 97 %."""
    model_error: float = 0.05
    """Departure of the logarithmic slope from the model, as a share of 2 (extinction + 1 / mean
    range). Simulations: reduces false values among accepted ones by a factor of 7."""

    # The product
    full_overlap: float = 0.99
    """Least overlap of the bins that are used. Assumed."""
    level: float = 100.0
    """m; largest change of height along a section. Aerosol decreases with a scale height of 1 to
    2 km; a larger change mimics an extinction of more than some percent. Assumed."""


THRESHOLDS: Final = Thresholds()

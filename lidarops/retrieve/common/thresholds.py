"""Thresholds that several retrievals share, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Limits of significance, of bins that are enough, and of what air does within some bins."""

    fewest_profiles: int = 5
    """Profiles, or parts of a mean, of which one may be left out or unlike the others: at most a
    fifth. Assumed."""
    fewest_bins: int = 8
    """Bins below which a mean, a window, a fit or a test is not trusted; assumed."""
    least_share: float = 0.5
    """Least share of the bins of a window or background that are known. Where saturated bins are
    left out, the rest is the lower part of the noise, whose mean is phi(z) / share standard
    deviations of a bin too low (`selection_bias` in `lidarops.retrieve.background.estimate`): 0.8
    at a half, within the noise of a bin, and 1.0 at 0.38."""
    by_noise: float = 2.0
    """Standard errors that noise explains: where a signal is back at its level, in the spread of
    neighbours, of an optical depth below zero. 2.3 percent of values are beyond by chance; assumed.
    """
    significant: float = 3.0
    """Standard errors from which a deviation is no chance: of a window of clean air (1 percent of
    which fail), signal left in a background, a negative amplitude, curved signals, changes of a
    field, correlated noise, and backscatter for a lidar ratio. Below, no error of a lidar ratio is
    symmetrical; with 5, none is left at 355 nm of the published simulations."""
    contradicted: float = 4.0
    """Standard errors beyond what is possible at which a value contradicts the signal or its
    overlap. Of 3,000 profiles of simulated haze, 1 does
    (`test_raman_coverage.py`); in Manaus at 355 nm, where the overlap is not full as stated, values
    lie 57 below."""
    first_order: float = 5.0
    """Standard errors by which a signal, slope or denominator must exceed zero for first-order
    errors to hold, of a fifth at most; else noise gives paths, and dead times of up to 100 ns
    (`test_noise_shows_no_dead_time`)."""
    single_bin: float = 5.0
    """Standard deviations up to which the deviation of a single bin is taken as its noise: beyond,
    it is a spike, or outlying among residuals; within, its neighbours decide about a limit.
    Assumed."""
    outlier: float = 6.0
    """Standard errors that noise does not reach: of none of 1e8 bins from all their neighbours, and
    at most 5.4 of strong channels of 12 real dark files (`tests/scene/test_laser_off.py`)."""
    largest_step: float = 0.1
    """Relative change of a signal across a bin that air may cause, by the means of both sides: for
    a visibility of 2 km; a cloud attenuates by more. Assumed."""
    false_alarm: float = 0.001
    """Probability that noise gives a cloud in a profile, as products require it, an outlying part
    of a mean, a lag, or a gradient in a block."""
    misfit_false_alarm: float = 1e-4
    """Probability of a chi-square as large as that of a fit, below which the fit is poor; chosen.
    """


THRESHOLDS: Final = Thresholds()

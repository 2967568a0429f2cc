"""Thresholds of the steps from counts to signals, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Limits of conversion, noise model, dark signals, lag and gluing."""

    # Photon counting
    paralysis: float = 0.5
    """Measured rate times dead time above which a rate cannot be corrected. Assumed."""
    pile_up: float = 0.1
    """Relative dead-time correction above which PILE_UP is raised. Assumed."""
    uncorrected_pile_up: float = 0.01
    """The same where the dead time is unknown, so that nothing is corrected. Assumed."""
    largest_dead_time_error: float = 0.08
    """Relative error of a rate by one standard error of the dead time above which it is rejected.
    With 20 %, the rate of a paralyzable counter deviates by 1.5 of these errors here, by 2.4 at
    0.10, and beyond 0.117 it has none: m tau stays below 1 / e. Computed."""

    # Parts of a mean
    most_parts: int = 16
    """Parts into which the profiles of a mean are divided: 15 profiles of 2 minutes in half an hour
    are parts of their own. More parts take more memory and have more noise. Assumed."""
    cell_length: float = 30.0
    """m; in which signals of parts are averaged, half of the shortest window in which a cloud is
    found."""
    cloud_contrast: float = 3.0
    """Factor of the rise at a cloud, at 532 nm. The scattering ratio of aerosol rarely rises by
    this factor within 2 km, that of thin cirrus does. Assumed."""

    # Analog
    baseline: float = 0.02
    """mV, standard error of the baseline where nothing shows it. Blocked beams of a real lidar show
    0.1 to 10 uV (Champaign, 2018), dark files of another 0.1 to 2 uV (Sao Paulo, 2017). With 0.01,
    0.5 percent of backscatter is false with +40 uV that fall to 1/e in 4 km."""
    baseline_share: float = 7.5e-4
    """Share of the largest power of the profile by which the baseline may be off after it:
    undershoot after a peak reaches 0.3 %, four times this."""
    baseline_decay: float = 3000.0
    """m, range in which that falls to 1/e; assumed."""
    near_full_scale: float = 0.5
    """Share of full scale above which a bin is tested for clipped shots. Assumed."""
    clipping: float = 3.5
    """Standard deviations of a shot by which the mean must lie below full scale: clipping shifts
    the mean by 6e-5 of that deviation there, and by more above."""
    fine: float = 0.5
    """Variance of a shot in squared digitiser steps above which rounding is neglected. The error
    that does not average out is below 1e-4 steps there."""

    # Noise
    noise_window: float = 0.1
    """Half-width, relative to range, of the window in which noise is smoothed. Assumed."""
    leak: float = 0.02
    """Share of a squared third difference that may come from the fall of the signal. Assumed."""
    outlying_block: float = 8.0
    """Noise variance of a block over that of the others from which it is a cloud edge."""
    darkest: float = 0.5
    """Least noise variance over that in the far half, where the signal lies below its level."""
    significant_band: float = 3.5
    """Standard errors beyond which the noise of a band differs from the line. With 0 the stated
    variance of white noise scatters five times as much in the first bins of 16,380."""

    noise_sample: int = 32
    """Blocks of a band, which give its noise within 5 %, and fewest bins of a section, which give a
    correlation within 0.1."""

    # Correlation of noise
    noise_sections: int = 8
    """Parts of the far half of a profile. Assumed."""
    most_correlated_bins: int = 10
    """Greatest distance at which noise is correlated, bins. Assumed."""

    # Dark signals
    session_gap: float = 1800.0
    """s; dark files farther apart belong to different sessions. Assumed."""
    variance_window: int = 65
    """Bins over which the scatter of repeats is averaged, and that of the noise that gives a lag:
    that of 3 repeats alone is off by 100 %."""

    # Lag
    largest_lag: int = 30
    """Bins; largest lag that is searched. Assumed."""
    fewest_lag_bins: int = 200
    """Bins between the largest lags. Assumed."""
    high_pass: int = 17
    """Bins of the running mean that is subtracted to leave the noise. Assumed."""
    peak_width: int = 4
    """Bins on either side of a peak that belong to it; a lag is applied up to an error of half of
    them (`test_a_lag_that_parts_of_the_range_contradict_is_not_significant`). Assumed."""

    # Gluing
    count_rates: tuple[float, float] = (0.5, 20.0)
    """MHz; between them photon counting, corrected for dead time, is linear and above its noise.
    Specification of the elastic chain."""
    least_snr: float = 10.0
    """Signal-to-noise ratio of analog in the window. Specification of the elastic chain."""
    least_fall: float = 1.5
    """Factor by which the smoothed count rate must fall within a window: bins without a sufficient
    fall give the slope of their noise. Assumed."""
    smoothing: int = 31
    """Bins over which signals are averaged before the window is chosen. Edges that follow the noise
    of single bins would bias the slope. Assumed."""
    largest_misfit: float = 1.5
    """Chi-square of the line over its degrees of freedom, for many bins. Assumed."""

    # Dead time against analog (`dead_time`).
    highest_load: float = 0.95
    """Share of dead time up to which bins count. An error of 1 percent in the slope of analog
    changes the dead time by 1 / load - 1 percent: of a real scan, loads up to 0.5 give 4.4 and
    5.2 ns, all 5.9 and 6.3; with 6.2 and 6.8 ns, its optical depth is that of other azimuths."""
    least_load: float = 0.1
    """Share that the largest must reach: at 0.08, an analog baseline of 1 uV makes a dead time 10
    stated errors too small (`test_a_baseline_shows_no_dead_time`)."""
    analog_nonlinearity: float = 0.01
    """Share by which the largest analog signal may be wrong, and smaller ones by less in
    proportion. Assumed; without it the error is 3 to 10 times too small
    (`test_a_nonlinear_analog_record_lies_within_the_error`)."""
    least_rate: float = 1.0
    """MHz, rate from which bins count: below, noise gives 100 ns (the same test)."""
    dead_time_block: int = 2
    """Bins that are averaged; few, because the rate is no linear function of the light; assumed."""

    # Profiles without light (`light`).
    tells_of_light: float = 220.0
    """The same of a channel that tells: a twentieth, 11, shows in all but 1 of 10,000 profiles."""
    telling_share: float = 0.1
    """Share of the profiles that show light in a channel that tells, and of those that may show
    less than `tells_of_light`. Assumed."""


THRESHOLDS: Final = Thresholds()

"""Thresholds of the multi-angle retrieval, in one place; compiled modules (numba) build them in."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Numbers of the multi-angle retrieval, dimensionless unless stated.

    The last words of each entry state what set the number; "assumed" where nothing is recorded.
    """

    # Directions and cycles (`scan_cycles`, `slant_paths`).
    same_direction: float = 0.25
    """degree by which readings of one direction may differ; assumed."""
    widest_direction: float = 3.0
    """Largest spread of the profiles of one direction, in `same_direction`: a wider group is a
    slow sweep; assumed."""
    finest_direction: float = 0.01
    """degree, smallest tolerance of a direction; resolution of encoders, assumed."""
    same_plane: float = 1.0
    """degree by which azimuths in one vertical plane may differ; assumed."""
    longest_pause: float = 3.0
    """Median intervals between profiles beyond which a pause starts a cycle: more than two
    profiles are lost; assumed."""
    lost_dwell: float = 1.5
    """Longest dwells beyond which a pause is longer than one lost file; assumed."""
    spherical_beyond: float = 75.0
    """degree beyond which the path follows the curvature of the Earth; below, the secant errs by
    less than 0.3 percent of the path up to 2.7 km, and 1.1 percent up to 10 km, by the formula."""
    longest_path: float = 19.2
    """Slant over vertical path beyond which a beam is left out: 3 degrees of elevation."""

    # Obstructions (`analog_baseline`).
    obstruction_block: float = 60.0
    """m, length of the blocks of bins that are compared; assumed."""
    obstruction_signal: float = 20.0
    """Standard errors of the next blocks, in the signal of one, of which they may be called dark;
    formula: noise alone does not make four blocks dark that hold a tenth of it."""
    obstruction_drop: float = 0.02
    """Share of the signal of a block below which the blocks from 60 m behind it are dark. Behind a
    tree 0.3 percent were left (355 nm, photon counting); fog with an extinction of 10 km-1 leaves
    9 percent, and noise."""

    # Analog baseline (`analog_baseline`).
    lowest_free: float = 20.0
    """degree of elevation from which no tree or building blocks a beam: what ends it is a cloud;
    assumed."""
    baseline_guard: float = 300.0
    """m behind an obstruction from which the record shows no echo of it, and shortest block over
    which the baseline is averaged there: in the beam of a real scan it falls from 25 to 2 uV within
    100 m behind the first 100 m, and to its noise."""
    baseline_light: float = 0.1
    """Power behind an obstruction over that of free beams from which it is light: an echo at the
    window of a lidar without overlap nearby is no obstruction; assumed."""
    baseline_share: float = 0.2
    """Length of a block over its range, where that is more; assumed."""

    # Background (`beam_backgrounds`).
    common_background: float = 0.5
    """Share of the variance of backgrounds, by signal in the far range, that all beams have in
    common; assumed."""

    # Correlation along altitude (`altitude_correlation`, `beam_backgrounds`).
    most_correlated: float = 0.98
    """Largest correlation at neighbouring altitudes: one altitude then counts as a hundredth;
    assumed."""

    # Samples (`_block`).
    lowest_snr: float = 1.5
    """Signal over noise, means of an altitude and the next four, below which a beam ends; with 3,
    optical depths in weak light are 15 percent less exact (`benchmarks.accuracy`, SNR 300), and
    fewer have a value."""

    # Fit at single altitudes (`_block`, `optical_depth`).
    pooled: int = 15
    """Altitudes over which the inhomogeneity is pooled; assumed."""
    fewest_freedom: float = 4.1
    """Least degrees of freedom n in Student's variance n / (n - 2), which diverges at 2: the
    variance is at most doubled; by definition."""
    least_span: float = 0.1
    """Span of slant paths below which a scan or a plane is not retrieved: 0 to 25 degrees;
    assumed."""
    least_share: float = 0.9
    """Data share below which the prior determines the extinction of "mld" and "mld_prior"; by
    definition."""

    # Horizontal gradient (`_block`, `_horizontal_variation`, `optical_depth`).
    gradient_variance: float = 9.0
    """Variance of an optical depth that the fit of a gradient may add, over that without it: beams
    to one side, as of a cycle that is cut short, add 11 to 800, those to both sides less than 9; by
    geometry (`test_a_cycle_cut_short_fits_no_gradient_that_its_beams_cannot_tell`)."""
    gradient_window: float = 1000.0
    """m, window in which the residuals are tested for a gradient; assumed."""
    gradient_noise: float = 0.04
    """Variance of a logarithm from which a sample is left out of that test. Noisier samples are
    biased, and together look like a gradient: deviations from level air are 1.1 standard errors
    without them, 1.4 with them (`test_level_air_shows_no_gradient`)."""
    largest_gradient: float = 3e-4
    """m-1, gradient beyond which residuals show no gradient of air: in haze with 2e-4 to one side,
    no optical depth deviates by more than 4 stated errors, with 5e-4 every fourth does. Distorted
    analog signals of scans up to 25 degrees of elevation show 2e-3 and more."""

    # Stratification (`_horizontal_variation`).
    growth: float = 1.5**2
    """Ratio of the variances in the upper and the lower third up to which they count as equal;
    assumed."""
    growth_certainty: float = 2.5
    """Standard errors by which the logarithm of that ratio must exceed zero: with `growth`, 0.3
    percent false alarms; simulations."""

    # Smoothness and its errors (`smooth_profile`).
    least_smooth_freedom: float = 2.0
    """Degrees of freedom below which a weight of smoothness is not allowed: a straight line and one
    more; by definition."""
    scale_height: float = 2000.0
    """m over which extinction may change by its mean: scale height of aerosol. Without a limit of
    smoothness, extinctions and optical depths around the top of a haze are false
    (`test_errors_around_the_top_of_a_haze_cover_the_truth`)."""
    fewest_to_choose: int = 8
    """Profiles from which one weight of smoothness is chosen, and errors are calibrated; with
    fewer, solutions are averaged; by coverage in the ten scenes of `test_smooth_profile`."""
    pilot: float = 0.01
    """Weight of smoothness of the pilot solution over that of the solution; by coverage in the same
    scenes."""
    least_scale: float = 0.7
    """Least scale of the smoothing error of a profile, because a thin haze may still have a sharp
    layer. With 1, errors would be too large where profiles differ by noise alone; simulations."""


THRESHOLDS: Final = Thresholds()

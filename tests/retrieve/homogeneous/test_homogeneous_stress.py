"""Hard cases of the homogeneous path, for the direct solver.

Signals are in units of the noise, extinction in km-1 in the tables; unless stated otherwise, there
are 225 bins from 2.5 km over 8 km.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mpmath as mp
import numpy as np
import pytest
from support.cases import each
from support.mean_counts import mean_profile_variance
from support.oracles.homogeneous import (
    GEOMETRIES,
    amplitude,
    brute_force,
    lowest_errors,
    quartic_derivative,
    real_roots,
    section,
    signal,
)

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import HomogeneousResult, fit_homogeneous_path

KM = 1e-3
LONG = section(2500.0, 8000.0)
FIELDS = tuple(HomogeneousResult.__dataclass_fields__)
WEAK = 0.03 * KM
UNDETERMINED = (
    Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED | HomogeneousQuality.AT_BOUND
)

NONE = Quality(0)


def noise(count, bins=225, seed=0):
    return np.random.default_rng(seed).normal(size=(count, bins))


def clean(count=1000, height=1000.0, extinction=WEAK, seed=0, r=LONG):
    return 370.0 + signal(r, height, extinction) + noise(count, r.size, seed)


def assert_same(one, other):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def rows_of(fit, rows):
    return HomogeneousResult(**{name: getattr(fit, name)[rows] for name in FIELDS})


def share(fit, bits):
    return float(np.mean((fit.quality & int(bits)) != 0))


# The robustness table -----------------------------------------------------------------------


def gap(power):
    power[:, 80:140] = np.nan


def scattered(power):
    power[np.random.default_rng(1).random(power.shape) < 0.3] = np.nan


def no_near_range(power):
    power[:, :20] = np.inf


def negative_background(power):
    power -= 372.0


def saturated(power):
    np.minimum(power, 370.0 + 600.0, out=power)


def saturated_masked(power):
    power[power >= 969.9] = np.nan


def overlap(power, far):
    power -= signal(LONG, 1000.0, WEAK) * np.exp(-((LONG / far) ** 2))


def overlap_near(power):
    overlap(power, 1000.0)


def overlap_far(power):
    overlap(power, 2000.0)


def cloud(power):
    power[:, 100:104] += 200.0


def spike(power):
    power[:, 150] += 8.0


def constant(power):
    power[:] = 5.0


def zeros(power):
    power[:] = 0.0


def pure_noise(power):
    power[:] = noise(*power.shape, seed=2)


def all_missing(power):
    power[:] = np.nan


def seven_bins(power):
    power[:, 7:] = np.nan


def three_bins(power):
    power[:, 3:] = np.nan


def inverted(power):
    power *= -1.0


def untouched(power):
    del power


@dataclass(frozen=True)
class Outcome:
    """Expected result for 1000 profiles with noise of known variance 1."""

    change: object
    every: Quality = NONE
    """Bits raised in every profile."""
    accepted: tuple[float, float] = (0.0, 0.0)
    """Share of profiles without a rejecting bit."""
    scatter: float | None = None
    """Standard deviation of extinction as measured in the study, km-1."""
    bias: tuple[float, float] = (-0.15, 0.15)
    """Of extinction, in standard errors; where a scatter is given."""
    chi2: tuple[float, float] = (0.0, np.inf)
    """Median."""
    background: float = 370.0
    missing: tuple[str, ...] = field(default=())
    """Values that must be NaN."""


ALL = ("background", "amplitude", "extinction", "reduced_chi2")
MOST = (0.99, 1.0)
TABLE = {
    "clean": Outcome(untouched, accepted=MOST, scatter=0.000319, chi2=(0.98, 1.02)),
    "gap": Outcome(gap, accepted=MOST, scatter=0.000339),
    "scattered": Outcome(scattered, accepted=MOST, scatter=0.00039),
    "no near range": Outcome(no_near_range, accepted=MOST, scatter=0.00055),
    "negative background": Outcome(
        negative_background, accepted=MOST, scatter=0.000319, background=-2.0
    ),
    "saturated": Outcome(
        saturated, HomogeneousQuality.POOR_FIT | HomogeneousQuality.AT_BOUND, chi2=(500.0, 5000.0)
    ),
    "saturated, masked": Outcome(
        lambda power: (saturated(power), saturated_masked(power)), accepted=MOST, scatter=0.00056
    ),
    # No test can detect it: an overlap mask is needed. This is a limit.
    "overlap at 1 km": Outcome(
        overlap_near,
        accepted=(0.9, 1.0),
        scatter=0.000319,
        bias=(-2.0, -1.0),
        chi2=(0.98, 1.05),
    ),
    "overlap at 2 km": Outcome(overlap_far, HomogeneousQuality.POOR_FIT, chi2=(30.0, np.inf)),
    "cloud": Outcome(cloud, HomogeneousQuality.POOR_FIT | Quality.OUTLIER, chi2=(100.0, np.inf)),
    # One standard deviation of chi-square is 0.1: some are a poor fit by that alone.
    "spike": Outcome(
        spike, accepted=(0.5, 1.0), scatter=0.000319, bias=(-0.6, 0.6), chi2=(1.2, 1.4)
    ),
    "constant": Outcome(
        constant, Quality.NO_SIGNAL, background=5.0, missing=("extinction", "reduced_chi2")
    ),
    "zeros": Outcome(
        zeros, Quality.NO_SIGNAL, background=0.0, missing=("extinction", "reduced_chi2")
    ),
    "pure noise": Outcome(pure_noise),
    "all missing": Outcome(all_missing, Quality.INPUT_MISSING, missing=ALL),
    "7 bins": Outcome(seven_bins, Quality.TOO_FEW_BINS),
    "3 bins": Outcome(three_bins, Quality.TOO_FEW_BINS, missing=ALL),
    "inverted": Outcome(inverted, Quality.NEGATIVE_AMPLITUDE),
}


@each("case", TABLE)
def test_robustness_table(case):
    outcome = TABLE[case]
    power = clean()
    outcome.change(power)
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    for bit in flags_of("homogeneous").raised(int(outcome.every)):
        assert share(fit, bit) == 1.0, bit
    accepted = 1.0 - share(fit, flags_of("homogeneous").rejecting)
    assert outcome.accepted[0] <= accepted <= outcome.accepted[1]
    for name in outcome.missing:
        assert np.isnan(getattr(fit, name)).all(), name
    if "reduced_chi2" not in outcome.missing:
        assert outcome.chi2[0] <= np.median(fit.reduced_chi2) <= outcome.chi2[1]
    if outcome.scatter is not None:
        errors = (fit.extinction - WEAK) / fit.extinction_standard_error
        assert outcome.bias[0] < np.mean(errors) < outcome.bias[1]
        assert np.std(fit.extinction) == pytest.approx(outcome.scatter * KM, rel=0.08)
        assert np.std(errors) == pytest.approx(1.0, abs=0.08)
    if Quality.NO_SIGNAL & outcome.every:
        assert np.all(fit.background == outcome.background)
        assert np.all(fit.amplitude == 0.0)
    elif outcome.scatter is not None and outcome.bias[0] > -1.0:
        off = (fit.background - outcome.background) / fit.background_standard_error
        assert abs(np.mean(off)) < 0.4


def test_outlying_bin_is_flagged():
    power = clean()
    spike(power)
    for variance, least in ((1.0, 0.97), (None, 0.9)):
        fit = fit_homogeneous_path(power, LONG, variance=variance)
        assert share(fit, Quality.OUTLIER) > least


@each("case", [name for name in TABLE if name != "clean"])
def test_bad_profiles_do_not_affect_their_neighbours(case):
    power = clean(24)
    expected = fit_homogeneous_path(power, LONG, variance=1.0)
    bad = np.zeros(24, dtype=bool)
    bad[[0, 5, 6, 7, 13, 23]] = True
    changed = power[bad]
    TABLE[case].change(changed)
    power[bad] = changed
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    assert_same(rows_of(fit, ~bad), rows_of(expected, ~bad))
    assert_same(rows_of(fit, bad), fit_homogeneous_path(changed, LONG, variance=1.0))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("known", [True, False])
def test_result_does_not_depend_on_size_start_or_order_of_the_batch(dtype, known):
    power = clean(130, seed=3).astype(dtype)
    for k, outcome in enumerate(TABLE.values()):
        changed = power[7 * k : 7 * k + 1]
        outcome.change(changed)

    def solved(rows):
        return fit_homogeneous_path(
            power[rows],
            LONG,
            variance=1.0 if known else None,
        )

    whole = solved(slice(None))
    order = np.random.default_rng(4).permutation(130)
    batches = [slice(0, size) for size in (1, 2, 3, 5, 7, 8, 9, 16, 17, 31, 64, 127, 128, 129)]
    batches += [slice(start, start + 13) for start in range(1, 110, 9)]
    for rows in (*batches, order, slice(None, None, -1)):
        assert_same(solved(rows), rows_of(whole, rows))


# Stress cases -------------------------------------------------------------------------------


def test_s1_thin_far_section():
    r = section(10500.0, 100.0)
    power = 700.0 + signal(r, 1.0, WEAK)
    assert abs(fit_homogeneous_path(power, r).background - 700.0) < 1e-8
    for lag, digits in ((1, 8), (75, 9)):
        fit = cubic_and_tail.cubic(power, r, lag=lag, variance=0.0).background
        assert abs(fit - 700.0) < 10.0**-digits
    # As float32, half a digit is left: the estimated noise is that of rounding, and the standard
    # error reflects it.
    fit = fit_homogeneous_path(power.astype(np.float32), r)
    assert abs(fit.extinction - WEAK) < 4 * fit.extinction_standard_error
    assert fit.extinction_standard_error > 0.2 * WEAK


def test_s2_signal_below_the_rounding():
    power = 1e8 + signal(LONG, 1.0, WEAK)
    assert fit_homogeneous_path(power.astype(np.float32), LONG).quality == Quality.NO_SIGNAL
    assert abs(cubic_and_tail.cubic(power, LONG, lag=1, variance=0.0).background - 1e8) < 10**-6.0
    fit = fit_homogeneous_path(power, LONG)
    assert abs(fit.extinction - WEAK) < 4 * fit.extinction_standard_error


def test_s3_no_extinction():
    power = 25.0 + signal(LONG, 1.0, 1e-8 * KM)
    fit = fit_homogeneous_path(power, LONG)
    assert abs(fit.background - 25.0) < 1e-12
    assert fit.extinction == pytest.approx(1e-8 * KM, abs=1e-13 * KM)
    assert fit.quality == 0


def test_s4_opaque_path():
    extinction = 5.0 * KM
    power = clean(4000, 1e4, extinction, seed=5)
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    lowest = lowest_errors(LONG, 1e4, extinction)[2]
    assert np.sqrt(np.mean((fit.extinction - extinction) ** 2)) < 1.04 * lowest
    assert np.mean(fit.quality == 0) > 0.995


def test_s5_three_real_roots():
    r = section(2500.0, 1000.0)
    power = 25.0 + signal(r, 1.0, WEAK)
    with mp.workdps(50):
        assert len(real_roots(quartic_derivative(r, power, 1))) == 3
    assert abs(cubic_and_tail.cubic(power, r, lag=1, variance=0.0).background - 25.0) < 1e-8
    assert abs(fit_homogeneous_path(power, r).background - 25.0) < 1e-11


def test_s6_lower_bound_excludes_the_second_minimum():
    r = section(10500.0, 8000.0)
    power = clean(3000, 15.0, 0.1 * KM, seed=6, r=r)
    lowest = lowest_errors(r, 15.0, 0.1 * KM)[2]
    fit = fit_homogeneous_path(power, r, variance=1.0)
    errors = fit.extinction - 0.1 * KM
    assert np.all(np.abs(errors) < 8 * lowest)
    assert np.sqrt(np.mean(errors**2)) < 1.06 * lowest
    second = 0
    for k in range(24):
        allowed = brute_force(r, power[k], (-0.3 / r[-1], 60.0 / 8000.0))
        assert abs(fit.extinction[k] - allowed[1]) < 0.01 * fit.extinction_standard_error[k]
        wide = brute_force(r, power[k], (-0.5 / 8000.0, 60.0 / 8000.0))
        second += wide[1] < -0.9 / r[-1] and wide[0] < allowed[0]
    assert second >= 2


def test_s7_unit_of_range_does_not_matter():
    # A section in km is refused; scaling by a power of two must give the same digits.
    power = clean(50, seed=7)
    with pytest.raises(RetrievalInputError, match="in m"):
        fit_homogeneous_path(power, LONG / 1000.0)
    one = fit_homogeneous_path(power, LONG, variance=1.0)
    other = fit_homogeneous_path(power, LONG / 8.0, variance=1.0)
    np.testing.assert_allclose(other.extinction / 8.0, one.extinction, rtol=1e-13)
    np.testing.assert_allclose(other.background, one.background, rtol=1e-13)


@each("ratio", [0.0, 1.0, 10.0, 100.0])
@each(("start", "length"), GEOMETRIES)
def test_s8_large_background_costs_no_digits(start, length, ratio):
    r = section(start, length)
    extinction = np.geomspace(0.01 * KM, 50.0 / length, 400)
    fit = fit_homogeneous_path(ratio + signal(r, 1.0, extinction), r)
    assert np.max(np.abs(fit.extinction / extinction - 1.0)) < 1e-9
    assert np.max(np.abs(fit.background - ratio)) < 1e-10
    single = fit_homogeneous_path((ratio + signal(r, 1.0, extinction)).astype(np.float32), r)
    weak = extinction < 5.0 / length
    off = np.abs(single.extinction / extinction - 1.0)
    assert np.max(off) < 5e-5 * max(1.0, ratio)
    assert np.median(off[weak]) < 5e-6 * max(1.0, ratio)


def test_s9_many_bins_in_single_precision():
    r = section(2500.0, 8000.0, 4096)
    power = (25.0 + signal(r, 1.0, WEAK)).astype(np.float32)
    fit = cubic_and_tail.cubic(power, r, lag=1365, variance=0.0).background
    with mp.workdps(40):
        exact = real_roots(quartic_derivative(r, power.astype(np.float64), 1365))[-1]
    assert abs(mp.mpf(float(fit)) - exact) < 1e-8
    assert abs(fit_homogeneous_path(power, r).extinction / WEAK - 1.0) < 1e-3


@pytest.mark.parametrize("bins", [3, 4, 7, 16])
def test_s10_few_bins(bins):
    r = section(2500.0, 8000.0, bins)
    power = 370.0 + signal(r, 1e3, WEAK) + 0.01 * noise(300, bins, seed=8)
    fit = fit_homogeneous_path(power, r, variance=1e-4)
    assert share(fit, Quality.TOO_FEW_BINS) == float(bins < 8)
    if bins < 4:
        assert np.isnan(fit.extinction).all()
    else:
        errors = (fit.extinction - WEAK) / fit.extinction_standard_error
        assert np.std(errors) == pytest.approx(1.0, abs=0.15)
    assert np.all(np.isfinite(cubic_and_tail.cubic(power, r, variance=1e-4).background))


def test_s11_counts_over_a_large_dynamic_range():
    expected = 10.0 + signal(LONG, 1e5, WEAK)
    power = np.random.default_rng(9).poisson(expected, (4000, 225))
    lowest = lowest_errors(LONG, 1e5, WEAK, 1.0 / expected)[2]

    def relative(variance):
        fit = fit_homogeneous_path(power, LONG, variance=variance)
        return fit, np.sqrt(np.mean((fit.extinction - WEAK) ** 2)) / lowest

    fit, scatter = relative(mean_profile_variance(power))
    assert scatter < 1.04
    covered = np.abs(fit.extinction - WEAK) < 1.96 * fit.extinction_standard_error
    assert 0.94 < np.mean(covered) < 0.96
    assert np.mean(fit.quality == 0) > 0.99
    assert relative(100.0)[1] > 1.25


def test_s12_single_weak_shot():
    power = np.random.default_rng(10).poisson(10.0 + signal(LONG, 20.0, WEAK), (2000, 225))
    fit = fit_homogeneous_path(power, LONG, variance=mean_profile_variance(power))
    assert share(fit, HomogeneousQuality.POORLY_DETERMINED) == 1.0


@pytest.mark.parametrize("known", [True, False])
def test_s13_saturation(known):
    power = clean()
    saturated(power)
    variance = 1.0 if known else None
    assert (
        share(
            fit_homogeneous_path(power, LONG, variance=variance),
            flags_of("homogeneous").rejecting,
        )
        == 1.0
    )
    saturated_masked(power)
    fit = fit_homogeneous_path(power, LONG, variance=variance)
    assert np.mean(fit.quality == 0) > 0.99
    assert np.mean(fit.extinction) == pytest.approx(WEAK, rel=0.01)


def test_s14_overlap_that_no_test_can_detect():
    power = clean(2000, seed=11)
    overlap_near(power)
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    bias = np.mean(fit.extinction - WEAK) / np.median(fit.extinction_standard_error)
    assert -2.0 < bias < -1.0
    assert 1.0 - share(fit, flags_of("homogeneous").rejecting) > 0.9
    # The model error covers it.
    assert np.all(np.abs(fit.extinction - WEAK) < fit.extinction_model_error)


def test_s15_strong_signal_over_a_short_section():
    r, extinction = section(2500.0, 1700.0), 0.01 * KM
    fit = fit_homogeneous_path(clean(4000, 1e5, extinction, seed=12, r=r), r, variance=1.0)
    lowest = lowest_errors(r, 1e5, extinction)[2]
    assert np.sqrt(np.mean((fit.extinction - extinction) ** 2)) < 1.04 * lowest


@pytest.mark.parametrize("known", [True, False])
def test_s16_inverted_signal(known):
    power = 740.0 - clean()
    fit = fit_homogeneous_path(power, LONG, variance=1.0 if known else None)
    assert share(fit, Quality.NEGATIVE_AMPLITUDE) == 1.0


def test_s17_spacing_that_is_not_uniform():
    r = np.sort(np.random.default_rng(13).uniform(2500.0, 10500.0, 225))
    power = clean(4000, seed=13, r=r)
    fit = fit_homogeneous_path(power, r, variance=1.0)
    errors = fit.extinction - WEAK
    assert np.sqrt(np.mean(errors**2)) < 1.04 * lowest_errors(r, 1e3, WEAK)[2]
    with pytest.raises(RetrievalInputError, match="uniform"):
        fit_homogeneous_path(power, r, variance=1.0, method="cubic")


@pytest.mark.parametrize("known", [True, False])
def test_s18_cloud(known):
    power = clean()
    cloud(power)
    fit = fit_homogeneous_path(power, LONG, variance=1.0 if known else None)
    assert share(fit, HomogeneousQuality.POOR_FIT) == 1.0
    if known:
        assert np.all(fit.reduced_chi2 > 100.0)


# Missing near range -------------------------------------------------------------------------


@each("first", [1, 20, 60, 150])
@each(("start", "length"), GEOMETRIES)
def test_missing_near_range_leaves_the_global_minimum(start, length, first):
    rng = np.random.default_rng(14)
    r = section(start, length)
    bounds = (-0.3 / r[-1], 60.0 / length)
    extinction = 10 ** rng.uniform(-2, np.log10(10.0 / length / KM), 25) * KM
    power = 370.0 + signal(r, 1.0, extinction) * 10 ** rng.uniform(1.5, 5.0, (25, 1))
    power += rng.normal(size=power.shape)
    power[:, :first] = np.nan
    fit = fit_homogeneous_path(power, r, variance=1.0)
    compared = 0
    for k in range(25):
        least, best = brute_force(r[first:], power[k, first:], bounds)
        misfit = fit.reduced_chi2[k] * (225 - first - 3)
        # No grid point is better by the equivalent of a hundredth of a standard error, whether or
        # not the profile is determined.
        assert misfit < least + 1e-4
        if not fit.quality[k] & int(UNDETERMINED | Quality.NEGATIVE_AMPLITUDE):
            compared += 1
            assert abs(fit.extinction[k] - best) < 0.01 * fit.extinction_standard_error[k]
    assert compared > (4 if first < 60 else 0)


def test_amplitude_of_the_table_is_right():
    fit = fit_homogeneous_path(clean(), LONG, variance=1.0)
    off = (fit.amplitude - amplitude(LONG, 1e3, WEAK)) / fit.amplitude_standard_error
    assert abs(np.mean(off)) < 0.15
    assert np.std(off) == pytest.approx(1.0, abs=0.08)

"""The methods of the homogeneous path: their formulas and their stated errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.cases import each
from support.mean_counts import mean_profile_variance
from support.oracles.homogeneous import (
    GEOMETRIES,
    TABLE_BIAS,
    amplitude,
    linear_step,
    lowest_errors,
    published_background,
    section,
    signal,
    table_profiles,
)
from support.weights import by_weights

from lidarops.errors import RetrievalInputError
from lidarops.kinds import flags_of
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import HomogeneousResult, fit_homogeneous_path
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

KM = 1e-3
LONG = section(2500.0, 8000.0)
FIELDS = tuple(HomogeneousResult.__dataclass_fields__)
NAMES = ("background", "amplitude", "extinction")


def noise(count, bins=225, seed=0):
    return np.random.default_rng(seed).normal(size=(count, bins))


def clean(count=2000, height=1000.0, extinction=0.03 * KM, seed=0, r=LONG):
    return 370.0 + signal(r, height, extinction) + noise(count, r.size, seed)


def truth_of(r, height, extinction, dark=370.0):
    return dict(zip(NAMES, (dark, amplitude(r, height, extinction), extinction), strict=True))


def coverage(fit, name, truth):
    errors = getattr(fit, name) - truth
    return float(np.mean(np.abs(errors) <= 1.96 * getattr(fit, f"{name}_standard_error")))


def same(fit, other):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(fit, name), getattr(other, name), err_msg=name)


def rows_of(fit, rows):
    return HomogeneousResult(**{name: getattr(fit, name)[rows] for name in FIELDS})


# One linear step ----------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
def test_linear_step_solves_the_normal_equations(weighted):
    rng = np.random.default_rng(1)
    power = clean(30, 300.0)
    weights = rng.uniform(0.2, 5.0, 225) if weighted else np.ones(225)
    weights[:30] = 0.0 if weighted else 1.0
    prior = 0.03 * KM * rng.uniform(0.5, 1.5, 30)
    fit = fit_homogeneous_path(
        power, LONG, **by_weights(weights), method="linearized", extinction=prior
    )
    for k in range(30):
        expected = linear_step(LONG, power[k], weights, prior[k])
        assert fit.background[k] == pytest.approx(expected[0], rel=1e-9)
        assert fit.amplitude[k] == pytest.approx(expected[1], rel=1e-6)
        assert fit.extinction[k] == pytest.approx(expected[2], rel=1e-6)


def test_linear_step_from_the_truth_is_exact_without_noise():
    extinction = np.geomspace(0.01 * KM, 5.0 * KM, 60)
    power = 25.0 + signal(LONG, 1.0, extinction)
    fit = fit_homogeneous_path(power, LONG, method="linearized", extinction=extinction)
    np.testing.assert_allclose(fit.extinction, extinction, rtol=1e-9)
    np.testing.assert_allclose(fit.background, 25.0, rtol=1e-12)


@each(
    ("height", "extinction", "share"),
    [(107.0, 0.03, 1.0), (1e3, 0.03, 0.9), (1e3, 0.03, 0.7), (107.0, 1.0, 0.95), (1e4, 0.1, 0.95)],
)
def test_linear_step_covers_the_truth_from_a_wrong_prior(height, extinction, share):
    extinction *= KM
    power = clean(3000, height, extinction, seed=2)
    for variance in (1.0, None):
        fit = fit_homogeneous_path(
            power,
            LONG,
            variance=variance,
            method="linearized",
            extinction=share * extinction,
        )
        for name, true in truth_of(LONG, height, extinction).items():
            least = 0.9 if share < 1.0 else 0.935
            assert coverage(fit, name, true) > least, name
            if share == 1.0:
                assert coverage(fit, name, true) < 0.965, name


def test_centroid_keeps_the_second_order_error_small_on_a_turbid_path():
    extinction = 1.0 * KM
    power = clean(2000, 107.0, extinction, seed=3)
    lowest = lowest_errors(LONG, 107.0, extinction)[2]

    fit = fit_homogeneous_path(
        power, LONG, variance=1.0, method="linearized", extinction=0.8 * extinction
    )
    scatter = np.sqrt(np.mean((fit.extinction - extinction) ** 2)) / lowest
    assert scatter == pytest.approx(1.6, abs=0.15)


def test_linear_step_from_far_off_is_flagged():
    power = clean(200, 1e4, 0.1 * KM)
    fit = fit_homogeneous_path(power, LONG, variance=1.0, method="linearized", extinction=0.5 * KM)
    assert np.all(fit.quality != 0)


# Two unknowns -------------------------------------------------------------------------------


def test_known_background_is_the_fit_of_two_unknowns():
    power = clean(20, 300.0, seed=4)
    variance = np.linspace(0.5, 2.0, 225)
    fit = fit_homogeneous_path(
        power, LONG, variance=variance, method="known_background", background=370.2
    )
    for k in range(20):

        def residuals(unknowns, profile=power[k]):
            height, extinction = unknowns
            model = 370.2 + signal(LONG, height, extinction / 8000.0)
            return (profile - model) / np.sqrt(variance)

        expected = least_squares(residuals, (300.0, 0.24), x_scale="jac", xtol=1e-15, ftol=1e-15)
        assert fit.extinction[k] * 8000.0 == pytest.approx(expected.x[1], rel=1e-6)
        assert fit.reduced_chi2[k] == pytest.approx(2 * expected.cost / 223, rel=1e-6)
        spread = np.sqrt(np.linalg.inv(expected.jac.T @ expected.jac)[1, 1]) / 8000.0
        assert fit.extinction_standard_error[k] == pytest.approx(spread, rel=1e-2)
    assert np.all(fit.background == 370.2)
    assert np.all(fit.background_standard_error == 0.0)


def test_known_background_scatters_less_than_three_unknowns():
    fit = fit_homogeneous_path(
        clean(3000, 107.0, seed=5), LONG, variance=1.0, method="known_background", background=370.0
    )
    ratio = np.std(fit.extinction) / lowest_errors(LONG, 107.0, 0.03 * KM)[2]
    assert 0.25 < ratio < 0.4
    for name in ("amplitude", "extinction"):
        assert 0.935 < coverage(fit, name, truth_of(LONG, 107.0, 0.03 * KM)[name]) < 0.965


@pytest.mark.parametrize("known", [True, False])
def test_error_of_a_given_background_is_propagated(known):
    given = 370.0 + 0.5 * np.random.default_rng(6).normal(size=3000)
    fit = fit_homogeneous_path(
        clean(3000, 300.0, seed=6),
        LONG,
        variance=1.0 if known else None,
        method="known_background",
        background=given,
        background_standard_error=0.5,
    )
    for name, true in truth_of(LONG, 300.0, 0.03 * KM).items():
        assert 0.935 < coverage(fit, name, true) < 0.965, name
    np.testing.assert_array_equal(fit.background, given)


@pytest.mark.parametrize(("error", "poor"), [(0.0, False), (0.5, False), (30.0, True)])
def test_a_poorly_known_background_makes_extinction_poorly_determined(error, poor):
    fit = fit_homogeneous_path(
        clean(100, 300.0, seed=6),
        LONG,
        variance=1.0,
        method="known_background",
        background=370.0,
        background_standard_error=error,
    )
    limit = 0.15 * (fit.extinction + 1.0 / LONG.mean())
    assert np.all((fit.extinction_standard_error > limit) == poor)
    assert np.all((fit.quality & HomogeneousQuality.POORLY_DETERMINED != 0) == poor)


def test_background_at_known_extinction_is_the_published_formula():
    power = clean(20, seed=7)
    fit = fit_homogeneous_path(power, LONG, method="known_extinction", extinction=0.03 * KM)
    expected = [published_background(LONG, profile, 0.03 * KM) for profile in power]
    np.testing.assert_allclose(fit.background, expected, rtol=1e-11)
    assert np.all(fit.extinction == 0.03 * KM)
    assert np.all(fit.extinction_standard_error == 0.0)


@each("known", [True, False])
@each(("height", "extinction"), [(50.0, 0.03), (1e4, 0.5), (1e3, 0.0)])
def test_errors_at_known_extinction_are_honest(height, extinction, known):
    variance = np.linspace(0.5, 1.5, 225)
    power = 370.0 + signal(LONG, height, extinction * KM)
    power = power + np.sqrt(variance) * noise(3000, seed=8)
    arguments = {"variance": variance} if known else by_weights(3.0 / variance)
    fit = fit_homogeneous_path(
        power, LONG, method="known_extinction", extinction=extinction * KM, **arguments
    )
    truth = truth_of(LONG, height, extinction * KM)
    for name in ("background", "amplitude"):
        assert 0.935 < coverage(fit, name, truth[name]) < 0.965, name
    assert np.mean(fit.quality == 0) > 0.995


def test_wrong_known_extinction_is_flagged():
    fit = fit_homogeneous_path(
        clean(200), LONG, variance=1.0, method="known_extinction", extinction=0.1 * KM
    )
    assert np.all(fit.quality & HomogeneousQuality.POOR_FIT)


# Counts -------------------------------------------------------------------------------------


@each(("dark", "height", "shots"), [(510.0, 5e3, 1), (10.0, 1e5, 1), (5.0, 60.0, 51)])
@each(
    ("method", "given"),
    [
        ("direct", {}),
        ("cubic", {}),
        ("linearized", {"extinction": 0.029 * KM}),
        ("known_background", {"background": "dark"}),
        ("known_extinction", {"extinction": 0.03 * KM}),
    ],
)
def test_every_method_is_right_for_counts(method, given, dark, height, shots):
    rng = np.random.default_rng(11)
    expected = dark + signal(LONG, height, 0.03 * KM)
    power = rng.poisson(expected * shots, (3000, 225)) / shots
    fit = fit_homogeneous_path(
        power,
        LONG,
        variance=mean_profile_variance(power, shots),
        method=method,
        **{name: dark if value == "dark" else value for name, value in given.items()},
    )
    for name, true in truth_of(LONG, height, 0.03 * KM, dark).items():
        errors = getattr(fit, name) - true
        assert 0.93 < coverage(fit, name, true) <= 1.0, name
        assert abs(np.mean(errors)) <= 0.12 * np.std(errors), name
    # A background that is known to a hundredth of its scatter cannot be said to be poor.
    assert np.mean(fit.quality == 0) > 0.99


def test_counts_reach_the_least_possible_scatter():
    rng = np.random.default_rng(12)
    for dark, height, most in ((510.0, 1020.0, 1.03), (10.0, 1e5, 1.05)):
        expected = dark + signal(LONG, height, 0.03 * KM)
        power = rng.poisson(expected, (4000, 225))
        fit = fit_homogeneous_path(power, LONG, variance=mean_profile_variance(power))
        lowest = lowest_errors(LONG, height, 0.03 * KM, 1.0 / expected)
        for name, scale in zip(NAMES, lowest, strict=True):
            true = truth_of(LONG, height, 0.03 * KM, dark)[name]
            least = scale * true if name == "amplitude" else scale
            errors = getattr(fit, name) - true
            assert np.sqrt(np.mean(errors**2)) < most * least, name
            assert 0.935 < coverage(fit, name, true) < 0.965, name


# Bias of the published tables ---------------------------------------------------------------


@pytest.mark.parametrize(("length", "expected"), TABLE_BIAS)
def test_published_bias_is_that_of_the_noise_and_the_fit_has_none(length, expected):
    r, power = table_profiles(2500.0, length, 2000, seed=15)
    published = cubic_and_tail.cubic(power, r, lag=1, variance=0.0).background
    assert np.mean(published) - 370.0 == pytest.approx(expected, abs=0.3)
    fit = fit_homogeneous_path(power, r, variance=1.0)
    errors = fit.background - 370.0
    spread = np.std(errors) / np.sqrt(errors.size)
    # The fit is not linear: where the background is poorly determined its distribution is
    # skewed, by up to a fifth of its scatter, about a median that is right.
    assert abs(np.mean(errors)) < 0.2 * np.std(errors)
    if length > 1000.0:
        assert abs(np.median(errors)) < 3 * 1.2533 * spread
        assert 0.93 < coverage(fit, "background", 370.0) < 0.97
        assert abs(np.mean(errors)) < 0.05 * (np.mean(published) - 370.0)
    else:
        assert np.all(fit.quality & flags_of("homogeneous").rejecting)


@pytest.mark.parametrize("length", [500.0, 1000.0, 2000.0, 2500.0])
def test_published_bias_vanishes_far_away(length):
    r, power = table_profiles(10500.0, length, 1000, seed=16)
    published = cubic_and_tail.cubic(power, r, lag=1, variance=0.0).background
    assert abs(np.mean(published) - 370.0) < 0.8


# Each profile on its own, and no silent error -----------------------------------------------

CALLS = {
    "direct": {},
    "cubic": {},
    "linearized": {"extinction": "near"},
    "known_background": {"background": "given", "background_standard_error": 0.2},
    "known_extinction": {"extinction": "near"},
}


@each("call", CALLS)
@each("dtype", [np.float64, np.float32])
def test_no_method_depends_on_the_batch(call, dtype):
    rng = np.random.default_rng(22)
    power = clean(60, seed=22).astype(dtype)
    power[rng.random(60) < 0.2, 30:60] = np.nan
    power[[3, 11]], power[12] = np.nan, 5.0
    values = {"near": 0.03 * KM * rng.uniform(0.9, 1.1, 60), "given": rng.normal(370.0, 0.2, 60)}
    chosen = {"method": call} | CALLS[call]

    def solved(rows):
        arguments = {
            name: values[value][rows] if value in ("near", "given") else value
            for name, value in chosen.items()
        }
        return fit_homogeneous_path(power[rows], LONG, variance=1.0, **arguments)

    whole = solved(slice(None))
    assert whole.quality.dtype == np.int32
    for rows in (slice(0, 1), slice(7, 40), slice(None, None, -1), rng.permutation(60)):
        same(solved(rows), rows_of(whole, rows))


@each("call", [call for call in CALLS if call != "known_extinction"])
@each(("start", "length"), GEOMETRIES)
def test_unflagged_values_are_right_within_their_errors(call, start, length):
    rng = np.random.default_rng(23)
    r, count = section(start, length), 4000
    extinction = 10 ** rng.uniform(-5.5, np.log10(10.0 / length), count)
    power = 370.0 + signal(r, 1.0, extinction) * 10 ** rng.uniform(0.0, 5.0, (count, 1))
    power += rng.normal(size=power.shape)
    values = {"near": extinction * 2 ** rng.uniform(-1.0, 1.0, count), "given": 370.0}
    chosen = {
        name: values.get(value, value) if isinstance(value, str) else value
        for name, value in ({"method": call} | CALLS[call]).items()
    }
    fit = fit_homogeneous_path(power, r, variance=1.0, **chosen)
    accepted = fit.quality == 0
    assert np.mean(accepted) > 0.15
    off = np.abs(fit.extinction - extinction) > 4 * fit.extinction_standard_error
    assert np.mean(off[accepted]) < 2e-3


@each("call", CALLS)
def test_no_method_accepts_noise(call):
    for start, length in GEOMETRIES:
        r = section(start, length)
        power = 370.0 + noise(4000, seed=24)
        chosen = {
            name: {"near": 0.03 * KM, "given": 370.0}.get(value, value)
            for name, value in ({"method": call} | CALLS[call]).items()
        }
        for variance in (1.0, None):
            assert not np.any(
                fit_homogeneous_path(power, r, variance=variance, **chosen).quality == 0
            )


# Model error --------------------------------------------------------------------------------


def test_the_model_error_is_reported():
    power = clean(2000, 30.0, seed=21)
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    slope = THRESHOLDS.model_error * (np.abs(fit.extinction) + 1.0 / LONG.mean())
    assert np.all(fit.extinction_model_error > slope)
    assert np.isnan(fit_homogeneous_path(np.ones(225), LONG).extinction_model_error)


# Arguments ----------------------------------------------------------------------------------


@each(
    ("arguments", "field"),
    [
        ({"method": "linearized"}, "extinction"),
        ({"method": "known_extinction"}, "extinction"),
        ({"method": "known_background"}, "background"),
        ({"extinction": 1e-5}, "extinction"),
        ({"background": 1.0, "method": "cubic"}, "background"),
        ({"background_standard_error": 1.0}, "background_standard_error"),
        (
            {"method": "known_background", "background": 1.0, "background_standard_error": -1.0},
            "background_standard_error",
        ),
        ({"method": "known_background", "background": np.nan}, "background"),
        ({"method": "known_background", "background": np.ones(3)}, "background"),
        ({"method": "linearized", "extinction": 0.1}, "extinction"),
        ({"lag": 1}, "lag"),
        ({"method": "cubic", "lag": 0}, "lag"),
        ({"method": "cubic", "lag": LONG.size // 2 + 1}, "lag"),
    ],
)
def test_arguments_that_a_method_does_not_accept_are_refused(arguments, field):
    given = {"power": clean(2)} | arguments
    with pytest.raises(RetrievalInputError) as caught:
        fit_homogeneous_path(given.pop("power"), LONG, **given)
    assert caught.value.field == field


@pytest.mark.parametrize("lag", [1, 30, None])
def test_the_cubic_takes_its_lag(lag):
    power = clean(20, 107.0, seed=1)
    fit = fit_homogeneous_path(power, LONG, variance=1.0, method="cubic", lag=lag)
    expected = cubic_and_tail.cubic(power, LONG, variance=1.0, lag=lag).background
    np.testing.assert_array_equal(fit.background, expected)


@pytest.mark.parametrize("near", [750.0, 2500.0])
@pytest.mark.parametrize("extinction", [3e-5, 3e-4])
def test_the_cubic_needs_a_strong_signal(near, extinction):
    """The plan states these limits."""
    rng = np.random.default_rng(1)
    distance = np.arange(near, near + 6000.0, 7.5)
    shape = (near / distance) ** 2 * np.exp(-2 * extinction * (distance - near))
    rejecting = int(flags_of("homogeneous").rejecting)
    kept = {}
    for strength in (30.0, 300.0):
        power = 50.0 + strength * shape + rng.normal(size=(100, distance.size))
        fit = fit_homogeneous_path(power, distance, variance=1.0, method="cubic")
        kept[strength] = np.mean((fit.quality & rejecting) == 0)
    assert kept[30.0] == 0.0
    assert kept[300.0] > 0.98

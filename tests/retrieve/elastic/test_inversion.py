"""The elastic inversion against the lidar equation, and its error budget against perturbations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from support.inversions import invert_elastic

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.clouds.outlying_bins import bridge_outliers
from lidarops.retrieve.elastic.inversion import THRESHOLDS

GREEN = 532e-9
AIR = MolecularProfile.us_standard()
KM = 1e3

# A coarse grid where a Jacobian is taken, and the field's grid of 7.5 m.
COARSE = 200.0 + 70.0 * np.arange(140)
FINE = 7.5 * (np.arange(1600) + 0.5)[20:]


def air(r):
    return {
        "molecular_backscatter": AIR.backscatter(r, GREEN),
        "molecular_extinction": AIR.extinction(r, GREEN),
    }


def particles(r):
    """Return backscatter of a mixed layer with a soft top and a layer aloft, clean from 6 km."""
    r = np.asarray(r, dtype=float)
    mixed = 3e-6 / (1.0 + np.exp((r - 1500.0) / 120.0))
    return mixed + 1.2e-6 * np.exp(-0.5 * ((r - 3200.0) / 250.0) ** 2)


NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)


def signal(r, lidar_ratio=lambda r: 50.0, constant=1e12, backscatter=particles):
    """Return power by the lidar equation; optical depth by Gauss quadrature from bin to bin."""
    # Small steps up to the first bin too.
    edges = np.concatenate([np.linspace(0.0, r[0], 40), r[1:]])
    half = np.diff(edges)[:, np.newaxis] / 2.0
    z = edges[:-1, np.newaxis] + half * (1.0 + NODES)
    extinction = lidar_ratio(z) * backscatter(z) + AIR.extinction(z, GREEN)
    depth = np.cumsum(np.sum(extinction * WEIGHTS * half, axis=-1))[38:]
    total = backscatter(r) + AIR.backscatter(r, GREEN)
    return constant * total * np.exp(-2.0 * depth) / r**2


FINE_POWER = signal(FINE)
COARSE_POWER = signal(COARSE)
CLEAN = (8.0 * KM, 9.0 * KM)


def within(r, window):
    return (r >= window[0]) & (r <= window[1])


def noisy_setup(power, r, **changes):
    return {
        **air(r),
        "lidar_ratio": 50.0,
        "reference": CLEAN,
        "variance": (0.02 * power) ** 2,
        **changes,
    }


# The solution -------------------------------------------------------------------------------


@pytest.mark.parametrize("reference", [CLEAN, (6.5 * KM, 7.5 * KM), (11.0 * KM, 11.9 * KM)])
def test_closed_loop_on_the_lidar_equation(reference):
    result = invert_elastic(FINE_POWER, FINE, **air(FINE), lidar_ratio=50.0, reference=reference)
    total = particles(FINE) + AIR.backscatter(FINE, GREEN)
    assert np.all(result.valid)
    assert np.max(np.abs(result.backscatter - particles(FINE)) / total) < 1e-4
    assert result.lidar_constant == pytest.approx(1e12, rel=1e-4)
    np.testing.assert_allclose(result.extinction, 50.0 * result.backscatter, rtol=1e-12)
    np.testing.assert_allclose(
        result.attenuated_backscatter, FINE_POWER * FINE**2 / 1e12, rtol=1e-4
    )
    np.testing.assert_allclose(
        result.scattering_ratio, total / AIR.backscatter(FINE, GREEN), rtol=1e-4
    )


def test_closed_loop_with_a_lidar_ratio_that_changes_with_range():
    def lidar_ratio(r):
        return 30.0 + 40.0 * np.exp(-(((np.asarray(r) - 3000.0) / 900.0) ** 2))

    power = signal(FINE, lidar_ratio)
    result = invert_elastic(
        power, FINE, **air(FINE), lidar_ratio=lidar_ratio(FINE), reference=CLEAN
    )
    total = particles(FINE) + AIR.backscatter(FINE, GREEN)
    assert np.max(np.abs(result.backscatter - particles(FINE)) / total) < 1e-4
    assert result.lidar_constant == pytest.approx(1e12, rel=1e-4)


def test_trapezoids_converge_with_the_square_of_the_bin():
    def error(step):
        r = 300.0 + step * np.arange(int(9000 / step))
        result = invert_elastic(
            signal(r), r, **air(r), lidar_ratio=50.0, reference=(8000.0, 8200.0)
        )
        below = r < 5000.0
        return np.max(np.abs(result.backscatter - particles(r))[below])

    coarse, fine = error(60.0), error(30.0)
    assert 3.0 < coarse / fine < 5.0


@pytest.mark.parametrize("start", [300.0, 4000.0, 8000.0])
def test_any_signal_obeys_the_differential_equation(start):
    """The Bernoulli equation, solved by Runge-Kutta from one bin in both directions."""
    r = np.arange(300.0, 8001.0, 2.5)

    def log_corrected(z):
        return 0.3 * np.sin(z / 700.0) - z / 5000.0

    def slope(z, y, lidar_ratio=40.0):
        gradient = 0.3 / 700.0 * np.cos(z / 700.0) - 1.0 / 5000.0
        beta, alpha = AIR.backscatter(z, GREEN), AIR.extinction(z, GREEN)
        return y * (gradient + 2.0 * (lidar_ratio * y + alpha - lidar_ratio * beta))

    total = 1.6 * float(AIR.backscatter(start, GREEN))
    result = invert_elastic(
        1e6 * np.exp(log_corrected(r)) / r**2,
        r,
        **air(r),
        lidar_ratio=40.0,
        reference=(start - 1.0, start + 1.0),
        reference_scattering_ratio=1.6,
    )
    for end in (r[0], r[-1]):
        if end == start:
            continue
        at = r[(r >= min(start, end)) & (r <= max(start, end))]
        path = solve_ivp(
            slope, (start, end), [total], t_eval=at[:: 1 if end > start else -1], rtol=1e-10,
            atol=1e-20,
        )  # fmt: skip
        values = np.interp(path.t, r, result.backscatter + AIR.backscatter(r, GREEN))
        np.testing.assert_allclose(values, path.y[0], rtol=3e-6)


def test_scattering_ratio_of_the_window_is_the_given_one():
    inside = (FINE >= 3000.0) & (FINE <= 3400.0)
    ratio = 1.0 + particles(FINE) / AIR.backscatter(FINE, GREEN)
    mean = float(np.mean(ratio[inside]))
    result = invert_elastic(
        FINE_POWER, FINE, **air(FINE), lidar_ratio=50.0, reference=(3000.0, 3400.0),
        reference_scattering_ratio=mean,
    )  # fmt: skip
    assert np.mean(result.scattering_ratio[inside]) == pytest.approx(mean, rel=5e-3)
    total = particles(FINE) + AIR.backscatter(FINE, GREEN)
    assert np.max(np.abs(result.backscatter - particles(FINE)) / total) < 5e-3


# The error budget ---------------------------------------------------------------------------


def gappy(power):
    """Remove two bins, one of them in the window."""
    power = power.copy()
    power[[30, 118]] = np.nan
    return power


def changed(setup, power=COARSE_POWER, r=COARSE):
    return invert_elastic(power, r, **setup)


SETUPS = {
    "above": {"reference": (8.0 * KM, 9.0 * KM)},
    "middle": {"reference": (5.6 * KM, 6.6 * KM)},
    "particles in the window": {
        "reference": (3.0 * KM, 3.8 * KM),
        "reference_scattering_ratio": 1.7,
    },
    "lidar ratio of range": {"lidar_ratio": 40.0 + COARSE / 500.0},
}


@pytest.fixture(params=SETUPS)
def setup(request):
    return noisy_setup(COARSE_POWER, COARSE) | SETUPS[request.param]


def slopes(function, steps):
    """Return central differences of a function of one number for several steps."""
    return np.stack([(function(step) - function(-step)) / (2.0 * step) for step in steps])


@pytest.mark.parametrize("spoil", [np.copy, gappy])
def test_noise_propagates_with_the_jacobian(setup, spoil):
    power = spoil(COARSE_POWER)
    variance = setup["variance"]
    result = changed(setup, power)

    def derivative_to_bin(i, field):
        def perturbed(step):
            changed_power = power.copy()
            changed_power[i] += step
            return np.asarray(getattr(changed(setup, changed_power), field))

        return slopes(perturbed, [1e-4 * COARSE_POWER[i]])[0]

    bins = np.flatnonzero(np.isfinite(power))
    jacobian = np.stack([derivative_to_bin(i, "backscatter") for i in bins], axis=-1)
    exact = np.sqrt(np.sum(jacobian**2 * variance[bins], axis=-1))
    np.testing.assert_allclose(result.budget["noise"], exact, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(result.budget["noise"]), np.isnan(power))

    gradient = np.array([derivative_to_bin(i, "lidar_constant") for i in bins])
    exact = np.sqrt(np.sum(gradient**2 * variance[bins]))
    assert result.lidar_constant_standard_error == pytest.approx(exact, rel=1e-6)


def cause(setup, name, step):
    """Return the setup with a cause of error off by `step`, and the power."""
    moved, power = dict(setup), COARSE_POWER
    if name == "background":
        power = power + step * POWER_OFFSET
    elif name == "reference":
        ratio = moved.get("reference_scattering_ratio", 1.0)
        moved["reference_scattering_ratio"] = ratio * (1.0 + step * 0.03)
    elif name == "lidar_ratio":
        moved["lidar_ratio"] = moved["lidar_ratio"] + step * RATIO_ERROR
    else:
        for key in ("molecular_backscatter", "molecular_extinction"):
            moved[key] = moved[key] * (1.0 + step * AIR_ERROR)
    return moved, power


POWER_OFFSET = 0.002 * COARSE_POWER[-1]
RATIO_ERROR = 5.0 + COARSE / 2000.0
AIR_ERROR = 0.01 - COARSE / 2e6
ERRORS = {
    "background_standard_error": POWER_OFFSET,
    "reference_relative_error": 0.03,
    "lidar_ratio_standard_error": RATIO_ERROR,
    "molecular_relative_error": AIR_ERROR,
}


@pytest.mark.parametrize("name", ["background", "reference", "lidar_ratio", "molecular"])
def test_each_cause_propagates_as_finite_differences(setup, name):
    result = changed(setup | ERRORS)
    only = next(key for key in ERRORS if key.startswith(name))
    alone = changed(setup | {"variance": np.zeros(COARSE.size), only: ERRORS[only]})

    def perturbed(step, field):
        changed_setup, power = cause(setup, name, step)
        return np.asarray(getattr(changed(changed_setup, power), field))

    for field in ("backscatter", "extinction", "scattering_ratio"):
        exact = slopes(lambda step, field=field: perturbed(step, field), [1e-4])[0]
        close = {"rtol": 1e-5, "atol": 1e-8 * np.max(np.abs(exact))}
        if field == "backscatter":
            np.testing.assert_allclose(result.budget[name], exact, **close)
        np.testing.assert_allclose(
            getattr(alone, f"{field}_standard_error"), np.abs(exact), **close
        )


def test_the_error_of_the_dead_time_is_the_effect_of_its_change_of_power(setup):
    change = 0.01 * COARSE_POWER**2 / COARSE_POWER[0]
    stated, still = changed(setup | {"dead_time_error": change}), changed(setup)
    moved = changed(setup, COARSE_POWER + change)
    np.testing.assert_allclose(
        stated.budget["dead_time"],
        moved.backscatter - still.backscatter,
        rtol=1e-9,
        atol=1e-12 * np.nanmax(still.backscatter),
    )
    shift = moved.lidar_constant - still.lidar_constant
    expected = np.hypot(still.lidar_constant_standard_error, shift)
    assert stated.lidar_constant_standard_error == pytest.approx(float(expected), rel=1e-9)
    assert (stated.backscatter_standard_error >= still.backscatter_standard_error).all()


def test_errors_of_the_lidar_constant_add_up_to_those_of_its_causes(setup):
    result = changed(setup | ERRORS)
    alone = changed(setup).lidar_constant_standard_error
    square = float(alone) ** 2
    for name in ("background", "reference", "lidar_ratio", "molecular"):
        square += (
            slopes(
                lambda step, name=name: np.asarray(
                    changed(*cause(setup, name, step)).lidar_constant
                ),
                [1e-4],
            )[0]
            ** 2
        )
    assert result.lidar_constant_standard_error == pytest.approx(np.sqrt(square), rel=1e-5)


def test_attenuated_backscatter_has_the_errors_of_its_factors():
    offset = POWER_OFFSET
    result = changed(noisy_setup(COARSE_POWER, COARSE, background_standard_error=offset))
    moved = changed(noisy_setup(COARSE_POWER, COARSE), COARSE_POWER + 1e-4 * offset)
    still = changed(noisy_setup(COARSE_POWER, COARSE))
    common = (moved.attenuated_backscatter - still.attenuated_backscatter) / 1e-4
    constant = still.lidar_constant_standard_error / still.lidar_constant
    own = 0.02 * still.attenuated_backscatter
    square = own**2 + common**2 + (constant * still.attenuated_backscatter) ** 2
    np.testing.assert_allclose(
        result.attenuated_backscatter_standard_error, np.sqrt(square), rtol=1e-4
    )


def test_total_is_the_quadrature_of_the_budget_and_unknown_noise_stays_unknown():
    result = changed(noisy_setup(COARSE_POWER, COARSE) | ERRORS)
    budget = result.budget
    errors = list(budget.values())
    np.testing.assert_allclose(
        result.backscatter_standard_error, np.sqrt(np.sum(np.square(errors), axis=0)), rtol=1e-14
    )
    unknown = changed({**noisy_setup(COARSE_POWER, COARSE), "variance": None} | ERRORS)
    assert np.all(np.isnan(unknown.backscatter_standard_error))
    assert np.isnan(unknown.lidar_constant_standard_error)
    assert np.all(np.isnan(unknown.attenuated_backscatter_standard_error))
    np.testing.assert_array_equal(unknown.budget["reference"], budget["reference"])
    np.testing.assert_array_equal(unknown.backscatter, result.backscatter)


# Statistics ---------------------------------------------------------------------------------


def campaign(count, seed, noise=0.03):
    """Return noisy powers, range, truth and settings, with random errors of every cause.

    The true air density, lidar ratio and reference are those of the retrieval plus an error.
    """
    rng = np.random.default_rng(seed)
    r = 30.0 * (np.arange(300) + 0.5)[5:]
    drawn = rng.standard_normal((4, count, 1))
    power = np.empty((count, r.size))
    clear = air(r)
    for k in range(count):
        density = 1.0 + 0.01 * drawn[3, k, 0]
        ratio = 50.0 + 4.0 * drawn[2, k, 0]
        beta = density * clear["molecular_backscatter"]
        # The stated scattering ratio of the window is 1.05, with an error of 1 percent.
        excess = 1.05 / (1.0 + 0.01 * drawn[1, k, 0]) - 1.0
        total = particles(r) + excess * beta
        extinction = ratio * total + density * clear["molecular_extinction"]
        depth = np.concatenate([[0.0], np.cumsum(0.5 * (extinction[1:] + extinction[:-1]) * 30.0)])
        depth += extinction[0] * r[0]
        power[k] = 1e12 * (total + beta) * np.exp(-2.0 * depth) / r**2
        if k == 0:
            truth = np.empty_like(power)
        truth[k] = total
    spread = noise * np.sqrt(power[:1] * power[0, -1])
    offset = 0.3 * noise * power[0, -1]
    measured = power + spread * rng.standard_normal(power.shape) + offset * drawn[0]
    setup = {
        **clear,
        "lidar_ratio": 50.0,
        "reference": (6.5 * KM, 8.0 * KM),
        "reference_scattering_ratio": 1.05,
        "variance": spread**2,
        "background_standard_error": offset,
        "lidar_ratio_standard_error": 4.0,
        "reference_relative_error": 0.01,
        "molecular_relative_error": 0.01,
    }
    return measured, r, truth, setup


def coverage(result, truth):
    deviation = np.abs(result.backscatter - truth) / result.backscatter_standard_error
    solved = result.valid & (np.isfinite(deviation))
    return np.mean(np.where(solved, deviation <= 1.96, False), axis=0) / np.mean(solved, axis=0)


@pytest.mark.parametrize("noise", [0.003, 0.03, 0.15])
def test_intervals_cover_the_truth(noise):
    measured, r, truth, setup = campaign(1500, 11, noise)
    result = invert_elastic(measured, r, **setup)
    assert np.mean(result.valid) > 0.99
    covered = coverage(result, truth)
    assert 0.935 < np.mean(covered) < 0.965
    # In single bins, with the scatter of 1500 profiles.
    assert np.all((covered > 0.92) & (covered < 0.98))


def test_lidar_constants_are_covered_too():
    measured, r, _, setup = campaign(1500, 12)
    result = invert_elastic(measured, r, **setup)
    deviation = (result.lidar_constant - 1e12) / result.lidar_constant_standard_error
    assert 0.93 < np.mean(np.abs(deviation) < 1.96) < 0.97


# Bins without a value -----------------------------------------------------------------------


def test_short_gaps_are_bridged_and_long_ones_end_the_solution():
    power = FINE_POWER.copy()
    short_gap = (FINE > 2000.0) & (2000.0 + THRESHOLDS.longest_gap - 10.0 > FINE)
    power[short_gap] = np.nan
    result = invert_elastic(power, FINE, **air(FINE), lidar_ratio=50.0, reference=CLEAN)
    total = particles(FINE) + AIR.backscatter(FINE, GREEN)
    assert np.array_equal(result.valid, ~short_gap)
    assert np.nanmax(np.abs(result.backscatter - particles(FINE)) / total) < 5e-4

    long_gap = (FINE > 2000.0) & (2000.0 + THRESHOLDS.longest_gap + 10.0 > FINE)
    power[long_gap] = np.nan
    result = invert_elastic(power, FINE, **air(FINE), lidar_ratio=50.0, reference=CLEAN)
    assert np.array_equal(result.valid, ~long_gap & (FINE > 2000.0))
    assert not np.any(result.unstable)
    # The calibration holds; attenuated backscatter needs no inversion.
    assert np.array_equal(np.isfinite(result.attenuated_backscatter), ~long_gap)


def test_grids_coarser_than_a_gap_have_no_gaps():
    r = 200.0 + 2.0 * THRESHOLDS.longest_gap * np.arange(40)
    result = invert_elastic(signal(r), r, **air(r), lidar_ratio=50.0, reference=CLEAN)
    assert np.all(result.valid)


def test_profiles_without_data_or_reference_stay_empty():
    power = np.stack([FINE_POWER, np.full_like(FINE_POWER, np.nan), FINE_POWER, -FINE_POWER])
    bottom, top = np.array([8e3, 8e3, np.nan, 8e3]), np.array([9e3, 9e3, np.nan, 9e3])
    result = invert_elastic(
        power,
        FINE,
        **air(FINE),
        lidar_ratio=50.0,
        reference=(bottom, top),
        variance=1e-4 * power**2,
    )
    assert result.calibrated.tolist() == [True, False, False, False]
    assert np.all(result.valid[0])
    assert not np.any(result.valid[1:])
    for values in (
        result.backscatter, result.attenuated_backscatter, result.backscatter_standard_error,
        result.extinction, result.attenuated_backscatter_standard_error, result.budget["molecular"],
    ):  # fmt: skip
        assert np.all(np.isnan(values[1:]))
        assert np.all(np.isfinite(values[0]))
    assert np.all(np.isnan(result.lidar_constant[1:]))


def test_integration_away_from_the_lidar_through_a_cloud_is_withheld():
    def cloud(r):
        return particles(r) + 2e-4 * np.exp(-0.5 * ((np.asarray(r) - 5000.0) / 60.0) ** 2)

    power = signal(FINE, backscatter=cloud)
    window = (2200.0, 2400.0)
    mean = 1.0 + float(np.mean(particles(np.linspace(*window)) / AIR.backscatter(2300.0, GREEN)))
    setup = {**air(FINE), "lidar_ratio": 52.0, "reference": window}
    result = invert_elastic(power, FINE, **setup, reference_scattering_ratio=mean)
    first = FINE[np.argmax(result.unstable)]
    # The transmission squared is 0.05 where 2 * 50 sr * beta integrates to 3.
    assert 4950.0 < first < 5100.0
    assert np.all(result.unstable[first <= FINE])
    assert np.all(np.isnan(result.backscatter[result.unstable]))
    assert np.all(result.valid[first > FINE])


def test_a_noisy_reference_is_withheld_but_the_near_range_is_not():
    rng = np.random.default_rng(3)
    spread = np.full(FINE.size, FINE_POWER[(FINE > 8e3) & (FINE < 9e3)].mean() * 3.0)
    power = FINE_POWER + spread * rng.standard_normal((300, FINE.size))
    result = invert_elastic(
        power, FINE, **air(FINE), lidar_ratio=50.0, reference=CLEAN, variance=spread**2
    )
    # 134 bins with a signal of a third of the noise: the error of the mean is a quarter.
    inside = within(FINE, CLEAN)
    assert np.mean(result.unstable[:, inside]) > 0.5
    covered = (
        np.abs(result.backscatter - particles(FINE)) <= 1.96 * result.backscatter_standard_error
    )
    near = (FINE > 500.0) & (FINE < 2000.0)
    assert 0.92 < np.mean(covered[:, near][result.valid[:, near]]) < 0.98


def test_negative_powers_are_neither_clipped_nor_refused():
    power = FINE_POWER.copy()
    power[-1] *= -1.0
    result = invert_elastic(power, FINE, **air(FINE), lidar_ratio=50.0, reference=CLEAN)
    molecular = AIR.backscatter(FINE[-1], GREEN)
    assert result.valid[-1]
    assert result.backscatter[-1] < -1.9 * molecular


# Shapes and orders --------------------------------------------------------------------------


def fields(result):
    budget = result.budget
    return [
        result.backscatter, result.attenuated_backscatter, budget["noise"], budget["background"],
        budget["lidar_ratio"], budget["molecular"], budget["reference"], result.lidar_constant,
        result.lidar_constant_standard_error, result.valid, result.unstable,
        result.attenuated_backscatter_standard_error,
    ]  # fmt: skip


def test_batches_do_not_change_a_bit():
    measured, r, _, setup = campaign(12, 15)
    rows = {
        name: np.broadcast_to(value, measured.shape)
        for name, value in setup.items()
        if name in ("molecular_backscatter", "molecular_extinction", "lidar_ratio", "variance")
    }
    whole = invert_elastic(measured, r, **setup)
    for variant in (setup, setup | rows):
        for cut in (slice(0, 1), slice(3, 8), slice(None, None, -1)):
            shared = {
                name: value[cut] if np.ndim(value) == 2 and len(value) == 12 else value
                for name, value in variant.items()
            }
            batch = invert_elastic(measured[cut], r, **shared)
            for values, expected in zip(fields(batch), fields(whole), strict=True):
                np.testing.assert_array_equal(values, expected[cut])


def test_layout_of_the_arrays_does_not_matter():
    measured, r, _, setup = campaign(6, 16)
    whole = fields(invert_elastic(measured, r, **setup))
    cube = fields(invert_elastic(measured.reshape(2, 3, -1), r, **setup))
    swapped = fields(invert_elastic(np.asfortranarray(measured).astype(">f8"), r, **setup))
    for values, in_cube, in_columns in zip(whole, cube, swapped, strict=True):
        np.testing.assert_array_equal(in_cube.reshape(values.shape), values)
        np.testing.assert_array_equal(in_columns, values)
    single = invert_elastic(measured[0], r, **setup)
    np.testing.assert_array_equal(single.backscatter, whole[0][0])
    assert single.lidar_constant.shape == ()


def test_float32_is_solved_in_double_precision():
    power = FINE_POWER.astype(np.float32)
    setup = {**air(FINE), "lidar_ratio": 50.0, "reference": CLEAN}
    np.testing.assert_array_equal(
        invert_elastic(power, FINE, **setup).backscatter,
        invert_elastic(power.astype(np.float64), FINE, **setup).backscatter,
    )


def test_windows_can_be_given_for_each_profile():
    power = np.stack([FINE_POWER, FINE_POWER])
    setup = {**air(FINE), "lidar_ratio": 50.0}
    result = invert_elastic(
        power, FINE, **setup, reference=(np.array([8e3, 7e3]), np.array([9e3, 8e3]))
    )
    for backscatter, window in zip(result.backscatter, (CLEAN, (7e3, 8e3)), strict=True):
        alone = invert_elastic(FINE_POWER, FINE, **setup, reference=window)
        np.testing.assert_array_equal(backscatter, alone.backscatter)


@settings(max_examples=30, deadline=None)
@given(scale=st.floats(1e-6, 1e12))
def test_the_unit_of_the_power_does_not_matter(scale):
    setup = noisy_setup(COARSE_POWER, COARSE) | ERRORS
    original = invert_elastic(COARSE_POWER, COARSE, **setup)
    setup["variance"] = setup["variance"] * scale**2
    setup["background_standard_error"] *= scale
    scaled = invert_elastic(COARSE_POWER * scale, COARSE, **setup)
    np.testing.assert_allclose(scaled.backscatter, original.backscatter, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(
        scaled.backscatter_standard_error, original.backscatter_standard_error, rtol=1e-9
    )
    assert scaled.lidar_constant == pytest.approx(scale * original.lidar_constant, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"lidar_ratio": 0.0}, "lidar_ratio"),
        ({"lidar_ratio": np.nan}, "lidar_ratio"),
        ({"molecular_backscatter": 1e3 * AIR.backscatter(FINE, GREEN)}, "molecular_backscatter"),
        ({"molecular_extinction": 1e3 * AIR.extinction(FINE, GREEN)}, "molecular_extinction"),
        ({"molecular_extinction": np.nan}, "molecular_extinction"),
        ({"reference": (20e3, 21e3)}, "reference"),
        ({"reference": (9e3, 8e3)}, "reference"),
        ({"reference": (np.zeros(3), np.ones(3))}, "reference"),
        ({"reference_scattering_ratio": -1.0}, "reference_scattering_ratio"),
        ({"variance": -1.0}, "variance"),
        ({"background_standard_error": -1.0}, "background_standard_error"),
        ({"reference_relative_error": np.inf}, "reference_relative_error"),
        ({"lidar_ratio_standard_error": np.nan}, "lidar_ratio_standard_error"),
        ({"lidar_ratio_standard_error": -1.0}, "lidar_ratio_standard_error"),
        ({"molecular_relative_error": -0.01}, "molecular_relative_error"),
        ({"molecular_relative_error": "much"}, "molecular_relative_error"),
    ],
)
def test_impossible_arguments_are_refused_by_name(change, field):
    setup = {**air(FINE), "lidar_ratio": 50.0, "reference": CLEAN, **change}
    with pytest.raises(RetrievalInputError) as caught:
        invert_elastic(FINE_POWER, FINE, **setup)
    assert caught.value.field == field


# Outlying bins ------------------------------------------------------------------------------


@pytest.mark.parametrize("window", [True, False], ids=["in the window", "elsewhere"])
@pytest.mark.parametrize("size", [30.0, 1000.0, -1000.0])
def test_errors_hold_with_an_outlying_bin(window, size):
    rng = np.random.default_rng(31)
    deviation = np.sqrt(1e-4 * FINE_POWER.max() * FINE_POWER / 100.0 + FINE_POWER[-1] ** 2 / 100.0)
    power = FINE_POWER + deviation * rng.normal(size=(200, FINE.size))
    setup = {
        **air(FINE), "lidar_ratio": 50.0, "reference": CLEAN, "variance": deviation**2,
        "reference_relative_error": 0.01,
    }  # fmt: skip
    clean = invert_elastic(power, FINE, **setup)
    bins = np.flatnonzero(within(FINE, CLEAN) if window else (FINE > KM) & (FINE < 7.5 * KM))
    at = rng.choice(bins, 200)
    with_outliers = power.copy()
    with_outliers[np.arange(200), at] += size * deviation[at]
    bridged = bridge_outliers(with_outliers, FINE, deviation**2)
    assert bridged.outlying[np.arange(200), at].all()
    assert bridged.outlying.sum() == 200
    result = invert_elastic(bridged.power, FINE, **setup | {"variance": bridged.variance})
    assert np.array_equal(result.valid, clean.valid)
    deviation_in_errors = (result.backscatter - particles(FINE)) / result.backscatter_standard_error
    assert np.mean(np.abs(deviation_in_errors[result.valid]) > 4.0) < 1e-3

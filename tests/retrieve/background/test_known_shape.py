"""Background by the molecular shape: algebra, coverage, windows, and a published data set."""

from __future__ import annotations

import re

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.raw import licel
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.background.cubic_and_tail import tail_mean
from lidarops.retrieve.background.known_shape import fit_known_shape, molecular_shape

RANGE = (np.arange(1000) + 0.5) * 15.0
WAVELENGTH = 532e-9


def air(range_=RANGE, wavelength=WAVELENGTH):
    """Return the shape of air over a lidar at sea level, 1 at 6 km."""
    profile = MolecularProfile.us_standard()
    shape = molecular_shape(
        profile.backscatter(range_, wavelength), profile.extinction(range_, wavelength), range_
    )
    return shape / np.interp(6000.0, range_, shape)


def with_layer(shape, *, top=3000.0, strength=20.0):
    """Return the shape with aerosol below `top`."""
    return shape * (1.0 + strength * (top > RANGE))


# Algebra ------------------------------------------------------------------------------------


def test_shape_is_that_of_exact_integration():
    """Extinction and backscatter that fall exponentially have a closed form."""
    alpha, height = 1.2e-5, 8000.0
    fall = np.exp(-RANGE / height)
    depth = alpha * height * (1.0 - fall)
    expected = 1e-6 * fall * np.exp(-2.0 * depth) / RANGE**2
    shape = molecular_shape(1e-6 * fall, alpha * fall, RANGE)
    np.testing.assert_allclose(shape, expected, rtol=1e-7)


@pytest.mark.parametrize("background", [0.0, 1.0, 1e4, 1e8])
def test_the_fit_keeps_its_digits(background):
    """Compare with least squares in 60 digits, up to a background of 1e8 times the signal."""
    rng = np.random.default_rng(1)
    shape = air()[400:]
    power = background + 3.0 * shape + rng.normal(0.0, 0.1, shape.size)
    variance = 0.01 + 0.1 * rng.random(shape.size)
    fit = fit_known_shape(power, RANGE[400:], shape, variance=variance, start=0.0)
    with mp.workdps(60):
        w = [1 / mp.mpf(float(v)) for v in variance]
        phi, p = [mp.mpf(float(x)) for x in shape], [mp.mpf(float(x)) for x in power]
        a, b, c = (
            mp.fsum(w),
            mp.fdot(w, phi),
            mp.fsum(x * y * y for x, y in zip(w, phi, strict=True)),
        )
        d, e = mp.fdot(w, p), mp.fsum(x * y * z for x, y, z in zip(w, phi, p, strict=True))
        det = a * c - b * b
        exact = [(c * d - b * e) / det, (a * e - b * d) / det, c / det, a / det]
    grain = max(background, 1.0) * 1e-14
    assert abs(fit.background - float(exact[0])) < grain
    assert abs(fit.amplitude - float(exact[1])) < 10 * grain
    assert fit.background_standard_error**2 == pytest.approx(float(exact[2]), rel=1e-10)
    assert fit.amplitude_standard_error**2 == pytest.approx(float(exact[3]), rel=1e-10)


@given(st.integers(0, 2**32 - 1), st.floats(-1e3, 1e3), st.floats(1e-3, 1e3), st.floats(-30, 30))
@settings(max_examples=60, deadline=None)
def test_without_noise_background_and_amplitude_are_exact(seed, background, amplitude, exponent):
    scale = 10.0**exponent
    shape = air()
    power = background + amplitude * shape
    power[np.random.default_rng(seed).random(1000) < 0.3] = np.nan
    fit = fit_known_shape(power, RANGE, shape * scale, variance=1.0, start=4000.0)
    assert fit.background == pytest.approx(background, abs=1e-11 * (1e3 + amplitude))
    assert fit.amplitude * scale == pytest.approx(amplitude, rel=1e-9, abs=1e-11 * 1e3)


# Statistics ---------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [None, 5000.0])
def test_standard_errors_cover_the_scatter(start):
    rng = np.random.default_rng(2)
    shape = air()
    noise = 0.1 + 0.4 * np.exp(-RANGE / 4000.0)
    power = 20.0 + 5.0 * shape + noise * rng.normal(size=(3000, 1000))
    fit = fit_known_shape(power, RANGE, shape, variance=noise**2, start=start)
    off = (fit.background - 20.0) / fit.background_standard_error
    scale = (fit.amplitude - 5.0) / fit.amplitude_standard_error
    assert off.std() == pytest.approx(1.0, abs=0.06)
    assert scale.std() == pytest.approx(1.0, abs=0.06)
    assert off.mean() == pytest.approx(0.0, abs=0.08)
    assert np.mean(fit.chi2 / fit.degrees_of_freedom) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("start", [500.0, 1500.0, 4500.0])
def test_standard_errors_of_counts_cover_the_scatter(start):
    """From near, where bins of a block differ most in their counts."""
    rng = np.random.default_rng(3)
    shape = air()
    mean = 20.0 + 5.0 * shape
    power = rng.poisson(10.0 * mean, (3000, mean.size)) / 10.0
    fit = fit_known_shape(power, RANGE, shape, exposure=10.0, start=start)
    off = (fit.background - 20.0) / fit.background_standard_error
    scale = (fit.amplitude - 5.0) / fit.amplitude_standard_error
    assert off.std() == pytest.approx(1.0, abs=0.06)
    assert scale.std() == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(("haze", "least"), [(0.0, 0.95), (1.0, 0.932)])
def test_errors_include_the_choice_of_the_window(haze, least):
    """Haze at the start of the longest window, from far too weak to be seen to obvious.

    With errors of random noise alone, 94.3(2) % are covered in clean air and 91.5(4) % in haze.
    """
    rng = np.random.default_rng(12)
    used = RANGE > 4000.0
    distance, shape = RANGE[used], air()[used]
    layer = 1.0 + haze * np.clip((6000.0 - distance) / 2000.0, 0.0, 1.0) ** 2
    covered = []
    for _ in range(250):
        signal = np.exp(rng.uniform(np.log(0.1), np.log(100.0)))
        power = signal * layer * shape + rng.normal(size=(60, shape.size))
        fit = fit_known_shape(power, distance, shape, variance=1.0)
        covered.append(np.mean(np.abs(fit.background) < 1.96 * fit.background_standard_error))
    assert least < np.mean(covered) < 0.97


@each("background", [0.0, 0.05, 2.0])
@each("start", [None, 4500.0])
def test_counts_are_weighed_without_bias(background, start):
    """Few counts per bin, where weights from the counts themselves are worst."""
    rng = np.random.default_rng(3)
    shape, shots = air(), 20.0
    power = rng.poisson(shots * (background + 2.0 * shape), (4000, 1000)) / shots
    fit = fit_known_shape(power, RANGE, shape, exposure=shots, start=start)
    off = fit.background - background
    error = fit.background_standard_error
    assert abs(off.mean()) < 0.1 * error.mean()
    assert (off / error).std() == pytest.approx(1.0, abs=0.12 if background == 0.0 else 0.06)
    realised = fit_known_shape(
        power, RANGE, shape, variance=np.maximum(power, 1.0 / shots) / shots, start=4500.0
    )
    bias = np.mean(realised.background) - background
    assert abs(bias) > 5.0 * abs(off.mean())
    assert abs(bias) > 0.5 * error.mean()


def test_model_weights_reach_the_error_of_the_true_ones():
    rng = np.random.default_rng(4)
    shape, shots = air(), 1000.0
    truth = 0.3 + 30.0 * shape
    power = rng.poisson(shots * truth, (1500, 1000)) / shots
    model = fit_known_shape(power, RANGE, shape, exposure=shots, start=3000.0)
    true = fit_known_shape(power, RANGE, shape, variance=truth / shots, start=3000.0)
    flat = fit_known_shape(power, RANGE, shape, variance=1.0, start=3000.0)
    assert model.background.std() == pytest.approx(true.background.std(), rel=0.01)
    assert flat.background.std() > 1.5 * true.background.std()
    np.testing.assert_allclose(
        model.background_standard_error, true.background_standard_error, rtol=0.02
    )


# Windows ------------------------------------------------------------------------------------


def test_false_alarms_are_as_rare_as_designed():
    rng = np.random.default_rng(5)
    shape = air()
    power = 3.0 + shape + rng.normal(0.0, 0.05, (20000, 1000))
    fit = fit_known_shape(power, RANGE, shape, variance=0.05**2, start=5000.0)
    assert fit.poor_fit.sum() <= 8
    assert (np.abs(fit.curvature) > 1.96).mean() == pytest.approx(0.05, abs=0.006)
    assert fit.waves.mean() == pytest.approx(12.0, abs=0.3)


def test_a_cloud_in_the_window_is_detected():
    variance = 0.05**2
    rng = np.random.default_rng(6)
    shape = air()
    cloud = 1.0 + 0.5 * np.exp(-(((RANGE - 8000.0) / 300.0) ** 2))
    power = 3.0 + 5.0 * shape * cloud + rng.normal(0.0, 0.05, (200, 1000))
    fit = fit_known_shape(power, RANGE, shape, variance=variance, start=5000.0)
    assert fit.poor_fit.all()
    assert ((fit.quality & Quality.NOT_HOMOGENEOUS) != 0).all()
    chosen = fit_known_shape(power, RANGE, shape, variance=variance)
    assert (chosen.start > 8000.0).all()
    assert chosen.poor_fit.mean() < 0.01
    assert abs(np.mean(chosen.background) - 3.0) < 0.3 * chosen.background_standard_error.mean()


def test_the_window_begins_above_the_aerosol():
    rng = np.random.default_rng(7)
    shape = air()
    for top in (3000.0, 5000.0, 7000.0):
        truth = 10.0 + with_layer(shape, top=top) * 50.0
        power = truth + rng.normal(0.0, 0.3, (300, 1000))
        fit = fit_known_shape(power, RANGE, shape, variance=0.09)
        off = (fit.background - 10.0) / fit.background_standard_error
        assert (fit.start >= top).all()
        assert np.sqrt(np.mean(off**2)) < 1.2
        assert fit.poor_fit.mean() < 0.01


@pytest.mark.parametrize(
    ("structure", "curved", "wavy"),
    [
        (0.6 * np.cos(2 * np.pi * (np.arange(1000) - 300) / 80), False, True),
        (0.5 * (1.0 - (RANGE - 4500.0) / 1500.0), True, False),
    ],
    ids=["waves", "curvature"],
)
def test_a_window_must_show_neither_waves_nor_curvature(structure, curved, wavy):
    """From 4.5 to 6 km, which only the longest window contains."""
    shape = air()
    power = 20.0 + 5.0 * shape + structure * ((RANGE > 4500.0) & (RANGE < 6000.0))
    longest = fit_known_shape(power, RANGE, shape, variance=0.09, start=4500.0)
    # At a false alarm of 1 percent, nearly as windows are chosen.
    assert (abs(longest.curvature) > 2.81, longest.waves > 28.3) == (curved, wavy)
    assert fit_known_shape(power, RANGE, shape, variance=0.09).start == 6007.5


def test_clean_air_is_used_from_the_nearest_start():
    rng = np.random.default_rng(8)
    shape = air()
    power = 10.0 + shape + rng.normal(0.0, 0.3, (500, 1000))
    fit = fit_known_shape(power, RANGE, shape, variance=0.09)
    assert (fit.start == RANGE[np.searchsorted(RANGE, 0.3 * RANGE[-1])]).mean() > 0.95


def test_without_a_clean_window_the_farthest_is_used_and_flagged():
    shape = air()
    power = 3.0 + 5.0 * shape * (1.0 + 0.5 * np.sin(RANGE / 300.0))
    fit = fit_known_shape(power, RANGE, shape, variance=1e-6)
    assert fit.start == RANGE[np.searchsorted(RANGE, 0.7 * RANGE[-1])]
    assert fit.poor_fit


def test_windows_end_at_the_last_usable_bin_or_at_stop():
    rng = np.random.default_rng(9)
    shape = air()
    power = 3.0 + shape + rng.normal(0.0, 0.01, (4, 1000))
    power[0, 800:] = np.nan
    mask = np.ones((4, 1000), dtype=bool)
    mask[1, 600:] = False
    stops = [2e4, 2e4, 10000.0, 2e4]
    fit = fit_known_shape(power, RANGE, shape, variance=1e-4, start=4000.0, stop=stops, mask=mask)
    np.testing.assert_array_equal(fit.stop, [RANGE[799], RANGE[599], 9997.5, RANGE[-1]])
    np.testing.assert_array_equal(fit.start, RANGE[RANGE >= 4000.0][0])
    for k, last in enumerate((800, 600, 667, 1000)):
        alone = fit_known_shape(
            power[k, :last], RANGE[:last], shape[:last], variance=1e-4, start=4000.0
        )
        assert fit.background[k] == alone.background


# Unsolvable cases ---------------------------------------------------------------------------


def test_a_shape_that_is_constant_is_singular():
    power = np.random.default_rng(10).normal(5.0, 1.0, (2, 200))
    shape = np.stack([np.ones(200), 1.0 + 1e-3 * np.linspace(0.0, 1.0, 200)])
    fit = fit_known_shape(power, RANGE[:200], shape, variance=1.0, start=0.0)
    assert fit.singular.all()
    assert np.isinf(fit.condition[0])
    assert np.isnan(fit.background[0])
    assert fit.condition[1] > 1000.0
    assert abs(fit.background[1] - 5.0) < 5.0 * fit.background_standard_error[1]


def test_condition_is_the_error_increase_by_the_second_unknown():
    shape = air()
    long = fit_known_shape(np.ones(1000), RANGE, shape, variance=1.0, start=2000.0)
    short = fit_known_shape(np.ones(1000), RANGE, shape, variance=1.0, start=14000.0)
    for fit in (long, short):
        bins = fit.degrees_of_freedom + 2
        assert fit.condition == pytest.approx(fit.background_standard_error * np.sqrt(bins))
    assert 1.0 < long.condition < 1.3
    assert short.condition > 10.0
    assert not long.singular


def test_missing_profiles_stay_missing():
    power = np.ones((3, 1000))
    power[1] = np.nan
    power[2, 303:] = np.nan
    shape = air()
    fit = fit_known_shape(power, RANGE, shape, variance=1.0, start=RANGE[300])
    assert np.isnan(fit.background[1])
    assert np.isnan(fit.start[1])
    assert fit.quality[1] == Quality.INPUT_MISSING
    assert fit.quality[2] & Quality.TOO_FEW_BINS
    assert fit.degrees_of_freedom[2] == 1
    none = fit_known_shape(np.full((2, 1000), np.nan), RANGE, shape, variance=1.0)
    assert np.isnan(none.background).all()
    assert fit_known_shape(np.empty((0, 1000)), RANGE, shape, variance=1.0).background.shape == (0,)


def test_a_constant_signal_is_flagged():
    constant = fit_known_shape(np.full(1000, 7.0), RANGE, air(), variance=1.0)
    assert constant.quality & Quality.NO_SIGNAL
    dark = fit_known_shape(np.zeros(1000), RANGE, air(), exposure=100.0)
    assert dark.quality == 0
    assert dark.background == 0.0
    bins = dark.degrees_of_freedom + 2
    assert dark.background_standard_error >= 1.0 / (100.0 * bins)


def test_an_inverted_signal_is_flagged():
    fit = fit_known_shape(10.0 - air(), RANGE, air(), variance=1e-4, start=4000.0)
    assert fit.quality & Quality.NEGATIVE_AMPLITUDE


def test_no_bit_depends_on_batch_or_layout():
    rng = np.random.default_rng(11)
    shape = air()
    power = (3.0 + shape + rng.normal(0.0, 0.1, (24, 1000))).astype(np.float32)
    power[rng.random(power.shape) < 0.05] = np.nan
    for options in ({"exposure": 50.0}, {"variance": 0.01}):
        whole = fit_known_shape(power.reshape(2, 3, 4, 1000), RANGE, shape, **options)
        alone = [fit_known_shape(row, RANGE, shape, **options).background for row in power]
        np.testing.assert_array_equal(whole.background.ravel(), alone)
        other = fit_known_shape(np.asfortranarray(power.astype(">f8")), RANGE, shape, **options)
        np.testing.assert_array_equal(other.background, alone)


@each(
    ("change", "field"),
    [
        ({"range": RANGE / 1000.0}, "range"),
        ({"power": np.ones(7)}, "power"),
        ({"shape": np.ones(7)}, "shape"),
        ({"variance": -1.0}, "variance"),
        ({"variance": 1.0, "exposure": 10.0}, "variance"),
        ({"variance": None}, "variance"),
        ({"exposure": 0.0}, "exposure"),
        ({"start": 1e5}, "start"),
        ({"start": np.nan}, "start"),
        ({"stop": [1.0, 2.0]}, "stop"),
    ],
)
def test_invalid_arguments_are_refused(change, field):
    arguments = {"power": np.ones(1000), "range": RANGE, "shape": air(), "variance": 1.0} | change
    if "exposure" in change and "variance" not in change:
        del arguments["variance"]
    with pytest.raises(RetrievalInputError) as error:
        fit_known_shape(**arguments)
    assert error.value.field == field


# A published data set -----------------------------------------------------------------------

BRIGHTEST = {355: 2.3295e7, 532: 1.9093e7, 1064: 1.2358e7}
"""Counts in the brightest bin of the EARLINET elastic signals (nm)."""
FULL_SCALE = 2.0**31 - 1.0
SHOTS = 1000.0


def _published(folder, wavelength):
    """Yield nominal background, counts, their shape without noise, and the shape of air."""
    name = f"analog_{wavelength}o"
    pressure, temperature, height = np.loadtxt(
        folder / "molecular_profile_hPa.csv", delimiter=",", unpack=True
    )
    profile = MolecularProfile.from_profile(height, pressure, temperature, pressure_unit="hPa")
    range_ = (np.arange(1005) + 0.5) * 15.0
    length = wavelength * 1e-9
    shape = molecular_shape(
        profile.backscatter(range_, length), profile.extinction(range_, length), range_
    )
    clean = licel.read_counts(folder / "noise_free.licel")[1][name] / FULL_SCALE
    clean *= BRIGHTEST[wavelength]
    for file in sorted(folder.glob("background_1e*.licel")):
        level = 10.0 ** int(re.search(r"1e(\d+)", file.name)[1])
        counts = licel.read_counts(file)[1][name]
        yield level, counts * (BRIGHTEST[wavelength] + level) / FULL_SCALE, clean, shape, range_


@pytest.mark.parametrize("wavelength", [355, 532, 1064])
def test_published_backgrounds_are_reproduced(data_root, wavelength):
    """Boeckmann et al. (2004): within a count, and within 3 standard errors at every level."""
    levels = 0
    for level, power, clean, shape, range_ in _published(
        data_root / "synthetic" / "boeckmann", wavelength
    ):
        # The scale of a file is known to 1e-5 only: the truth is the fit of the true shape.
        truth = fit_known_shape(
            power, range_, clean, variance=(clean + level) / SHOTS, start=range_[60]
        )
        fit = fit_known_shape(power, range_, shape, exposure=SHOTS)
        off = fit.background - truth.background
        assert abs(off) < 3.0 * fit.background_standard_error
        assert level > 1e5 or abs(off) <= 1.0
        assert not fit.poor_fit
        assert fit.quality == 0
        flat = fit_known_shape(power, range_, shape, variance=1.0)
        assert level > 1e5 or abs(flat.background - truth.background) <= 1.0
        if level <= 1e4:
            tail = tail_mean(power, range_).background - truth.background
            assert tail > 1.0
            assert abs(off) < 0.25 * tail
        levels += 1
    assert levels >= 5

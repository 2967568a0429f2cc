"""Gluing: the line against an independent solver, its bias and errors against simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize
from support.lags import lag_of
from support.oracles import signal as oracle
from support.physical import read_physical

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.signal import lag
from lidarops.retrieve.signal.counts_to_signal import difference_variance
from lidarops.retrieve.signal.gluing import fit_lines, glue

RANGE = (np.arange(800) + 0.5) * 15.0
SLOPE = 12.0
EXPOSURE = 60.0
"""Exposure of a bin in microseconds."""
ANALOG_NOISE = 0.02
"""mV."""


def truth(brightness=2e8):
    """Return a count rate in MHz that falls through both limits."""
    return brightness * np.exp(-RANGE / 5000.0) / (RANGE + 300.0) ** 2


def measured(rng, count, *, rate=None, offset=0.0, noise=ANALOG_NOISE):
    """Return analog, photon counting and the variances of the true rate."""
    rate = truth() if rate is None else rate
    analog = rate / SLOPE - offset + rng.normal(0.0, noise, (count, rate.size))
    photon = rng.poisson(rate * EXPOSURE, (count, rate.size)) / EXPOSURE
    return (
        analog,
        photon,
        {
            "analog_variance": np.full(rate.shape, noise**2),
            "photon_variance": rate / EXPOSURE,
        },
    )


def window(result, k):
    return (result.start[k] <= RANGE) & (result.stop[k] >= RANGE)


def lines_of(result, analog, photon, variances, distance=RANGE):
    """Return the lines of glued signals."""
    noise = (np.broadcast_to(part, analog.shape) for part in variances.values())
    edges = np.searchsorted(distance, result.start), np.searchsorted(distance, result.stop) + 1
    return fit_lines(analog, photon, *noise, *edges)


def intercept_error(line):
    return np.sqrt(line["centre_variance"] + line["centre"] ** 2 * line["slope_variance"])


@pytest.mark.slow
def test_the_line_minimises_its_misfit():
    """Four iterations reach the minimum of a general minimiser."""
    rng = np.random.default_rng(1)
    for noise in (0.005, 0.01, 0.03):
        analog, photon, variances = measured(rng, 3, noise=noise, offset=0.05)
        result = glue(analog, photon, RANGE, **variances)
        for k in range(3):
            inside = window(result, k)
            x, y = analog[k, inside], photon[k, inside]
            v = variances["photon_variance"][inside]

            def misfit(line, x=x, y=y, v=v, noise=noise):
                return (y - line[0] * x - line[1]) / np.sqrt(v + (line[0] * noise) ** 2)

            best = optimize.least_squares(misfit, [SLOPE, 0.0], xtol=1e-14, ftol=1e-14)
            assert abs(result.slope[k] - best.x[0]) < 0.02 * result.slope_standard_error[k]
            line = lines_of(result, analog, photon, variances)[k]
            assert abs(line["intercept"] - best.x[1]) < 0.02 * intercept_error(line)
            assert line["chi2"] == pytest.approx(2.0 * best.cost, rel=1e-6)
            assert line["points"] == inside.sum()


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_slope_and_glued_signal_are_unbiased(noise):
    rng = np.random.default_rng(2)
    count = 1500
    analog, photon, variances = measured(rng, count, noise=noise, offset=0.05)
    result = glue(analog, photon, RANGE, **variances)
    assert not result.no_window.any()
    assert result.poor_fit.mean() < 0.01
    deviation = (result.slope - SLOPE) / result.slope_standard_error
    assert abs(deviation.mean()) < 4.0 / np.sqrt(count)
    assert deviation.std() == pytest.approx(1.0, abs=0.07)
    lines = lines_of(result, analog, photon, variances)
    shift = (lines["intercept"] - SLOPE * 0.05) / intercept_error(lines)
    assert abs(shift.mean()) < 4.0 / np.sqrt(count)
    assert shift.std() == pytest.approx(1.0, abs=0.07)
    error = (result.power - truth()) / np.sqrt(result.variance + result.systematic_variance)
    # The line depends on the noise of its window, so that window is tested separately.
    near, far = result.start.min() - 30.0 > RANGE, result.stop.max() + 30.0 < RANGE
    for bins in (near, far):
        assert abs(error[:, bins].mean()) < 0.05
        assert error[:, bins].std() == pytest.approx(1.0, abs=0.05)
    middle = ~near & ~far
    assert abs(error[:, middle].mean()) < 0.05
    assert 0.8 < error[:, middle].std() < 1.1


def test_ordinary_regression_would_be_biased():
    """A fit without errors in the analog signal has too small a slope."""
    rng = np.random.default_rng(3)
    analog, photon, variances = measured(rng, 400, noise=0.05)
    result = glue(analog, photon, RANGE, **variances)
    inside = window(result, 0)
    slopes = [np.polyfit(x[inside], y[inside], 1)[0] for x, y in zip(analog, photon, strict=True)]
    standard = result.slope.std() / np.sqrt(400)
    assert np.mean(slopes) < SLOPE - 5.0 * standard
    assert abs(result.slope.mean() - SLOPE) < 0.2 * result.slope.std()


def test_a_window_chosen_in_single_bins_would_bias():
    """After smoothing, the edges of the window do not follow the noise."""
    rng = np.random.default_rng(4)
    analog, photon, variances = measured(rng, 2000)
    result = glue(analog, photon, RANGE, **variances)
    ends = np.searchsorted(RANGE, result.stop)
    rows = np.arange(2000)
    sigma = np.sqrt(variances["photon_variance"])
    last = (photon[rows, ends] - truth()[ends]) / sigma[ends]
    assert abs(last.mean()) < 0.5
    naive = np.array([np.flatnonzero((p < 0.5) & (RANGE > 500.0))[0] - 1 for p in photon])
    beyond = (photon[rows, naive + 1] - truth()[naive + 1]) / sigma[naive + 1]
    assert beyond.mean() < -1.0


def test_the_window_lies_where_both_are_linear():
    rate = truth()
    analog = rate / SLOPE
    result = glue(analog, rate, RANGE, analog_variance=1e-8, photon_variance=rate / 1e6)
    inside = (result.start <= RANGE) & (result.stop >= RANGE)
    assert rate[inside].max() <= 20.5
    assert rate[inside].min() >= 0.45
    assert rate[result.start > RANGE].min() >= 19.0
    noisy = glue(analog, rate, RANGE, analog_variance=0.01, photon_variance=rate / 1e6)
    inside = (noisy.start <= RANGE) & (noisy.stop >= RANGE)
    assert (analog[inside] / 0.1).min() == pytest.approx(10.0, rel=0.05)
    bright = glue(
        analog, rate, RANGE, analog_variance=1e-8, photon_variance=rate / 1e6,
        photon_background=15.0,
    )  # fmt: skip
    inside = (bright.start <= RANGE) & (bright.stop >= RANGE)
    assert rate[inside].max() <= 5.2


def test_too_small_a_fall_gives_no_window():
    """Eight bins without a sufficient fall would give the slope of their noise."""
    rng = np.random.default_rng(10)
    analog, photon, variances = measured(rng, 300, noise=0.15)
    result = glue(analog, photon, RANGE, **variances)
    assert result.no_window.all()
    assert np.isnan(result.power).all()


def test_profiles_without_window_are_not_glued():
    rate = truth()
    rows = np.stack([rate, rate, 1e4 + rate, rate * 1e-6])
    analog = rows / SLOPE
    analog[1] = np.nan
    result = glue(analog, rows, RANGE, analog_variance=1e-8, photon_variance=1e-4)
    np.testing.assert_array_equal(result.no_window, [False, True, True, True])
    assert np.isnan(result.power[1:]).all()
    assert np.isnan(result.variance[1:]).all()
    assert np.isnan(result.start[1:]).all()
    assert np.isfinite(result.power[0]).all()
    hot = glue(analog[0], rows[0], RANGE, analog_variance=1e-8, photon_variance=1e-4,
               photon_background=111.0)  # fmt: skip
    assert hot.no_window


def test_channels_that_receive_different_light_are_reported():
    rng = np.random.default_rng(7)
    analog, photon, variances = measured(rng, 4)
    fine = glue(analog, photon, RANGE, **variances)
    assert not fine.poor_fit.any()
    dead = glue(analog, photon / (1.0 + 0.02 * photon), RANGE, **variances)
    assert dead.poor_fit.all()
    upside_down = glue(10.0 - analog, photon, RANGE, **variances)
    assert upside_down.poor_fit.all()
    assert np.isnan(upside_down.power).all()


def test_a_bin_comes_from_one_channel():
    rng = np.random.default_rng(8)
    analog, photon, variances = measured(rng, 1)
    clean = glue(analog, photon, RANGE, **variances)
    first, last = np.searchsorted(RANGE, [clean.start[0], clean.stop[0]])
    middle = (first + last) // 2
    analog[0, [5, middle + 1, 790]] = np.nan
    photon[0, [6, middle - 1, 791]] = np.nan
    result = glue(analog, photon, RANGE, **variances)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(result.power[0])), [5, 791])
    assert result.power[0, middle + 1] == photon[0, middle + 1]
    assert result.systematic_variance[0, middle + 1] == 0.0
    assert result.systematic_variance[0, 10] > 0.0
    assert result.power[0, 790] == photon[0, 790]


def test_no_bit_depends_on_batch_or_layout():
    rng = np.random.default_rng(9)
    analog, photon, variances = measured(rng, 12)
    whole = glue(analog.reshape(3, 4, -1), photon.reshape(3, 4, -1), RANGE, **variances)
    for k in (0, 5, 11):
        alone = glue(analog[k], photon[k], RANGE, **variances)
        np.testing.assert_array_equal(alone.power, whole.power.reshape(12, -1)[k])
    swapped = glue(np.asfortranarray(analog.astype(">f8")), photon, RANGE, **variances)
    np.testing.assert_array_equal(swapped.power, whole.power.reshape(12, -1))
    empty = glue(np.empty((0, 800)), np.empty((0, 800)), RANGE, **variances)
    assert empty.power.shape == (0, 800)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"analog": np.ones(3)}, "analog"),
        ({"photon_counting": np.ones((2, 800))}, "photon_counting"),
        ({"range": RANGE / 1000.0}, "range"),
        ({"analog_variance": -1.0}, "analog_variance"),
        ({"photon_variance": np.ones(3)}, "photon_variance"),
        ({"photon_background": [1.0, 2.0]}, "photon_background"),
    ],
)
def test_impossible_arguments_are_refused(change, field):
    arguments = {
        "analog": np.ones(800),
        "photon_counting": np.ones(800),
        "range": RANGE,
        "analog_variance": 1.0,
        "photon_variance": 1.0,
    } | change
    with pytest.raises(RetrievalInputError) as error:
        glue(**arguments)
    assert error.value.field == field


@pytest.mark.parametrize("wavelength", ["355", "532"])
def test_a_real_station_is_glued_after_lag_correction(data_root, wavelength):
    """Sao Paulo: without lag correction the slope varies and the line does not fit."""
    folder = data_root / "saopaulo" / "20170928"
    names = [f"analog_{wavelength}o", f"photon_{wavelength}o"]
    files, darks = (sorted((folder / kind).iterdir()) for kind in ("signals", "dark"))
    analog, photon = read_physical(files, names, dtype=np.float64)[1].values()
    dark = read_physical(darks, names[:1], dtype=np.float64)[1][names[0]]
    range_ = (np.arange(4000) + 0.5) * 7.5
    clean = analog - dark.mean(axis=0)
    sky = photon[:, 3500:3950].mean(axis=1)
    estimate = lag_of(analog, photon)
    results, misfits = [], []
    variances = {
        "analog_variance": difference_variance(clean, range_),
        "photon_variance": oracle.smooth(photon, range_) / (600 * 0.05),
    }
    counted = photon - sky[:, np.newaxis]
    for bins in (0.0, estimate.bins):
        moved, _ = lag.shift_signal(clean, bins)
        moved -= moved[:, 3500:3950].mean(axis=1, keepdims=True)
        results.append(glue(moved, counted, range_, **variances, photon_background=sky))
        lines = lines_of(results[-1], moved, counted, variances, range_)
        misfits.append((lines["chi2"] / (lines["points"] - 2)).mean())
    before, after = results
    assert not after.no_window.any()
    assert not after.poor_fit.any()
    assert misfits[0] > 1.2
    assert misfits[1] < 0.5
    # Both channels count the same photons, whose noise cancels in the ratio.
    assert after.slope.std() < 0.5 * after.slope_standard_error.mean()
    assert after.slope.std() < 0.6 * before.slope.std()
    far = range_ > after.stop.max()
    np.testing.assert_array_equal(after.power[:, far], counted[:, far])

"""Model errors of the homogeneous path, against fits of bent signals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from support.cases import each
from support.oracles.homogeneous import iterated_fit, section, signal
from support.weights import by_weights

from lidarops.retrieve.homogeneous.path_fit import fit_homogeneous_path
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

KM = 1e-3
LONG = section(2500.0, 8000.0)


def bent(r, extinction, model_error, height=1000.0, slopes=(-1.0, 1.0)):
    """Return a profile whose logarithmic slope departs from the model at both ends."""
    departure = 2.0 * model_error * (np.abs(extinction) + 1.0 / r.mean())
    position = (r - r[0]) / (r[-1] - r[0])
    turn = slopes[0] * position + 0.5 * (slopes[1] - slopes[0]) * position**2
    return 370.0 + signal(r, height, extinction) * np.exp(departure * (r[-1] - r[0]) * turn)


@each("length", [1700.0, 8000.0])
@each("extinction", [-0.005 * KM, 0.03 * KM, 1.0 * KM])
@each("kind", ["gaps", "weights", "plain"])
def test_model_error_is_the_effect_of_a_bent_signal(kind, extinction, length):
    r = section(2500.0, length)
    weights = np.ones(r.size)
    if kind == "gaps":
        weights[20:60] = 0.0
    elif kind == "weights":
        weights = np.linspace(3.0, 0.2, r.size)
    bounds = -0.3 / r[-1], 60.0 / length
    # The mean range of the retrieval is weighted.
    share = 1e-3 * (np.abs(extinction) + 1.0 / np.average(r, weights=weights))
    share /= np.abs(extinction) + 1.0 / r.mean()
    refit = iterated_fit(r, bent(r, extinction, share), weights, bounds)
    straight = bent(r, extinction, 0.0)[np.newaxis]
    fit = fit_homogeneous_path(straight, r, **by_weights(weights[np.newaxis]))
    moved = abs(refit[0] - 370.0)
    assert moved > 1e-4
    scale = THRESHOLDS.model_error / 1e-3
    assert fit.background_model_error[0] == pytest.approx(scale * moved, rel=0.02)
    slope = 1e-3 * (np.abs(extinction) + 1.0 / np.average(r, weights=weights))
    off = np.hypot(slope, refit[2] - extinction)
    assert fit.extinction_model_error[0] == pytest.approx(scale * off, rel=0.01)


@each(("length", "share"), [(1700.0, (0.4, 0.65)), (8000.0, (0.1, 0.3))])
def test_calm_air_makes_a_part_of_the_model_error(length, share):
    """Errors of extinction over the stated ones, by eddies of 1 percent, correlated by
    exp(-(distance / 100 m)^2), without noise."""
    extinction = 0.03 * KM
    r = np.arange(2500.0, 2500.0 + length, 7.5)
    noise = np.random.default_rng(4).normal(size=(400, r.size))
    eddies = gaussian_filter1d(noise, 50.0 / 7.5, axis=1, mode="wrap")
    air = 1.0 + 0.01 * eddies / eddies.std()
    depth = np.cumsum(extinction * (air - 1.0), axis=1) * 7.5
    power = 370.0 + signal(r, 1e5, extinction) * air * np.exp(-2.0 * depth)
    fit = fit_homogeneous_path(power, r, variance=1.0)
    away = (fit.extinction - extinction) / fit.extinction_model_error
    assert share[0] < np.sqrt(np.mean(away**2)) < share[1]


def test_model_error_by_other_methods():
    scale = THRESHOLDS.model_error / 1e-4
    for extinction in (0.0, 0.03 * KM, 0.2 * KM):
        straight, curved = (bent(LONG, extinction, share)[np.newaxis] for share in (0.0, 1e-4))
        slope = 1e-4 * (extinction + 1.0 / LONG.mean())
        for arguments in (
            {"method": "cubic"},
            {"method": "linearized", "extinction": extinction},
            {"method": "known_background", "background": 370.0},
        ):
            fit = fit_homogeneous_path(straight, LONG, variance=1.0, **arguments)
            moved = fit_homogeneous_path(curved, LONG, variance=1.0, **arguments)
            off = np.abs(moved.background - fit.background)
            np.testing.assert_allclose(fit.background_model_error, scale * off, rtol=0.02)
            off = np.hypot(slope, moved.extinction - fit.extinction)
            np.testing.assert_allclose(fit.extinction_model_error, scale * off, rtol=0.01)


def test_model_error_of_the_background_at_a_known_extinction_includes_a_slope():
    arguments = {"variance": 1.0, "method": "known_extinction", "extinction": 0.03 * KM}
    fit = fit_homogeneous_path(bent(LONG, 0.03 * KM, 0.0), LONG, **arguments)
    moved = [
        float(
            fit_homogeneous_path(
                bent(LONG, 0.03 * KM, 1e-4, slopes=slopes), LONG, **arguments
            ).background
        )
        - 370.0
        for slopes in ((-1.0, 1.0), (1.0, 1.0))
    ]
    scale = THRESHOLDS.model_error / 1e-4
    assert fit.background_model_error == pytest.approx(scale * np.hypot(*moved), rel=0.02)


def test_model_error_of_the_background_scales_with_the_signal():
    noise = np.random.default_rng(31).normal(size=(500, LONG.size))
    power = 370.0 + signal(LONG, 300.0, 0.03 * KM) + noise
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    larger = fit_homogeneous_path(1e3 * power, LONG, variance=1e6)
    np.testing.assert_allclose(
        larger.background_model_error, 1e3 * fit.background_model_error, rtol=1e-9
    )
    assert np.isnan(fit_homogeneous_path(np.ones(225), LONG).background_model_error)

"""Quality tests of a homogeneous path for shapes that the model lacks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from support.cases import each
from support.oracles.homogeneous import section, signal

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous.path_fit import fit_homogeneous_path
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

KM = 1e-3
FALSE_ALARM = THRESHOLDS.false_alarm
BIT = int(Quality.NOT_HOMOGENEOUS)


def along_missing_shapes(r, power, fit):
    """Return the residuals along bent signal and squared shape, orthogonal to three tangents."""
    out = []
    for values, extinction in zip(power, fit.extinction, strict=True):
        shape = signal(r, 1.0, extinction)
        x = (r - r[0]) / np.ptp(r)
        model = np.stack([np.ones_like(r), shape, shape * x], axis=1)
        basis = np.linalg.qr(np.column_stack([model, shape * x**2, shape**2]))[0]
        line = np.linalg.lstsq(model[:, :2], values, rcond=None)[0]
        out.append((values - model[:, :2] @ line) @ basis[:, 3:])
    return np.array(out).T


def cut(r, height, extinction, top, count, seed):
    """Return profiles whose signal is cut off at a share of its first bin."""
    profile = np.minimum(signal(r, height, extinction), top * height)
    return 370.0 + profile + np.random.default_rng(seed).standard_normal((count, r.size))


@pytest.mark.parametrize(
    ("length", "height", "extinction", "top"),
    [
        (1700.0, 80.0, 0.5 * KM, 0.95),
        (8000.0, 35.0, 3.0 * KM, 0.8),
        (8000.0, 50.0, 6.0 * KM, 0.8),
    ],
)
def test_the_bit_is_raised_by_the_energy_in_two_shapes(length, height, extinction, top):
    r = section(2500.0, length)
    power = cut(r, height, extinction, top, 400, seed=11)
    fit = fit_homogeneous_path(power, r, variance=1.0)
    energy = np.sum(along_missing_shapes(r, power, fit) ** 2, axis=0)
    limit = stats.chi2.isf(FALSE_ALARM, 2)
    clear = np.abs(energy / limit - 1.0) > 0.02
    raised = (fit.quality & BIT) != 0
    np.testing.assert_array_equal(raised[clear], (energy > limit)[clear])
    assert 0.05 < np.mean(raised) < 0.95


@each("variance", [1.0, None])
@each("extinction", [0.0, 0.3 * KM, 5.0 * KM])
def test_false_alarms_of_both_are_as_rare_as_those_of_one(variance, extinction):
    r = section(2500.0, 8000.0)
    power = cut(r, 100.0, extinction, np.inf, 40_000, seed=12)
    fit = fit_homogeneous_path(power, r, variance=variance)
    assert 1e-4 < np.mean((fit.quality & BIT) != 0) < 8e-4


def test_a_signal_that_is_cut_off_is_detected_more_often_than_by_the_bent_shape():
    r = section(2500.0, 8000.0)
    power = cut(r, 50.0, 6.0 * KM, 0.8, 4000, seed=13)
    fit = fit_homogeneous_path(power, r, variance=1.0)
    bent = along_missing_shapes(r, power, fit)[0]
    by_bent = np.mean(bent**2 > stats.chi2.isf(FALSE_ALARM, 1))
    detected = np.mean((fit.quality & BIT) != 0)
    assert by_bent > 0.05
    assert detected > 2.0 * by_bent

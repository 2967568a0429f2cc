"""What is known of the field of a block before its beams are read."""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.network import _changing_field
from lidarops.retrieve.network.thresholds import THRESHOLDS

POSITION = np.array([[0.0, 0.0, 300.0], [200.0, 0.0, 500.0], [-100.0, 0.0, 900.0]])


def test_a_prior_says_nothing_about_the_level():
    priors = _changing_field.MeanPriors.at(POSITION)
    assert len(priors.precision) == len(THRESHOLDS.deviations) * len(THRESHOLDS.lengths)
    np.testing.assert_allclose(priors.precision.sum(axis=-1), 0.0, atol=1e-9)
    contrast = np.array([1.0, -1.0, 0.0])
    # Differences have the variance of the covariance: its inverse on the space of differences.
    for matrix, covariance in zip(priors.precision, priors.covariance, strict=True):
        inverse = np.linalg.pinv(matrix)
        np.testing.assert_allclose(
            contrast @ inverse @ contrast, contrast @ covariance @ contrast, rtol=1e-6
        )


def test_the_square_error_of_a_known_field_is_that_of_a_lognormal():
    variance = np.full((1, 2), 0.04)
    posterior = _changing_field.MeanPosterior(np.ones(1), np.zeros((1, 2)), variance)
    draws = np.exp(0.2 * np.random.default_rng(1).standard_normal(400_000))
    np.testing.assert_allclose(
        posterior.square_error(np.zeros(2)), np.mean((draws - 1.0) ** 2), rtol=0.01
    )

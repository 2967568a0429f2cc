"""Values of scans along a path between two draws of noise."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from support.oracles import angle_scenes
from support.oracles.angle_scenes import clear, cloud

from lidarops.retrieve.multiangle.smooth_profile import smooth_optical_depth

STEP = 6e-9
"""Shortest step along the path: far above the digits of values, and far below their errors."""
VALUES, ERRORS = 1e-5, 1e-5
"""Largest change of a value, in its error, and of the logarithm of an error."""


def solutions_between(scene, correlation, seed):
    """Return a function that solves 12 cycles at a place between two draws of their noise."""
    rng = np.random.default_rng(seed)
    first, second = (angle_scenes.estimates(scene, 12, rng, correlation) for _ in range(2))

    def solve(place):
        mixed = (1.0 - place) * first.optical_depth + place * second.optical_depth
        result = smooth_optical_depth(mixed, first.information, scene.altitude, noise=first.noise)
        return (
            (result.optical_depth, result.optical_depth_standard_error),
            (result.extinction, result.extinction_standard_error),
        )

    return solve


def jump(one, other):
    """Return the largest differences of values in errors, and of the logarithm of errors."""
    values = [np.abs(a - b) / np.fmin(e, f) for (a, e), (b, f) in zip(one, other, strict=True)]
    errors = [np.abs(np.log(e / f)) for (_, e), (_, f) in zip(one, other, strict=True)]
    return max(map(np.nanmax, values)), max(map(np.nanmax, errors))


@pytest.mark.parametrize(
    ("scene", "correlation", "seed"),
    [
        (cloud(), 0.8, 0),
        (cloud(), 0.0, 1),
        (cloud(largest=15.0), 0.8, 1),
        (clear(3000.0), 0.7, 0),
    ],
)
def test_a_hair_of_noise_changes_values_and_errors_by_little(scene, correlation, seed):
    """The weight of a least score jumps, and values with it by up to 0.8 errors in clouds."""
    solve = solutions_between(scene, correlation, seed)
    places = np.linspace(0.0, 1.0, 41)
    solved = [solve(place) for place in places]
    at = int(np.argmax([sum(jump(*pair)) for pair in itertools.pairwise(solved)]))
    (low, high), (below, above) = places[at : at + 2], solved[at : at + 2]
    while high - low > STEP:
        middle = 0.5 * (low + high)
        between = solve(middle)
        if sum(jump(below, between)) > sum(jump(between, above)):
            high, above = middle, between
        else:
            low, below = middle, between
    values, errors = jump(below, above)
    assert values < VALUES
    assert errors < ERRORS

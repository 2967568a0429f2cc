"""Weighted least squares of a homogeneous section, to judge the background of the cubic.

A fixed number of Gauss-Newton steps from the background of the cubic, all profiles at once. Sums
run along the bins of one profile, so a result does not depend on the other profiles.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array

_STEPS: Final = 4
_STEEPEST: Final = 100.0
"""Largest optical depth, there and back, of a section; the signal vanishes within a few bins."""
_LARGEST_STEP: Final = 3.0
"""Largest change of that optical depth in one step."""


class SectionFit(NamedTuple):
    """Result of each profile, (profile,)."""

    background: Array
    variance: Array
    """Of the background."""
    waves: Array
    """Chi-square of the mean residuals of `groups` of bins; the fit uses 3 degrees of freedom."""


def groups(bins: int) -> int:
    """Return the number of groups of neighbouring bins whose mean residuals are tested."""
    return min(bins, 16)


def fit_section(power: Array, range_: Array, variance: Array, background: Array) -> SectionFit:
    """Fit background, amplitude and extinction.

    Parameters
    ----------
    power, variance : (profile, bin) float
    range_ : (bin,) float
        m, ascending and uniform.
    background : (profile,) float
        From which the steps begin.
    """
    fall = (range_[0] / range_) ** 2
    with np.errstate(all="ignore"):
        along = (range_ - range_[0]) / (range_[-1] - range_[0])
        depth = _first_depth(power - background[:, np.newaxis], fall)
        root = 1.0 / np.sqrt(variance)
        for step in range(_STEPS):
            shape = fall * np.exp(-depth[:, np.newaxis] * along)
            solved = _least_squares(root * power, (root, root * shape, root * shape * along))
            change = np.clip(-solved.tilt / solved.amplitude, -_LARGEST_STEP, _LARGEST_STEP)
            usable = (solved.amplitude > 0.0) & np.isfinite(change) & (step < _STEPS - 1)
            depth = np.clip(depth + np.where(usable, change, 0.0), -_STEEPEST, _STEEPEST)
        count = groups(range_.size)
        edges = np.arange(count) * range_.size // count
        total = np.add.reduceat(solved.residuals * root, edges, axis=-1)
        weight = np.add.reduceat(root**2, edges, axis=-1)
        waves = (total**2 / weight).sum(axis=-1)
    return SectionFit(solved.background, solved.variance, waves)


def _first_depth(net: Array, fall: Array) -> Array:
    """Return the optical depth there and back from the signals of the first two quarters."""
    quarter = max(fall.size // 4, 1)
    level = net / fall
    near, next_ = level[:, :quarter].sum(axis=-1), level[:, quarter : 2 * quarter].sum(axis=-1)
    depth = np.log(near / next_) * (fall.size - 1) / quarter
    return np.where(np.isfinite(depth), np.clip(depth, -_STEEPEST, _STEEPEST), 0.0)


class _Solution(NamedTuple):
    background: Array
    variance: Array
    amplitude: Array
    tilt: Array
    residuals: Array


def _least_squares(values: Array, columns: tuple[Array, Array, Array]) -> _Solution:
    """Solve for three coefficients by orthogonalization, the background last."""
    constant, shape, tilted = columns
    residuals = np.broadcast_to(values, shape.shape).copy()
    first, first_norm = _unit(shape)
    on_tilted, on_constant = _along(first, tilted), _along(first, constant)
    second, second_norm = _unit(tilted - on_tilted[:, np.newaxis] * first)
    rest = constant - on_constant[:, np.newaxis] * first
    second_on_constant = _along(second, rest)
    third, third_norm = _unit(rest - second_on_constant[:, np.newaxis] * second)
    products = []
    for direction in (first, second, third):
        product = _along(direction, residuals)
        residuals -= product[:, np.newaxis] * direction
        products.append(product)
    background = products[2] / third_norm
    tilt = (products[1] - second_on_constant * background) / second_norm
    amplitude = (products[0] - on_tilted * tilt - on_constant * background) / first_norm
    return _Solution(background, third_norm**-2.0, amplitude, tilt, residuals)


def _unit(column: Array) -> tuple[Array, Array]:
    norm = np.sqrt((column**2).sum(axis=-1))
    return column / norm[:, np.newaxis], norm


def _along(direction: Array, column: Array) -> Array:
    return np.asarray((direction * column).sum(axis=-1))

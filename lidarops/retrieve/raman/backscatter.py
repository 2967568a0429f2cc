r"""Backscatter of particles from the ratio of an elastic to a Raman signal.

With the elastic signal over the transmission of clean air :math:`y_0 \propto \beta e^{-2 \tau_p}`
and the Raman signal over that of clean air :math:`y_R \propto e^{-\theta}`, both with the same
overlap, total backscatter is

.. math:: \beta = K \frac{y_0}{y_R} e^{-\theta + 2 \tau_p}, \qquad
    \tau_p = \frac{\theta}{1 + \kappa},

where :math:`K` makes it equal to the assumed one in the reference window. From it and the lidar
ratio follows the overlap itself (`overlap_of`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import erfcx

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman.depth_fit import DepthFit, SignalNoise
from lidarops.retrieve.raman.signals import CellSignal


def inverse_mean(signal: Array, relative_variance: Array) -> Array:
    r"""Return an estimate of the reciprocal of a mean signal, from a noisy signal.

    Posterior mean where the signal is as certain as :math:`n = 1 / s^2` counts,
    :math:`1 / (y (1 + s^2))`: for :math:`n` counts and a prior that grows with the mean, the mean
    of :math:`1 / \mu` is :math:`1 / (n + 1)`. A quotient of means is too large by :math:`s^2`.

    Parameters
    ----------
    signal : (...) float
    relative_variance : (...) float
        :math:`s^2`, by its noise.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(1.0 / (signal * (1.0 + relative_variance)))


def inverse_of_weak(value: Array, error: Array) -> Array:
    r"""Return an unbiased estimate of the reciprocal of a positive mean, from a value of it.

    For normal noise of standard error :math:`\sigma`, the ratio of Mills

    .. math:: \frac{1}{\sigma} \int_0^\infty e^{-t x / \sigma - t^2 / 2}\, \mathrm{d}t

    of a value :math:`x` has the expectation :math:`1 / \mu`, however weak the mean is; it includes
    values below zero. Of a mean of 2 errors, :math:`x / (x^2 + \sigma^2)` is too small by a fifth.

    Parameters
    ----------
    value, error : (...) float
        Value and its standard error.

    References
    ----------
    `voinov1985`.
    """
    return np.asarray(np.sqrt(0.5 * np.pi) / error * erfcx(value / (np.sqrt(2.0) * error)))


@dataclass(frozen=True, slots=True)
class Backscatter:
    """Total backscatter at the laser wavelength, (cell,) unless stated."""

    total: Array
    """m-1 sr-1, of particles and molecules; NaN where there are no data."""
    own: Array
    """m-1 sr-1, standard error by noise of the elastic signal and of a Raman signal that is not
    smoothed, of the cell itself."""
    reference: float
    """Relative standard error by noise of the elastic signal in the reference window."""
    shares: Array
    """Weight of each cell in the reference, 1 in total."""
    sensitivity: Array
    """Change of the logarithm of the ratio with the depth."""

    def respond(self, relative: Array, depth: Array) -> Array:
        """Return the change of total backscatter, m-1 sr-1.

        Parameters
        ----------
        relative : (cell, ...) float
            Relative change of the ratio of the signals.
        depth : (cell, ...) float
            Change of the optical depth of the Raman signal.
        """
        extra = (1,) * (depth.ndim - 1)
        change = relative + self.sensitivity.reshape(-1, *extra) * depth
        known = self.shares > 0.0
        calibration = np.tensordot(self.shares[known], change[known], axes=1)
        return np.asarray(self.total.reshape(-1, *extra) * (change - calibration))


@dataclass(frozen=True, slots=True)
class Ratio:
    """Elastic over Raman signal, corrected for attenuation, (cell,)."""

    value: Array
    """Proportional to total backscatter; NaN where there are no data."""
    variance: Array
    """By noise of the elastic signal, and of the Raman signal where that is not smoothed."""
    sensitivity: Array
    """Change of its logarithm with the depth."""
    factor: Array
    """By which the elastic signal was multiplied."""


def signal_ratio(
    elastic: CellSignal, raman: CellSignal, fit: DepthFit, partial: Booleans, ratio: float
) -> Ratio:
    """Return the ratio of an elastic to a Raman signal: the smooth one, but in partial overlap.

    There the fit does not hold. The ratio to the Raman signal of the same cell cancels the overlap
    that both signals have in common.

    Parameters
    ----------
    elastic, raman : CellSignal
    fit : DepthFit
        Of the Raman signal, continued into cells of partial overlap.
    partial : (cell,) bool
    ratio : float
        Particle extinction at the Raman wavelength over that at the laser's.
    """
    of_both = 2.0 / (1.0 + ratio)
    of_cell = np.where(raman.value > 0.0, raman.value, np.nan)
    signal = np.where(partial, of_cell, np.exp(-fit.depth))
    square = np.where(partial, raman.variance / of_cell**2, fit.standard_error**2)
    factor = inverse_mean(signal, square) * np.exp((of_both - 1.0) * fit.depth)
    variance = elastic.variance + np.where(partial, elastic.value**2 * square, 0.0)
    sensitivity = np.where(partial, of_both - 1.0, of_both)
    return Ratio(elastic.value * factor, variance * factor**2, sensitivity, factor)


def calibrated_backscatter(
    ratio: Ratio,
    noise: SignalNoise,
    depth_noise: Array,
    reference: Array,
    window: Booleans,
) -> Backscatter | None:
    """Return total backscatter from a ratio and the backscatter in the reference window.

    The quotient of a cell and the noisy level of the window is too large by the relative variance
    of the level, less its covariance with the cell; it is divided by that.

    Parameters
    ----------
    ratio : Ratio
    noise : SignalNoise
        Of the elastic signal: weights by the observed counts would prefer low ones.
    depth_noise : (cell, noise of a cell) float
        Response of the depth of the Raman signal to independent unit noise.
    reference : (cell,) float
        m-1 sr-1, total backscatter that is assumed in the window.
    window : (cell,) bool

    Returns
    -------
    Backscatter or None
        None where the window holds no signal.

    References
    ----------
    `ansmann1992`.
    """
    used = window & np.isfinite(ratio.value) & np.isfinite(ratio.variance)
    if not used.any():
        return None
    first = float(ratio.value[used].sum() / reference[used].sum())
    if not first > 0.0:
        return None
    factor = np.where(used, ratio.factor, 1.0)
    variance = noise.of(first * reference / factor) * factor**2
    weight = np.where(used, reference, 0.0) / np.where(used, variance, 1.0)
    level = float((weight[used] * ratio.value[used]).sum())
    if not level > 0.0:
        return None
    expected = weight * reference
    level_scale = float(expected.sum()) / level
    # The noise of the window relative to its level, by the expected variances.
    spread = float(np.sqrt((weight[used] ** 2 * variance[used]).sum())) / level
    shares = expected / expected.sum()
    of_cells = ratio.sensitivity[:, np.newaxis] * depth_noise
    of_level = shares @ of_cells
    scale = level_scale / (1.0 + spread**2 + of_level @ of_level - of_cells @ of_level)
    return Backscatter(
        total=scale * ratio.value,
        own=scale * np.sqrt(ratio.variance),
        reference=spread,
        shares=shares,
        sensitivity=ratio.sensitivity,
    )


_ABOVE: Final = 1000.0
"""m above full overlap, in which the lidar ratio is averaged. Assumed."""


def overlap_of(
    raman: Array,
    variance: Array,
    depth: Array,
    backscatter: Array,
    lidar_ratio: tuple[Array, Array],
    partial: Booleans,
    step: float,
    ratio: float,
) -> tuple[Array, Array]:
    r"""Return the overlap below the range of full overlap, and its standard error, (cell,).

    It is 1 beyond full overlap, and NaN where it is not known. The error is that by noise of the
    Raman signal, and by the lidar ratio.

    Overlap cancels in backscatter. With the lidar ratio :math:`S` that is measured above the range
    :math:`R_f` of full overlap, it is linear in the Raman signal, and no iteration is needed:

    .. math:: O(R) = y_R\, e^{\theta(R_f)} \exp\Big(-(1 + \kappa)
        \int_R^{R_f} S \beta_p\, \mathrm{d}r\Big)

    Parameters
    ----------
    raman, variance : (cell,) float
        Raman signal over that of clean air, not corrected for overlap, and its variance.
    depth : (cell,) float
        Fitted optical depth of the Raman signal.
    backscatter : (cell,) float
        m-1 sr-1, of particles.
    lidar_ratio : ((cell,) float, (cell,) float)
        sr, with its standard error.
    partial : (cell,) bool
        Cells without full overlap.
    step : float
        m.
    ratio : float
        Particle extinction at the Raman wavelength over that at the laser's.

    References
    ----------
    `wandinger2002`.
    """
    missing = np.where(partial, np.nan, 1.0)
    first = int(np.argmin(partial))
    above = slice(first, first + max(1, round(_ABOVE / step)))
    known = np.isfinite(lidar_ratio[0][above])
    if not partial[0] or not known.any():
        return missing, missing - 1.0
    ratio_above, error = (float(part[above][known].mean()) for part in lidar_ratio)
    near = np.where(partial, np.nan_to_num(backscatter), 0.0)
    beyond = (1.0 + ratio) * step * (np.cumsum(near[::-1])[::-1] - 0.5 * near)
    # The first cell of full overlap contributes its nearer half.
    beyond += 0.5 * (1.0 + ratio) * step * float(np.nan_to_num(backscatter[first]))
    transmission = np.exp(depth[first] - ratio_above * beyond)
    value = np.where(partial, raman * transmission, 1.0)
    noise = np.sqrt(variance) * transmission
    return value, np.where(partial, np.hypot(noise, value * error * beyond), 0.0)

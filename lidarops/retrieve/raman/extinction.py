"""Extinction of particles from the slope of the optical depth of a Raman signal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.raman.depth_fit import DepthFit, root_of_squares


@dataclass(frozen=True, slots=True)
class Extinction:
    """Particle extinction at the laser wavelength, (cell,) unless stated."""

    value: Array
    """m-1."""
    kernel: Array
    """(cell, cell): weights of the true extinction of each cell in the value, 1 in total."""
    vertical_resolution: Array
    """m along the beam: length over which a mean has the sum of squared weights of the kernel."""
    noise: Array
    """(cell, noise of a cell): response in m-1 to independent unit noise."""
    resolution_error: Array
    """m-1: of the value as the mean over `vertical_resolution`."""
    smoothing_error: Array
    """m-1: of the value as the extinction of the cell itself."""

    @property
    def noise_error(self) -> Array:
        """Standard error by noise, m-1."""
        return root_of_squares(self.noise)


def slope(depth: Array, step: float) -> Array:
    """Return the derivative along the first axis: central differences, one-sided at the ends."""
    change = np.empty(depth.shape)
    change[1:-1] = depth[2:] - depth[:-2]
    change[1:-1] *= 0.5 / step
    change[0] = (depth[1] - depth[0]) / step
    change[-1] = (depth[-1] - depth[-2]) / step
    return change


def extinction_of(fit: DepthFit, step: float, ratio: float) -> Extinction:
    r"""Return the extinction of a fit, with resolution and errors.

    .. math:: \alpha = \frac{1}{1 + \kappa} \frac{\mathrm{d}\theta}{\mathrm{d}R}

    The smoothness is also a model of extinction: a random walk, from which the errors by
    resolution follow.

    Parameters
    ----------
    fit : DepthFit
    step : float
        m, length of a cell.
    ratio : float
        :math:`\kappa`, particle extinction at the Raman wavelength over that at the laser's.

    References
    ----------
    `ansmann1990`; `iarlori2015` (resolution).
    """
    both = 1.0 + ratio
    response = slope(fit.inverse, step)
    weights = response * fit.information
    beyond = np.cumsum(weights[:, ::-1], axis=1)[:, ::-1]
    kernel = step * (beyond - 0.5 * weights)
    resolution = step / root_of_squares(kernel) ** 2
    walk = np.sqrt(1.0 / fit.walk) / (step * both)
    away = kernel - mean_weights(resolution, step)
    return Extinction(
        value=slope(fit.depth, step) / both,
        kernel=kernel,
        vertical_resolution=resolution,
        noise=response * np.sqrt(fit.information) / both,
        resolution_error=walk * _summed(away),
        smoothing_error=walk * _summed(kernel - np.eye(kernel.shape[0])),
    )


def _summed(weights: Array) -> Array:
    """Return the response of weighted sums to a random walk with unit steps."""
    return root_of_squares(np.cumsum(weights[:, :0:-1], axis=1))


def mean_weights(length: Array, step: float) -> Array:
    """Return the weights of cells in means over a length around each cell, within the profile.

    Parameters
    ----------
    length : (cell,) float
        m.
    step : float
        m, length of a cell.

    Returns
    -------
    (cell, cell) float64
        Rows have the sum 1.
    """
    edges = np.arange(length.size + 1) * step
    middle = 0.5 * (edges[1:] + edges[:-1])
    low, high = middle - 0.5 * length, middle + 0.5 * length
    inside = np.minimum(high[:, np.newaxis], edges[1:])
    inside -= np.maximum(low[:, np.newaxis], edges[:-1])
    np.maximum(inside, 0.0, out=inside)
    return np.asarray(inside / inside.sum(axis=1, keepdims=True))

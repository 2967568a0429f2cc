"""Second-order error of the linearised method."""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.homogeneous._problem import PathProblem


def neglected_shifts(
    problem: PathProblem, prior: Array, extinction: Array, amplitude: Array
) -> tuple[Array, Array, Array]:
    """Return the shifts of the parameters by the second-order term that one step neglects.

    With the step t in extinction and the coefficient b of the shape phi, the term is
    ``2 b t^2 (x - x_c)^2 phi``, x_c being the centroid of information.

    Parameters
    ----------
    problem : PathProblem
    prior : (profile or 1,) float
        m-1.
    extinction, amplitude : (profile,) float
        m-1, power times m2: the result of one step.

    Returns
    -------
    (profile,) float
        Shifts of the background, of the logarithm of the amplitude and of the extinction.
    """
    near, length = problem.range[0], max(float(problem.range[-1] - problem.range[0]), 1.0)
    x = (problem.range - near) / length
    with np.errstate(all="ignore"):
        weights = 1.0 / problem.noise if problem.known_variance else problem.noise
        usable = np.isfinite(problem.power) & (weights > 0.0) & np.isfinite(weights)
        weights = np.where(usable, weights, 0.0)
        total = weights.sum(axis=-1)

        def mean(values: Array) -> Array:
            return np.asarray((weights * values).sum(axis=-1) / total)

        def share(values: Array, of: Array) -> Array:
            return mean(values * of) / mean(of * of)

        shape = np.exp(-2.0 * prior[:, np.newaxis] * length * x) * (near / problem.range) ** 2
        shape_mean = mean(shape)
        centred = shape - shape_mean[:, np.newaxis]
        centroid = mean(centred * shape * x) / mean(centred * centred)
        distance = x - centroid[:, np.newaxis]
        slope = -2.0 * distance * shape
        slope_mean = mean(slope)
        slope = slope - slope_mean[:, np.newaxis]
        # The coefficient at the first bin, with the fitted extinction: of second order already.
        height = amplitude / near**2 * np.exp(-2.0 * extinction * near)
        step = (extinction - prior) * length
        neglected = (2.0 * height * step**2)[:, np.newaxis] * distance**2 * shape
        level = mean(neglected)
        neglected = neglected - level[:, np.newaxis]
        along_slope, along_shape = share(neglected, slope), share(neglected, centred)
        background = level - along_shape * shape_mean - along_slope * slope_mean
        shift = (along_slope - step * along_shape) / height
        logarithm = along_shape / height + 2.0 * (centroid + near / length) * shift
    return background, logarithm, shift / length

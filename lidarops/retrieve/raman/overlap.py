"""Overlap of laser beam and field of view, from an elastic and a Raman signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans

_ABOVE: Final = 1000.0
"""m above full overlap, in which the lidar ratio is averaged. Assumed."""


@dataclass(frozen=True, slots=True)
class OverlapProfile:
    """Overlap function, (cell,): 1 beyond full overlap, NaN where it is not known."""

    value: Array
    standard_error: Array
    """By noise of the Raman signal, and by the lidar ratio."""


def overlap_of(
    raman: Array,
    variance: Array,
    depth: Array,
    backscatter: Array,
    lidar_ratio: tuple[Array, Array],
    partial: Booleans,
    step: float,
    ratio: float,
) -> OverlapProfile:
    r"""Return the overlap below the range of full overlap.

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
        return OverlapProfile(missing, missing - 1.0)
    ratio_above, error = (float(part[above][known].mean()) for part in lidar_ratio)
    near = np.where(partial, np.nan_to_num(backscatter), 0.0)
    beyond = (1.0 + ratio) * step * (np.cumsum(near[::-1])[::-1] - 0.5 * near)
    # The first cell of full overlap contributes its nearer half.
    beyond += 0.5 * (1.0 + ratio) * step * float(np.nan_to_num(backscatter[first]))
    transmission = np.exp(depth[first] - ratio_above * beyond)
    value = np.where(partial, raman * transmission, 1.0)
    noise = np.sqrt(variance) * transmission
    return OverlapProfile(value, np.where(partial, np.hypot(noise, value * error * beyond), 0.0))

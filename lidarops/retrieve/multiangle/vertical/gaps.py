"""Precision of optical depths along altitude where samples are missing between others."""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

_HALF_WINDOW: Final = THRESHOLDS.half_window
_LINKED: Final = THRESHOLDS.linked
_FARTHEST: Final = 2
"""Largest distance of linked altitudes."""
_LEAST_SHARE: Final = THRESHOLDS.least_correlated

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def profiles_with_gaps(
    used: Booleans, signal: npt.NDArray[np.floating], variance: Array
) -> Booleans:
    """Return which profiles miss samples between others of the same beam.

    A weak signal that noise made negative is not used, but does not count as missing.

    Parameters
    ----------
    used : (profile, beam, altitude) bool
        Samples that are used.
    signal, variance : (profile, beam, altitude) float
        NaN where missing.

    Returns
    -------
    (profile,) bool
    """
    gaps: Booleans = np.any(used[..., 1:] & ~used[..., :-1], axis=(1, 2))
    rows = np.flatnonzero(gaps)
    if rows.size:
        below = np.logical_or.accumulate(used[rows], axis=-1)
        above = np.logical_or.accumulate(used[rows, :, ::-1], axis=-1)[..., ::-1]
        measured = np.isfinite(signal[rows]) & np.isfinite(variance[rows])
        gaps[rows] = np.any(below & above & ~measured, axis=(1, 2))
    return gaps


@_compiled
def _link(information: Array, share: Array, linked: Booleans) -> None:
    """Fill which altitudes have at least half of the correlated share of those on either side."""
    for k in range(share.size):
        most = np.max(share[max(k - 2, 0) : k + 3])
        enough = share[k] > _LEAST_SHARE and share[k] >= _LINKED * most
        linked[k] = information[k] > 0.0 and enough


@_compiled
def _own_noise(share: Array, linked: Booleans, k: int) -> float:
    """Return the mean over links around an altitude of own over correlated noise."""
    total = count = 0.0
    for j in range(max(k - _HALF_WINDOW, 0), min(k + _HALF_WINDOW + 1, share.size)):
        if linked[j]:
            total += (1.0 - share[j]) / share[j]
            count += 1.0
    return total / count if count > 0.0 else 0.0


@_compiled
def gap_precision(information: Array, share: Array, correlation: float) -> Array:
    r"""Return the precision of estimates whose neighbours come from different beams.

    The noise is :math:`n_k = c_k + e_k`: c is common to altitudes, with the variance
    :math:`f / I` and the correlation :math:`\rho^d`; e is that of a single altitude. The variance
    of c hardly depends on the missing beams, while that of e changes from altitude to altitude. In
    a chain scaled with the standard errors of single altitudes, :math:`z_k - r z_{k-1}` over
    :math:`\sqrt{1 - r^2}` would turn a smooth profile into one that jumps with these errors, and
    the data would appear far more certain than they are. Links therefore have the mean
    :math:`m = \overline{(1 - f) / f}` of their neighbourhood,

    .. math:: f' = \frac{1}{1 + m_k}, \quad I' = \frac{f' I}{f}, \quad
              m_k = m + (1 - r)^2 \left(\frac{1 - f}{f} - m\right), \quad r = \frac{q - 1}{q + 1},

    so that a chain with little correlation keeps the weights of its altitudes.

    At low frequencies, an altitude of a chain has the information :math:`I / q` on a smooth
    profile, and two links that bridge a third :math:`(1 - r^2) / (1 + r^2)`, nearly twice
    :math:`(1 - r) / (1 + r)`. The bridged altitude adds the missing information,
    :math:`(1 - r)^2 / (1 + r^2) \cdot I / q`, not I. Behind a gap of more than one altitude no
    link is possible: the chain that starts there has :math:`(1 - r^d) / (1 + r^d)` of the
    information of a first altitude.

    Parameters
    ----------
    information : (profile, altitude) float64
        0 where there is no estimate.
    share : (profile, altitude) float64
        f, correlated share of the variance.
    correlation : float
        :math:`\rho`, of the correlated noise at neighbouring altitudes.

    Returns
    -------
    (3, profile, altitude) float64
        Diagonal, and the first and second off-diagonals (of an altitude with those above it).
    """
    profiles, altitudes = information.shape
    bands = np.zeros((3, profiles, altitudes))
    decay = 2.0 * correlation / (1.0 - correlation)
    linked = np.zeros(altitudes, np.bool_)
    for t in range(profiles):
        _link(information[t], share[t], linked)
        last, known = -1, 0.0
        for k in range(altitudes):
            own = information[t, k]
            if not (own > 0.0 and share[t, k] > _LEAST_SHARE):
                bands[0, t, k] = own
                continue
            usual = _own_noise(share[t], linked, k)
            q = decay / (1.0 + usual)
            r = q / (q + 2.0)
            if not linked[k]:
                left = (1.0 - r) * (1.0 - r) / (1.0 + r * r)
                bands[0, t, k] = left * own / (1.0 + share[t, k] * decay)
                continue
            ratio = (1.0 - share[t, k]) / share[t, k]
            level = 1.0 / (1.0 + usual + (1.0 - r) * (1.0 - r) * (ratio - usual))
            own *= level / share[t, k]
            step = k - last
            q = level * decay
            joint = (q / (q + 2.0)) ** step
            bands[0, t, k] = own
            if last >= 0 and step > _FARTHEST:
                bands[0, t, k] = own * (1.0 - joint) / (1.0 + joint)
            elif last >= 0:
                rest = 1.0 - joint * joint
                bands[0, t, k] = own / rest
                bands[0, t, last] += known * joint * joint / rest
                bands[step, t, last] = -joint / rest * np.sqrt(own) * np.sqrt(known)
            last, known = k, own
    return bands

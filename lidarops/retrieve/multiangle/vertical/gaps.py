"""The precision of optical depths along height where samples are missing here and there."""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

_HALF_WINDOW: Final = 7
_LINKED: Final = 0.5
_FARTHEST: Final = 2
_LEAST_SHARE: Final = 1e-6
"""Below which no noise is shared, and its ratio to that of a height's own means nothing."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def profiles_with_gaps(
    there: Booleans, signal: npt.NDArray[np.floating], variance: Array
) -> Booleans:
    """Tell which profiles miss samples between others of the same beam.

    Of weak light, a sample that noise made negative is not missing, though it is not used.

    Parameters
    ----------
    there : (profile, beam, height) bool
        Samples that are used.
    signal, variance : (profile, beam, height) float
        NaN where missing.

    Returns
    -------
    (profile,) bool
    """
    found: Booleans = np.any(there[..., 1:] & ~there[..., :-1], axis=(1, 2))
    rows = np.flatnonzero(found)
    if rows.size:
        below = np.logical_or.accumulate(there[rows], axis=-1)
        above = np.logical_or.accumulate(there[rows, :, ::-1], axis=-1)[..., ::-1]
        given = np.isfinite(signal[rows]) & np.isfinite(variance[rows])
        found[rows] = np.any(below & above & ~given, axis=(1, 2))
    return found


@_compiled
def _link(information: Array, share: Array, linked: Booleans) -> None:
    """Fill which heights share at least half as much noise as the two on either side."""
    for k in range(share.size):
        most = np.max(share[max(k - 2, 0) : k + 3])
        enough = share[k] > _LEAST_SHARE and share[k] >= _LINKED * most
        linked[k] = information[k] > 0.0 and enough


@_compiled
def _own_noise(share: Array, linked: Booleans, k: int) -> float:
    """Return the mean over links around a height of their own noise over what they share."""
    total = count = 0.0
    for j in range(max(k - _HALF_WINDOW, 0), min(k + _HALF_WINDOW + 1, share.size)):
        if linked[j]:
            total += (1.0 - share[j]) / share[j]
            count += 1.0
    return total / count if count > 0.0 else 0.0


@_compiled
def gap_precision(information: Array, share: Array, correlation: float) -> Array:
    r"""Return the precision of estimates of which neighbours come from other beams.

    The noise is :math:`n_k = c_k + e_k`: the first is shared, of variance :math:`f / I` and
    correlated by :math:`\rho^d`, the second of a height alone. The variance of
    c hardly changes with the beams that are missing, that of e does from height to height. In
    a chain of the standard errors of single heights, :math:`z_k - r z_{k-1}` over
    :math:`\sqrt{1 - r^2}` would take a smooth profile for one that jumps with these,
    and the data for far more certain than they are; so links have the mean
    :math:`m = \overline{(1 - f) / f}` of their neighbourhood,

    .. math:: f' = \frac{1}{1 + m_k}, \quad I' = \frac{f' I}{f}, \quad
              m_k = m + (1 - r)^2 \left(\frac{1 - f}{f} - m\right), \quad r = \frac{q - 1}{q + 1},

    which leaves a chain of little correlation the weights of its heights.

    At low frequencies, a height of a chain tells :math:`I / q` of a smooth profile, and two links
    that bridge a third :math:`(1 - r^2) / (1 + r^2)`, nearly twice :math:`(1 - r) / (1 + r)`. The
    height that is bridged adds what is missing, :math:`(1 - r)^2 / (1 + r^2) \cdot I / q`, not
    I. Behind a hole of more than one height no link is possible: a chain that starts anew there
    tells :math:`(1 - r^d) / (1 + r^d)` of what the first of all tells.

    Parameters
    ----------
    information : (profile, height) float64
        0 where there is no estimate.
    share : (profile, height) float64
        f, correlated share of the variance.
    correlation : float
        :math:`\rho`, of the shared noise at neighbouring heights.

    Returns
    -------
    (3, profile, height) float64
        Diagonal, and the first and second off-diagonals (of a height with those above it).
    """
    profiles, heights = information.shape
    bands = np.zeros((3, profiles, heights))
    decay = 2.0 * correlation / (1.0 - correlation)
    linked = np.zeros(heights, np.bool_)
    for t in range(profiles):
        _link(information[t], share[t], linked)
        last, known = -1, 0.0
        for k in range(heights):
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

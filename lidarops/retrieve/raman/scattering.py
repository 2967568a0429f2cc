r"""Vibrational Raman scattering of nitrogen and water vapour: wavelengths, lines, extinction."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarops.retrieve.air.molecular import BOLTZMANN_CONSTANT

Array = NDArray[np.float64]

NITROGEN_SHARE: Final = 0.78084
"""Mole fraction of nitrogen in dry air (`us1976`)."""
NITROGEN_SHIFT: Final = 233_070.0
"""m-1, of the vibrational Raman lines of nitrogen (`wandinger2005`)."""
WATER_SHIFT: Final = 365_700.0
"""m-1, of those of water vapour (`whiteman2003`)."""
LINE_TOLERANCE: Final = 2e-9
"""m, by which a channel may be off a Raman line. Headers round wavelengths of laser and channel to
1 nm, which makes up to 1.2 nm at 607 nm, and state that of water vapour as 407 or 408 nm."""
MASS_RATIO: Final = 18.01528 / 28.9644
"""Molar mass of water over that of dry air."""

_HC: Final = 6.62607015e-34 * 299_792_458.0
"""J m, exact (SI)."""
_ROTATION: Final = 198.957
"""m-1, rotational constant of nitrogen in the ground state (`wandinger2005`)."""
_COUPLING: Final = 1.738
"""m-1, by which the rotational constant of the excited state is smaller."""
_ANISOTROPY: Final = 4.23 / 2.62
"""Squared anisotropy over squared mean of the derived polarisability of nitrogen
(`wandinger2005`)."""
_LINES: Final = 41
"""Rotational states; less than 1e-6 of nitrogen is in higher ones at 320 K."""


def raman_wavelength(wavelength: float, shift: float) -> float:
    """Return the wavelength in m of Raman scattering with a shift in m-1."""
    return 1.0 / (1.0 / wavelength - shift)


def is_raman_line(channel: float, wavelength: float, shift: float) -> bool:
    """Return whether a channel at a wavelength in m has the Raman line of a laser wavelength."""
    return abs(channel - raman_wavelength(wavelength, shift)) < LINE_TOLERANCE


def particle_ratio(exponent: float, wavelength: float, raman: float) -> float:
    """Return the particle extinction at a Raman wavelength over that at the laser wavelength.

    Parameters
    ----------
    exponent : float
        Ångström exponent of extinction.
    wavelength, raman : float
        m, of the laser and of the Raman signal.
    """
    return float((wavelength / raman) ** exponent)


def nitrogen_line_share(
    temperature: ArrayLike, wavelength: float, centre: float, width: float
) -> Array:
    r"""Return the share of the nitrogen Raman scattering that passes a Gaussian filter.

    The branches O, Q and S of the vibrational line at temperature :math:`T`; states :math:`J` have
    the nuclear weights 6 (even) and 3 (odd). Its change with temperature is an error of signals
    whose cross section is taken as constant.

    Parameters
    ----------
    temperature : array_like, K
    wavelength : float, m
        Of the laser.
    centre, width : float, m
        Centre of the filter and its full width at half maximum.

    References
    ----------
    `whiteman2003` (temperature dependence), `wandinger2005` (constants).
    """
    j = np.arange(_LINES, dtype=np.float64)
    upper = _ROTATION - _COUPLING
    q = NITROGEN_SHIFT - _COUPLING * j * (j + 1.0)
    shifts = np.concatenate([q, q + upper * (4.0 * j + 6.0), q - upper * (4.0 * j - 2.0)])
    placzek = [
        j * (j + 1.0) / ((2.0 * j - 1.0) * (2.0 * j + 3.0)),
        1.5 * (j + 1.0) * (j + 2.0) / ((2.0 * j + 1.0) * (2.0 * j + 3.0)),
        1.5 * j * (j - 1.0) / ((2.0 * j + 1.0) * (2.0 * j - 1.0)),
    ]
    isotropic = np.repeat([45.0, 0.0, 0.0], _LINES)
    strength = isotropic + 7.0 * _ANISOTROPY * np.concatenate(placzek)
    lines = 1.0 / (1.0 / wavelength - shifts)
    passed = np.exp(-4.0 * np.log(2.0) * ((lines - centre) / width) ** 2)
    t = np.asarray(temperature, dtype=np.float64)[..., np.newaxis]
    spin = np.where(j % 2 == 0, 6.0, 3.0) * (2.0 * j + 1.0)
    population = spin * np.exp(-_HC * _ROTATION * j * (j + 1.0) / (BOLTZMANN_CONSTANT * t))
    weights = np.concatenate([population] * 3, axis=-1) * strength
    return np.asarray((weights * passed).sum(axis=-1) / weights.sum(axis=-1))

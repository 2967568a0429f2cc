"""Mie scattering by spheres whose radii have a log-normal distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarops.simulate import _checks
from lidarops.simulate._checks import SimulationInputError

try:
    import miepython
except ModuleNotFoundError as error:
    raise ImportError("scattering by spheres needs miepython: pip install lidarops[mie]") from error

Array = NDArray[np.float64]

_LARGEST_RADIUS: Final = 20e-6
"""m. Larger particles fall out within hours; aerosol models end here too."""
_WIDTH: Final = 5.0
"""Half width of the quadrature about the area median, in standard deviations of the logarithm."""
_STEP: Final = 0.02
"""Step of the quadrature, in standard deviations of the logarithm of the radius."""


@dataclass(frozen=True, slots=True)
class Lognormal:
    """Log-normal number distribution of particle radii."""

    median_radius: float
    """m, of the number distribution."""
    deviation: float
    """Geometric standard deviation, 1."""

    def __post_init__(self) -> None:
        """Refuse what cannot be a distribution of aerosol."""
        if not 1e-10 <= self.median_radius <= 1e-3:
            raise SimulationInputError(
                f"is {self.median_radius:g} m",
                field="median_radius",
                remedy="give metres: 0.5e-6, not 0.5",
            )
        if not 1.0 < self.deviation <= 5.0:
            raise SimulationInputError(
                f"is {self.deviation:g}",
                field="deviation",
                remedy="give the geometric standard deviation, between 1 and 5",
            )


@dataclass(frozen=True, slots=True)
class Scattering:
    """How the mean particle scatters at one wavelength."""

    extinction: float
    """Cross section, m2."""
    scattering: float
    """Cross section, m2."""
    angle: Array
    """Scattering angle, rad, 0 to pi."""
    phase_function: Array
    """At each angle; its mean over the sphere is 1."""
    asymmetry: float
    """Mean cosine of the scattering angle."""

    @property
    def single_scattering_albedo(self) -> float:
        """Scattering over extinction, 1."""
        return self.scattering / self.extinction

    @property
    def lidar_ratio(self) -> float:
        r"""Extinction over backscatter, sr: :math:`4 \pi / (\omega P(\pi))`."""
        return 4.0 * math.pi / (self.single_scattering_albedo * float(self.phase_function[-1]))


def lognormal_scattering(
    sizes: Lognormal,
    refractive_index: complex,
    wavelength: float,
    *,
    angle: ArrayLike | None = None,
) -> Scattering:
    r"""Return how spheres with log-normally distributed radii scatter.

    Parameters
    ----------
    sizes : Lognormal
        Cut at a radius of 20 micrometres.
    refractive_index : complex
        Of the particles relative to air; absorption as a negative imaginary part, 1.45 - 0.005j.
    wavelength : float, m
    angle : array_like, rad, optional
        From 0 to pi, ascending. By default angles that are dense in the forward direction, where
        large particles scatter.

    Returns
    -------
    Scattering

    Raises
    ------
    SimulationInputError
        For a wavelength that is not in m, a refractive index with gain, or angles that do not
        span 0 to pi.

    Notes
    -----
    .. math:: C = \int \pi r^2 Q(2 \pi r / \lambda) n(\ln r) \, d\ln r, \quad
              P = \frac{2 \lambda^2}{C_{sca}} \int \frac{|S_1|^2 + |S_2|^2}{4 \pi} n \, d\ln r

    by the trapezoidal rule in the logarithm of the radius. The asymmetry is the exact one of the
    series, not that of the tabulated phase function. With 50 nodes per standard deviation the
    backscatter, in which the ripples of spheres are strongest, is converged to 0.2 percent.

    References
    ----------
    `bohren1983`, equations 3.15 and 4.61 to 4.77; amplitudes of the package miepython.
    """
    _checks.wavelength_in_metres("wavelength", wavelength)
    if not (refractive_index.real > 0.0 and refractive_index.imag <= 0.0):
        raise SimulationInputError(
            f"is {refractive_index}",
            field="refractive_index",
            remedy="write absorption as a negative imaginary part, such as 1.45 - 0.005j",
        )
    angles = _default_angles() if angle is None else np.asarray(angle, dtype=np.float64)
    spans = angles.ndim == 1 and angles.size > 2 and angles[0] == 0.0
    if not (spans and np.all(np.diff(angles) > 0) and abs(angles[-1] - math.pi) < 1e-12):
        raise SimulationInputError("does not ascend from 0 to pi rad", field="angle")
    return _size_average(sizes, refractive_index, wavelength, angles.tobytes())


def tropospheric_scattering(wavelength: float) -> Scattering:
    """Return how tropospheric aerosol with a median diameter of 1 micrometre scatters.

    Parameters
    ----------
    wavelength : float, m

    Raises
    ------
    SimulationInputError
        For a wavelength that is not in m.

    Notes
    -----
    Median radius 0.5 micrometres, geometric standard deviation 1.5, refractive index
    1.45 - 0.005j. The source shows the phase function of such particles, which agrees with the
    tropospheric model of `sra1984`. It prints neither the width nor the refractive index: those
    are assumptions of this project.

    References
    ----------
    `vasylkivskyi2009`, figure.
    """
    return lognormal_scattering(Lognormal(0.5e-6, 1.5), 1.45 - 0.005j, wavelength)


def _default_angles() -> Array:
    forward = np.geomspace(1e-3, 0.1, 60)
    return np.concatenate([[0.0], forward[:-1], np.linspace(0.1, math.pi, 421)])


@lru_cache(maxsize=64)
def _size_average(sizes: Lognormal, index: complex, wavelength: float, angles: bytes) -> Scattering:
    angle = np.frombuffer(angles)
    width = math.log(sizes.deviation)
    middle = math.log(sizes.median_radius) + 2.0 * width**2
    stop = min(middle + _WIDTH * width, math.log(_LARGEST_RADIUS))
    logarithm = np.arange(middle - _WIDTH * width, stop, _STEP * width)
    radius = np.exp(logarithm)
    number = np.exp(-0.5 * ((logarithm - math.log(sizes.median_radius)) / width) ** 2)
    number *= _STEP / math.sqrt(2.0 * math.pi)
    size = 2.0 * math.pi * radius / wavelength
    extinction, scattering, _, asymmetry = miepython.efficiencies_mx(index, size)
    area = math.pi * radius**2 * number
    total = float(area @ scattering)
    intensity = np.zeros(angle.size)
    for x, count in zip(size, number, strict=True):
        perpendicular, parallel = miepython.S1_S2(index, x, np.cos(angle), norm="wiscombe")
        intensity += count * (np.abs(perpendicular) ** 2 + np.abs(parallel) ** 2)
    # The differential cross section is (|S1|^2 + |S2|^2) / 2 k^2.
    phase = intensity * wavelength**2 / (2.0 * math.pi * total)
    return Scattering(
        extinction=float(area @ extinction),
        scattering=total,
        angle=angle,
        phase_function=phase,
        asymmetry=float((area * scattering) @ asymmetry) / total,
    )

"""Mie scattering of spheres with a log-normal distribution of radii."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import miepython
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarops.errors import RetrievalInputError

Array = NDArray[np.float64]

LARGEST_RADIUS: Final = 20e-6
"""m. Larger particles fall out within hours; the distributions of models end here too."""
_WIDTH: Final = 5.0
"""Standard deviations of the logarithm that the quadrature covers, about the area median."""
_STEP: Final = 0.02
"""Of the quadrature, in standard deviations of the logarithm of the radius."""
_LONGEST: Final = 1e-4
"""m; no laser has such a wavelength: a guard of units."""


@dataclass(frozen=True, slots=True)
class Lognormal:
    """Numbers of particles over the logarithm of their radius, as a normal distribution."""

    median_radius: float
    """m, of the number distribution."""
    deviation: float
    """Geometric standard deviation, 1."""

    def __post_init__(self) -> None:
        """Refuse what cannot be a distribution of aerosol."""
        if not 1e-10 <= self.median_radius <= 1e-3:
            raise RetrievalInputError(
                f"is {self.median_radius:g} m",
                field="median_radius",
                remedy="give metres: 0.5e-6, not 0.5",
            )
        if not 1.0 < self.deviation <= 5.0:
            raise RetrievalInputError(
                f"is {self.deviation:g}",
                field="deviation",
                remedy="give the geometric standard deviation, between 1 and 5",
            )

    @property
    def volume(self) -> float:
        r"""Mean volume of a particle, m3: :math:`4 \pi / 3 \, r_g^3 e^{4.5 \ln^2 \sigma_g}`."""
        logarithm = math.log(self.deviation)
        return 4.0 / 3.0 * math.pi * self.median_radius**3 * math.exp(4.5 * logarithm**2)


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
    """Of the angle; its mean over the sphere is 1."""
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


def default_angles() -> Array:
    """Return scattering angles that are dense forward, where large particles scatter, rad."""
    forward = np.geomspace(1e-3, 0.1, 60)
    return np.concatenate([[0.0], forward[:-1], np.linspace(0.1, math.pi, 421)])


def lognormal_scattering(
    sizes: Lognormal,
    refractive_index: complex,
    wavelength: float,
    *,
    angle: ArrayLike | None = None,
    largest_radius: float = LARGEST_RADIUS,
) -> Scattering:
    r"""Return how spheres of a log-normal distribution of radii scatter.

    Parameters
    ----------
    sizes : Lognormal
    refractive_index : complex
        Of the particles relative to air; absorption as a negative imaginary part, 1.45 - 0.005j.
    wavelength : float, m
    angle : array_like, rad, optional
        From 0 to pi, ascending; `default_angles` where not given.
    largest_radius : float, m
        Where the distribution is cut.

    Returns
    -------
    Scattering

    Raises
    ------
    RetrievalInputError
        For a wavelength that is not in m, a refractive index with gain, angles that do not
        span 0 to pi.

    Notes
    -----
    .. math:: C = \int \pi r^2 Q(2 \pi r / \lambda) n(\ln r) \, d\ln r, \quad
              P = \frac{2 \lambda^2}{C_{sca}} \int \frac{|S_1|^2 + |S_2|^2}{4 \pi} n \, d\ln r

    by the trapezoidal rule in the logarithm of the radius. The asymmetry is the exact one of the
    series, not that of the tabulated phase function. With 50 nodes a standard deviation the
    backscatter, in which the ripples of spheres are strongest, is converged to 0.2 percent.

    References
    ----------
    `bohren1983`, equations 3.15 and 4.61 to 4.77; amplitudes of the package miepython.
    """
    if not 1e-8 <= wavelength <= _LONGEST:
        raise RetrievalInputError(
            f"is {wavelength:g} m", field="wavelength", remedy="give metres: 532e-9, not 532"
        )
    if not (refractive_index.real > 0.0 and refractive_index.imag <= 0.0):
        raise RetrievalInputError(
            f"is {refractive_index}",
            field="refractive_index",
            remedy="write absorption as a negative imaginary part, such as 1.45 - 0.005j",
        )
    angles = default_angles() if angle is None else np.asarray(angle, dtype=np.float64)
    spans = angles.ndim == 1 and angles.size > 2 and angles[0] == 0.0
    if not (spans and np.all(np.diff(angles) > 0) and abs(angles[-1] - math.pi) < 1e-12):
        raise RetrievalInputError("does not ascend from 0 to pi rad", field="angle")
    return _averaged(sizes, refractive_index, wavelength, angles.tobytes(), largest_radius)


def mixed(parts: Sequence[tuple[float, Scattering]]) -> Scattering:
    """Return how a mixture scatters.

    Parameters
    ----------
    parts : sequence of (float, Scattering)
        Number fractions and the scattering of each component, at the same angles.

    Raises
    ------
    RetrievalInputError
        Where fractions are negative or all 0, or the angles differ.
    """
    weights = np.array([fraction for fraction, _ in parts])
    if weights.size == 0 or np.any(weights < 0) or not weights.sum() > 0:
        raise RetrievalInputError("are negative or all 0", field="number fractions")
    angle = parts[0][1].angle
    if any(not np.array_equal(part.angle, angle) for _, part in parts):
        raise RetrievalInputError("differs between the components", field="angle")
    weights = weights / weights.sum()
    scattering = np.array([part.scattering for _, part in parts]) * weights
    share = scattering / scattering.sum()
    return Scattering(
        extinction=float(weights @ [part.extinction for _, part in parts]),
        scattering=float(scattering.sum()),
        angle=angle,
        phase_function=share @ np.array([part.phase_function for _, part in parts]),
        asymmetry=float(share @ [part.asymmetry for _, part in parts]),
    )


@lru_cache(maxsize=64)
def _averaged(
    sizes: Lognormal, index: complex, wavelength: float, angles: bytes, largest: float
) -> Scattering:
    angle = np.frombuffer(angles)
    width = math.log(sizes.deviation)
    middle = math.log(sizes.median_radius) + 2.0 * width**2
    stop = min(middle + _WIDTH * width, math.log(largest))
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
        one, two = miepython.S1_S2(index, x, np.cos(angle), norm="wiscombe")
        intensity += count * (np.abs(one) ** 2 + np.abs(two) ** 2)
    # The differential cross section is (|S1|^2 + |S2|^2) / 2 k^2.
    phase = intensity * wavelength**2 / (2.0 * math.pi * total)
    return Scattering(
        extinction=float(area @ extinction),
        scattering=total,
        angle=angle,
        phase_function=phase,
        asymmetry=float((area * scattering) @ asymmetry) / total,
    )

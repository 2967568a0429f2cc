"""Overlap functions: the share of the beam that the telescope sees, 0 at the lidar."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import chndtr

from lidarops.simulate import _checks

Array = NDArray[np.float64]

_KNOTS: Final = 160
_RINGS: Final = 12
_ANGLES: Final = 12


class Overlap(Protocol):
    """Share of the light from range R that reaches the detector; 0 for R <= 0."""

    def __call__(self, distance: Array, /) -> Array:
        """Return the overlap, 1, of the shape of `distance` (m)."""
        ...


@dataclass(frozen=True, slots=True)
class SineOverlap:
    r"""Smooth overlap that is complete from a given range on.

    Notes
    -----
    :math:`O(R) = \sin^2(\pi R / 2 R_f)` up to the range of full overlap :math:`R_f`, exactly 1
    beyond: smooth at both ends, and of second order at R = 0, where :math:`R^{-2}` diverges.
    For :math:`R_f` = 0 it is 1 for all R > 0.
    """

    full_overlap_range: float
    """m."""

    def __post_init__(self) -> None:
        _checks.not_negative("full_overlap_range", self.full_overlap_range, "m")

    def __call__(self, distance: Array, /) -> Array:
        """Return the overlap, 1, of the shape of `distance` (m)."""
        if self.full_overlap_range == 0.0:
            return np.where(distance > 0.0, 1.0, 0.0)
        fraction = np.clip(distance / self.full_overlap_range, 0.0, 1.0)
        return np.where(fraction < 1.0, np.sin(0.5 * np.pi * fraction) ** 2, 1.0)


@dataclass(frozen=True)
class GeometricalOverlap:
    r"""Overlap of a Gaussian beam and a telescope with a round field stop in its focus.

    Notes
    -----
    Light from a point x of the beam passes the field stop through those points y of the aperture
    for which :math:`|x - y| < R \theta / 2`, with the full field of view :math:`\theta`. The
    overlap is the mean over the aperture of the share of the beam within that distance: the
    distribution function of a noncentral chi-square variable of two degrees of freedom. For
    every telescope it is of second order at R = 0, so the signal is finite there.

    References
    ----------
    `vasylkivskyi2009`, equation 8, with an overlap of 1 inside the field of view and 0 outside.
    """

    aperture_radius: float
    """m, of the telescope."""
    field_of_view: float
    """rad, full angle."""
    beam_radius: float
    """m, where the intensity is 1/e^2 of that on the axis, at the laser."""
    divergence: float
    """rad, half angle."""
    separation: float = 0.0
    """m, between the axes of laser and telescope."""
    tilt: float = 0.0
    """rad, of the laser towards the axis of the telescope."""
    obstruction_radius: float = 0.0
    """m, of the secondary mirror, which shades the aperture."""
    _curve: PchipInterpolator = field(init=False, repr=False, compare=False)
    _reach: tuple[float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _checks.positive("aperture_radius", self.aperture_radius, "m")
        _checks.between("field_of_view", self.field_of_view, 1e-6, 0.1, "rad")
        _checks.positive("beam_radius", self.beam_radius, "m")
        _checks.between("divergence", self.divergence, 0.0, 0.1, "rad")
        _checks.not_negative("separation", self.separation, "m")
        _checks.between("tilt", self.tilt, -0.1, 0.1, "rad")
        _checks.between("obstruction_radius", self.obstruction_radius, 0.0, self.aperture_radius)
        # From where the field of view covers a hundredth of the aperture up to the far field.
        size = self.aperture_radius + self.separation + self.beam_radius
        near, far = 0.02 * self.aperture_radius / self.field_of_view, 300.0 * size
        knots = np.geomspace(near, far / self.field_of_view, _KNOTS)
        object.__setattr__(self, "_reach", (knots[0], knots[-1]))
        object.__setattr__(self, "_curve", PchipInterpolator(np.log(knots), self.exact(knots)))

    def exact(self, distance: Array) -> Array:
        """Return the overlap by quadrature over the aperture, for R > 0."""
        nodes, weights = np.polynomial.legendre.leggauss(_RINGS)
        inner, outer = self.obstruction_radius**2, self.aperture_radius**2
        rings = np.sqrt(inner + (outer - inner) * 0.5 * (nodes + 1.0))
        angles = (np.arange(_ANGLES) + 0.5) * (2.0 * np.pi / _ANGLES)
        shift = (self.separation - self.tilt * distance)[:, None, None]
        along = shift - rings[:, None] * np.cos(angles)
        away = along**2 + (rings[:, None] * np.sin(angles)) ** 2
        spread = (0.25 * (self.beam_radius**2 + (self.divergence * distance) ** 2))[:, None, None]
        view = (0.5 * self.field_of_view * distance)[:, None, None] ** 2
        share = chndtr(view / spread, 2.0, away / spread)
        mean: Array = np.einsum("ijk,j->i", share, 0.5 * weights) / _ANGLES
        return mean

    def __call__(self, distance: Array, /) -> Array:
        """Return the overlap, 1, of the shape of `distance` (m)."""
        near, far = self._reach
        inside = np.clip(distance, near, far)
        rise = np.clip(distance / near, 0.0, 1.0) ** 2
        values: Array = np.clip(self._curve(np.log(inside)), 0.0, 1.0) * rise
        return values


def finite_at_lidar(shape: Overlap) -> bool:
    """Return whether O / R^2, and so the signal, stays finite at the lidar."""
    near = np.array([1e-3, 1e-2])
    values = shape(near)
    if values[1] == 0.0:
        return True
    return values[0] < values[1] and math.log10(values[1] / max(values[0], 1e-300)) > 1.5

"""What a solver of the homogeneous path is asked, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.inputs import Floats

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]


class Centre(StrEnum):
    """The range about which the linearised method expands the exponential."""

    CENTROID = "centroid"
    ZERO = "zero"


@dataclass(frozen=True, slots=True)
class PathProblem:
    """Profiles of one section and all that a solver may need to know of them.

    "(profile or 1,)" stands for one value for each profile, or one for all.
    """

    power: Floats
    """(profile, bin), contiguous; bins that are not finite are left out."""
    range: Array
    """(bin,), m, ascending."""
    noise: Array
    """(profile or 1, bin): variances or weights; a bin is left out where that is not positive
    and finite."""
    common_noise: bool
    """Whether `noise` was given for all profiles at once. That a batch of one profile has one row
    of noise does not make it common: what solves a profile must not depend on its batch."""
    known_variance: bool
    """Whether `noise` holds variances, else weights up to a common factor."""
    bounds: tuple[float, float]
    """Lowest and highest extinction, m-1."""
    extinction: Array | None = None
    """(profile or 1,), m-1: the prior of the linearised method, or given."""
    background: Array | None = None
    """(profile or 1,): given."""
    background_variance: Array | None = None
    """(profile or 1,): of the given background."""
    shots: Array | None = None
    """(profile or 1,): shots of which the power is the mean count; None for Gaussian noise."""
    lag: int | None = None
    """Of the cubic."""
    centre: Centre = Centre.CENTROID
    tail_start: float | None = None
    """m: of the bins whose mean is the background of the tail."""

    def select(self, rows: npt.NDArray[np.intp], power: Floats) -> PathProblem:
        """Return the problem of some profiles, with other power."""

        def chosen(values: Array | None) -> Array | None:
            return values if values is None or values.shape[0] == 1 else values[rows]

        return replace(
            self,
            power=power,
            noise=self.noise if self.noise.shape[0] == 1 else self.noise[rows],
            extinction=chosen(self.extinction),
            background=chosen(self.background),
            background_variance=chosen(self.background_variance),
            shots=chosen(self.shots),
        )

    def cut(self, bins: slice, bounds: tuple[float, float]) -> PathProblem:
        """Return the problem of some neighbouring bins."""
        return replace(
            self,
            power=_contiguous(self.power[:, bins]),
            range=np.ascontiguousarray(self.range[bins]),
            noise=np.ascontiguousarray(self.noise[:, bins]),
            bounds=bounds,
        )


def _contiguous(power: Floats) -> Floats:
    if power.dtype == np.float32:
        return np.ascontiguousarray(power, dtype=np.float32)
    return np.ascontiguousarray(power, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Flat:
    """What a solver found, (profile,) each; the fields of `homogeneous.HomogeneousResult`."""

    background: Array
    background_standard_error: Array
    amplitude: Array
    amplitude_standard_error: Array
    extinction: Array
    extinction_standard_error: Array
    signal_to_noise: Array
    """Amplitude over its standard error at known extinction, with the sign of the amplitude."""
    reduced_chi2: Array
    curvature_misfit: Array
    """Energy of the curvature functionals over the noise; NaN where the solver has none."""
    mean_range: Array
    """m, weighted over the bins used; NaN where nothing was fitted."""
    background_bend: Array
    """What a signal bent by ``(x - 1/2)^2`` in relative terms, x from 0 to 1 along the section,
    does to the background, times the length of the section; NaN where nothing was fitted."""
    extinction_bend: Array
    """The same of the extinction."""
    valid_bins: Flags
    quality: Flags

    def updated(self, rows: npt.NDArray[np.intp], other: Flat) -> Flat:
        """Return a copy in which some profiles are taken from another result."""
        merged = {}
        for field in fields(self):
            values = getattr(self, field.name).copy()
            values[rows] = getattr(other, field.name)
            merged[field.name] = values
        return Flat(**merged)

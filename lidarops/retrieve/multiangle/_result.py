"""What a multi-angle retrieval returns."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class MultiAngleFlags:
    """What is to be known of a value before it is used; each (..., altitude)."""

    no_data: Mask
    """No angle, or no two different ones, hold a signal at any altitude."""
    extrapolated: Mask
    """Beyond the reach: fewer beams than the method needs are left. Values are withheld."""
    interpolated: Mask
    """No estimate at this altitude; bridged from those around."""
    no_residual: Mask
    """As many beams as unknowns in all profiles of the block, at all altitudes around: nothing
    checks the model or tells the inhomogeneity."""
    low_leverage: Mask
    """The slant paths differ by less than a tenth of the vertical one."""
    one_sided: Mask
    """A half turn around the zenith is free of beams: a horizontal gradient is not seen."""
    gradient: Mask
    """The residuals show a horizontal gradient that the fit does not account for."""
    poor_stratification: Mask
    """The mean scatter of beams over altitudes grows with altitude, more than noise, chance and a
    gradient make it, as it does where extinction itself varies along the horizontal; or
    neighbouring beams scatter alike, as in patches of air that are wider than beams are apart.
    Extinction is withheld."""
    prior_dominated: Mask
    """Smoothness or a prior, not the data, decides on the value. Extinction is withheld where
    the data share lies outside 0.9-1.1."""
    saturated: Mask
    """The data ask for no less smoothness than the least admitted."""
    undersmoothed: Mask
    """More than 10 degrees of freedom and more than 0.4 per altitude: the standard error may be
    too small."""
    high_correlation: Mask
    """Neighbouring altitudes are correlated by more than 0.85: the standard error may be too
    small."""
    outlier: Mask
    """At least one beam or estimate was weighted down as an outlier."""

    def doubtful(self) -> Mask:
        """Return where a stated uncertainty is not to be relied on."""
        return np.asarray(
            self.no_residual
            | self.gradient
            | self.undersmoothed
            | self.high_correlation
            | self.poor_stratification
        )


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One step of the retrieval of one block: whether it ran, and why or why not."""

    block: int
    step: str
    ran: bool
    reason: str


@dataclass(frozen=True, slots=True)
class MultiAngleResult:
    """Profiles of a multi-angle retrieval, (..., altitude) unless stated; NaN where withheld."""

    optical_depth: Array
    """From the lidar to the altitude."""
    optical_depth_standard_error: Array
    """Of noise and smoothing, without `optical_depth_gradient_error`."""
    optical_depth_gradient_error: Array
    """Systematic: the largest error that the declared horizontal gradient of backscatter makes."""
    extinction: Array
    """m-1, mean of the layer between the altitude and the one below (the lidar, for the first)."""
    extinction_standard_error: Array
    """m-1."""
    extinction_gradient_error: Array
    """m-1, systematic."""
    log_intercept: Array
    """ln of the range-corrected signal that an optical depth of zero would give."""
    log_intercept_standard_error: Array
    effective_degrees_of_freedom: Array
    """(...,): how many numbers of the profile come from the data."""
    data_share: Array
    """Share of the optical depth that the data give, 1 where no prior and no smoothing acts."""
    inhomogeneity: Array
    """Standard deviation of the logarithms of the signals on top of detector noise."""
    reduced_chi_square: Array
    """Of the fit over angles; NaN where no beam is redundant."""
    reach: Array
    """(...,) m, the highest altitude with an estimate; NaN where there is none."""
    layer_optical_depth: Array
    """(..., layer): between the bounds of the layers asked for."""
    layer_optical_depth_standard_error: Array
    """(..., layer): random error; without smoothing over altitude, as if the errors of both
    bounds were independent, which is too large where they go together."""
    layer_optical_depth_gradient_error: Array
    """(..., layer): systematic, as `optical_depth_gradient_error`."""
    residual: Array
    """(..., angle, altitude): logarithms less their fit over angles; NaN where no sample."""
    flags: MultiAngleFlags
    quality: npt.NDArray[np.int32]
    """Bits of `lidarops.flags.Quality`."""
    steps: tuple[StepRecord, ...]
    """What ran and what was left out, block by block."""


def empty_flags(shape: tuple[int, ...]) -> dict[str, Mask]:
    """Return a lowered array for every flag."""
    return {field.name: np.zeros(shape, dtype=np.bool_) for field in fields(MultiAngleFlags)}


@dataclass(slots=True)
class Profiles:
    """The results of profiles while blocks fill them in; (profile, altitude) unless stated."""

    optical_depth: Array
    optical_depth_standard_error: Array
    optical_depth_gradient_error: Array
    extinction: Array
    extinction_standard_error: Array
    extinction_gradient_error: Array
    log_intercept: Array
    log_intercept_standard_error: Array
    data_share: Array
    inhomogeneity: Array
    reduced_chi_square: Array
    effective_degrees_of_freedom: Array
    """(profile,)"""
    reach: Array
    """(profile,)"""
    layer_optical_depth: Array
    """(profile, layer)"""
    layer_optical_depth_standard_error: Array
    """(profile, layer)"""
    layer_optical_depth_gradient_error: Array
    """(profile, layer)"""
    residual: Array
    """(profile, angle, altitude)"""
    flags: dict[str, Mask]

    @classmethod
    def missing(cls, profiles: int, angles: int, bins: int, layers: int) -> Profiles:
        """Return profiles of which nothing is known."""
        shapes: dict[str, tuple[int, ...]] = {
            "effective_degrees_of_freedom": (profiles,),
            "reach": (profiles,),
            "layer_optical_depth": (profiles, layers),
            "layer_optical_depth_standard_error": (profiles, layers),
            "layer_optical_depth_gradient_error": (profiles, layers),
            "residual": (profiles, angles, bins),
        }
        values: dict[str, Any] = {
            field.name: np.full(shapes.get(field.name, (profiles, bins)), np.nan)
            for field in fields(cls)
            if field.name != "flags"
        }
        return cls(**values, flags=empty_flags((profiles, bins)))

    def put(self, rows: npt.NDArray[np.intp], part: Profiles) -> None:
        """Write the profiles of one block."""
        for field in fields(self):
            if field.name != "flags":
                getattr(self, field.name)[rows] = getattr(part, field.name)
        for name, mask in part.flags.items():
            self.flags[name][rows] = mask

    def result(
        self,
        leading: tuple[int, ...],
        quality: npt.NDArray[np.int32],
        steps: tuple[StepRecord, ...],
    ) -> MultiAngleResult:
        """Return the result with the leading axes of the signal."""
        values = {
            field.name: _restored(getattr(self, field.name), leading)
            for field in fields(self)
            if field.name != "flags"
        }
        shape = (*leading, quality.shape[-1])
        flags = MultiAngleFlags(**{k: mask.reshape(shape) for k, mask in self.flags.items()})
        return MultiAngleResult(**values, flags=flags, quality=quality.reshape(shape), steps=steps)


def _restored(values: Array, leading: tuple[int, ...]) -> Array:
    return values.reshape((*leading, *values.shape[1:]))

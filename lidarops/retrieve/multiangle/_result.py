"""Result of a multi-angle retrieval: profiles, flags and the record of steps."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class MultiAngleFlags:
    """Reasons to reject a value or to doubt its uncertainty; each (..., altitude)."""

    no_data: Mask
    """At no altitude do two different angles have a signal."""
    extrapolated: Mask
    """Beyond the reach: fewer beams than the method needs are left. Values are withheld."""
    interpolated: Mask
    """No estimate at this altitude; interpolated from those around."""
    no_residual: Mask
    """As many unknowns as beams in all profiles of the block, at all altitudes around: the model
    cannot be checked, and the inhomogeneity cannot be estimated."""
    low_leverage: Mask
    """The slant paths differ by less than a tenth of the vertical path."""
    one_sided: Mask
    """A half turn around the zenith has no beam: a horizontal gradient cannot be detected."""
    gradient: Mask
    """The residuals show a horizontal gradient that the fit does not account for."""
    poor_stratification: Mask
    """The beams scatter increasingly with altitude, by more than noise, chance and a gradient
    explain, as when extinction varies along the horizontal; or neighbouring beams scatter alike,
    as in patches of air wider than the distance of beams. Extinction is withheld."""
    prior_dominated: Mask
    """Smoothness or a prior, not the data, determines the value. Extinction is withheld where
    the data share is outside 0.9-1.1."""
    saturated: Mask
    """The best fit has the largest smoothness that is allowed."""
    undersmoothed: Mask
    """More than 10 degrees of freedom and more than 0.4 per altitude: the standard error may be
    too small."""
    high_correlation: Mask
    """Neighbouring altitudes are correlated by more than 0.85: the standard error may be too
    small."""
    outlier: Mask
    """At least one beam or estimate got less weight as an outlier."""

    def doubtful(self) -> Mask:
        """Return where the stated uncertainty may be too small."""
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
    """Error from noise and smoothing, without `optical_depth_gradient_error`."""
    optical_depth_gradient_error: Array
    """Systematic: largest error caused by the declared horizontal gradient of backscatter."""
    extinction: Array
    """m-1, mean of the layer between the altitude and the next lower one (or the lidar)."""
    extinction_standard_error: Array
    """m-1."""
    extinction_gradient_error: Array
    """m-1, systematic."""
    log_intercept: Array
    """ln of the range-corrected signal extrapolated to zero optical depth."""
    log_intercept_standard_error: Array
    effective_degrees_of_freedom: Array
    """(...,): effective number of independent values in the profile."""
    data_share: Array
    """Share of the optical depth that comes from the data; 1 without prior and smoothing."""
    inhomogeneity: Array
    """Standard deviation of the logarithms of the signals on top of detector noise."""
    reduced_chi_square: Array
    """Reduced chi-square of the fit over angles; NaN where beams are not more than unknowns."""
    reach: Array
    """(...,) m, the highest altitude with an estimate; NaN where there is none."""
    layer_optical_depth: Array
    """(..., layer): between the bounds of the requested layers."""
    layer_optical_depth_standard_error: Array
    """(..., layer): random error. Methods without smoothing over altitude treat the errors of both
    bounds as independent, which is too large if they are correlated."""
    layer_optical_depth_gradient_error: Array
    """(..., layer): systematic, as `optical_depth_gradient_error`."""
    residual: Array
    """(..., angle, altitude): logarithms minus their fit over angles; NaN without a sample."""
    flags: MultiAngleFlags
    quality: npt.NDArray[np.int32]
    """Bits of `lidarops.flags.Quality`."""
    steps: tuple[StepRecord, ...]
    """Steps that ran or were left out, block by block."""


def _empty_flags(shape: tuple[int, ...]) -> dict[str, Mask]:
    """Return an array of False for every flag."""
    return {field.name: np.zeros(shape, dtype=np.bool_) for field in fields(MultiAngleFlags)}


@dataclass(slots=True)
class Profiles:
    """Results that blocks fill in; arrays are (profile, altitude) unless stated."""

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
    def missing(cls, profiles: int, angles: int, altitudes: int, layers: int) -> Profiles:
        """Return profiles that are NaN everywhere, without flags."""
        shapes: dict[str, tuple[int, ...]] = {
            "effective_degrees_of_freedom": (profiles,),
            "reach": (profiles,),
            "layer_optical_depth": (profiles, layers),
            "layer_optical_depth_standard_error": (profiles, layers),
            "layer_optical_depth_gradient_error": (profiles, layers),
            "residual": (profiles, angles, altitudes),
        }
        values: dict[str, Any] = {
            field.name: np.full(shapes.get(field.name, (profiles, altitudes)), np.nan)
            for field in fields(cls)
            if field.name != "flags"
        }
        return cls(**values, flags=_empty_flags((profiles, altitudes)))

    def put(self, rows: npt.NDArray[np.intp], block: Profiles) -> None:
        """Copy the profiles of one block into these rows."""
        for field in fields(self):
            if field.name != "flags":
                getattr(self, field.name)[rows] = getattr(block, field.name)
        for name, mask in block.flags.items():
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

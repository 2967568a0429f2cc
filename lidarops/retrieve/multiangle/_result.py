"""Result of a multi-angle retrieval: profiles, flags and the record of steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans


@dataclass(frozen=True, slots=True)
class MultiAngleFlags:
    """Reasons to reject a value or to doubt its uncertainty; each (..., altitude)."""

    no_data: Booleans
    """At no altitude do two different angles have a signal."""
    extrapolated: Booleans
    """Beyond the reach: fewer beams than the method needs are left. Values are withheld."""
    interpolated: Booleans
    """No estimate at this altitude; interpolated from those around."""
    no_residual: Booleans
    """As many unknowns as beams in all profiles of the block, at all altitudes around: the model
    cannot be checked, and the inhomogeneity cannot be estimated."""
    low_leverage: Booleans
    """The slant paths differ by less than a tenth of the vertical path."""
    poor_stratification: Booleans
    """The beams scatter increasingly with altitude, by more than noise, chance and a gradient
    explain, as when extinction varies along the horizontal; or the residuals show a gradient that
    is too large for air. Extinction is withheld."""
    prior_dominated: Booleans
    """The best fit is little more than a straight line; the data share of "joint" is below 0.9 or
    above 1.1; or that of "mld" and "mld_prior" is below 0.9, and extinction is withheld."""
    undersmoothed: Booleans
    """More than 10 degrees of freedom and more than 0.4 per altitude, which fit better than a
    smoother profile: the standard error may be too small."""
    high_correlation: Booleans
    """Neighbouring altitudes are correlated by more than 0.85: the standard error may be too
    small."""
    outlier: Booleans
    """At least one beam or estimate got less weight as an outlier."""

    def doubtful(self) -> Booleans:
        """Return where the stated uncertainty may be too small."""
        return np.asarray(
            self.no_residual | self.undersmoothed | self.high_correlation | self.poor_stratification
        )


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One step of the retrieval: whether it ran, and why or why not."""

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
    regularisation: Array
    """Strength of the penalty of "mld" and "mld_prior", given or chosen; NaN for other methods."""
    prior_optical_depth: Array
    """Optical depth to which that penalty pulls: 0, or that of the altitude below."""
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
    """Steps that ran or were left out."""

    @classmethod
    def missing(cls, profiles: int, angles: int, altitudes: int, layers: int) -> MultiAngleResult:
        """Return profiles that are NaN everywhere, without flags; methods fill the arrays."""
        shapes: dict[str, tuple[int, ...]] = {
            "effective_degrees_of_freedom": (profiles,),
            "reach": (profiles,),
            "layer_optical_depth": (profiles, layers),
            "layer_optical_depth_standard_error": (profiles, layers),
            "layer_optical_depth_gradient_error": (profiles, layers),
            "residual": (profiles, angles, altitudes),
        }
        profile = (profiles, altitudes)
        values: dict[str, Any] = {
            name: np.full(shapes.get(name, profile), np.nan) for name in cls.value_names()
        }
        flags = {field.name: np.zeros(profile, np.bool_) for field in fields(MultiAngleFlags)}
        return cls(
            **values,
            flags=MultiAngleFlags(**flags),
            quality=np.zeros(profile, dtype=np.int32),
            steps=(),
        )

    @classmethod
    def value_names(cls) -> Iterator[str]:
        """Yield the names of the arrays of values."""
        names = (field.name for field in fields(cls))
        return (name for name in names if name not in ("flags", "quality", "steps"))

    def with_leading_axes(self, leading: tuple[int, ...]) -> MultiAngleResult:
        """Return the result with the leading axes of the signal in place of that of profiles."""

        def restored(values: Any) -> Any:
            return values.reshape((*leading, *values.shape[1:]))

        flags = {
            field.name: restored(getattr(self.flags, field.name))
            for field in fields(MultiAngleFlags)
        }
        values = {name: restored(getattr(self, name)) for name in self.value_names()}
        return replace(
            self, **values, flags=MultiAngleFlags(**flags), quality=restored(self.quality)
        )

"""Solution of one block of a scan by one of the methods, with the record of its steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices
from lidarops.retrieve.multiangle import _block, _horizontal_variation, mld
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, correlation_of_air
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.slant_paths import Scan
from lidarops.retrieve.multiangle.smooth_profile import smooth_optical_depth
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


class MultiAngleMethod(StrEnum):
    """Method of retrieving optical depths."""

    AUTO = "auto"
    """`TWO_ANGLE` for two beams, else `JOINT`."""
    TWO_ANGLE = "two_angle"
    """Only the shortest and the longest path."""
    KANO_HAMILTON = "kano_hamilton"
    """Weighted regression on the slant path, each altitude on its own."""
    JOINT = "joint"
    """`KANO_HAMILTON`, then one smooth profile through all altitudes."""
    MLD = "mld"
    """Regularised derivative along the slant path, formula 3 of `gobrusenko1989`."""
    MLD_PRIOR = "mld_prior"
    """`MLD` applied to the difference from the altitude below, its formula 4."""


REGULARISED: Final = frozenset({MultiAngleMethod.MLD, MultiAngleMethod.MLD_PRIOR})
"""Methods with a penalty, which accept `regularisation`."""
WITHOUT_GRADIENT: Final = REGULARISED | {MultiAngleMethod.TWO_ANGLE}
"""Methods that do not use the horizontal gradient that the regression fits."""


LARGEST_GRADIENT: Final = 5e-5
"""m-1, default horizontal gradient of ln backscatter covered by the gradient errors."""


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One step of the retrieval: whether it ran, and why or why not."""

    step: str
    ran: bool
    reason: str


@dataclass(frozen=True, slots=True)
class MultiAngleResult:
    """Profiles of a multi-angle retrieval, (profile, altitude) unless stated; NaN if withheld."""

    optical_depth: Array
    """From the lidar to the altitude."""
    optical_depth_standard_error: Array
    """Error from noise and smoothing, without `optical_depth_gradient_error`."""
    optical_depth_error_air: Array
    """Part of the standard error that the inhomogeneity of the air makes; NaN for the methods with
    a penalty."""
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
    """(profile,): effective number of independent values in the profile."""
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
    """(profile,) m, the highest altitude with an estimate; NaN where there is none."""
    layer_optical_depth: Array
    """(profile, layer): between the bounds of the requested layers."""
    layer_optical_depth_standard_error: Array
    """(profile, layer): random error. Methods without smoothing over altitude treat the errors of
    both bounds as independent, which is too large if they are correlated."""
    layer_optical_depth_gradient_error: Array
    """(profile, layer): systematic, as `optical_depth_gradient_error`."""
    residual: Array
    """(profile, angle, altitude): logarithms minus their fit over angles; NaN without a sample."""
    quality: Flags
    """Bits of `lidarops.flags.Quality` and `MultiAngleQuality`; each missing optical depth has one
    that rejects it."""
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
            field.name: np.full(shapes.get(field.name, profile), np.nan) for field in fields(cls)
        }
        return cls(**values | {"quality": np.zeros(profile, dtype=np.int32), "steps": ()})

    def raised(self, bits: int) -> Booleans:
        """Return where any of the bits is raised."""
        return np.asarray((self.quality & np.int32(bits)) != 0)

    def mark(self, bit: int, where: npt.ArrayLike) -> None:
        """Raise a bit, where (profile, altitude) or what is broadcast to it is true."""
        self.quality[:] |= np.where(where, np.int32(bit), np.int32(0))


@dataclass(frozen=True, slots=True, kw_only=True)
class OpticalDepthSettings:
    """How optical depths are retrieved from a scan."""

    method: str = "auto"
    """One of `MultiAngleMethod`."""
    station_altitude: float = 0.0
    """m, altitude of the lidar, where the optical depth is zero."""
    inhomogeneity: float | None = None
    """Standard deviation of the logarithms on top of the noise; estimated if not given."""
    largest_gradient: float = LARGEST_GRADIENT
    """m-1, horizontal gradient of ln backscatter covered by `optical_depth_gradient_error` and
    `extinction_gradient_error`, unless the residuals show a larger one."""
    layers: Sequence[tuple[float, float]] = ()
    """m, bottom and top of layers whose optical depth is requested; moved to the nearest of the
    altitudes and the station, by at most half the distance to the next one."""
    regularisation: float | None = None
    """Strength of the penalty of "mld" and "mld_prior", dimensionless, for slant paths scaled to a
    span of 1; by default the largest with residuals not larger than the noise, at each altitude."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockSettings(OpticalDepthSettings):
    """The same with the geometry that all blocks of a retrieval share."""

    height: Array
    """(altitude,) m above the lidar."""
    scan: Scan
    levels: Indices
    """(layer, 2) levels at bottom and top of layers: 0 for the lidar, k + 1 for altitude k."""


def solve_cycles(
    signal: Array, variance: Array, dead_time_change: Array | None, settings: BlockSettings
) -> MultiAngleResult:
    """Return the solution of the profiles of one block, without the reasons for missing values.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    dead_time_change : (profile, angle, altitude) float or None
        Of the signal, with one standard error of the dead time.
    settings : BlockSettings
    """
    beams = _block.make_beam_block(signal, variance, settings.scan, dead_time_change)
    fit = _block.regress(beams, settings.inhomogeneity)
    method, reason = _choose_method(beams, settings)
    profiles = _solve(method, beams, fit, settings)
    steps = [*_steps(beams, settings, method), StepRecord(method, ran=True, reason=reason)]
    return replace(profiles, steps=tuple(steps))


def _solve(
    method: str, beams: BeamBlock, fit: Regression, settings: BlockSettings
) -> MultiAngleResult:
    """Return the solution by a method, with the flags common to all methods."""
    profiles = _METHODS[method](beams, fit, settings)
    lowest = _horizontal_variation.path_variation_from(beams, fit)
    if lowest is not None:
        above = np.arange(profiles.quality.shape[1]) >= lowest
        profiles.mark(MultiAngleQuality.POOR_STRATIFICATION, above)
    _withhold_extinction(profiles, profiles.raised(MultiAngleQuality.POOR_STRATIFICATION))
    valued = np.isfinite(profiles.optical_depth)
    profiles.mark(MultiAngleQuality.NO_RESIDUAL, valued & (_block.pooled_freedom(fit) == 0))
    return profiles


def _steps(beams: BeamBlock, settings: BlockSettings, method: str) -> Iterator[StepRecord]:
    """Yield what the data decided before the method."""
    number = int(np.count_nonzero(~settings.scan.usable))
    count = number or "no"
    are = "are" if number else "is"
    beam = "beams" if number else "beam"
    yield StepRecord(
        "drop_longest_paths",
        number > 0,
        f"{count} {beam} {are} less than 3 degrees above the horizon",
    )
    around = "beams point to all sides"
    free = "a half turn around the zenith has no beam"
    if method in WITHOUT_GRADIENT:
        yield StepRecord("horizontal_gradient", ran=False, reason=f"{method} fits none")
    else:
        yield StepRecord("horizontal_gradient", beams.sides, around if beams.sides else free)


def _choose_method(beams: BeamBlock, settings: BlockSettings) -> tuple[str, str]:
    if settings.method != "auto":
        return settings.method, "requested"
    if np.max(np.count_nonzero(beams.noise < np.inf, axis=1), initial=0) <= 2:
        return "two_angle", "no altitude has more than two beams"
    return "joint", "extinction is requested"


def _kano_hamilton(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> MultiAngleResult:
    """Return the estimates of single altitudes."""
    return _single_altitudes(beams, fit, settings, _correlation(beams, fit))


def _single_altitudes(
    beams: BeamBlock, fit: Regression, settings: BlockSettings, correlation: float
) -> MultiAngleResult:
    """Return the estimates of single altitudes, with the correlation that residuals show."""
    profiles = _start(beams, fit, settings)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(1.0 / fit.column(kh.INFORMATION)) * _block.student_factor(fit.freedom)
    _fill_single(
        profiles,
        settings,
        depth=profiles.optical_depth,
        error=error,
        slopes=_gradient_slopes(profiles, beams, fit, settings),
        correlation=np.pad(correlation * fit.shared, ((0, 0), (1, 0))),
    )
    share = np.sqrt(fit.column(kh.AIR) * fit.inhomogeneity)
    profiles.optical_depth_error_air[:] = profiles.optical_depth_standard_error * share
    return profiles


def _correlation(beams: BeamBlock, fit: Regression) -> float:
    """Return the correlation of the air at neighbouring altitudes, which residuals show."""
    return correlation_of_air(
        fit.residual, beams.noise, fit.leverage, fit.inhomogeneity, beams.path,
        np.ascontiguousarray(fit.column(kh.SIDES)),
    )  # fmt: skip


def _two_angle(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> MultiAngleResult:
    """Solve with the shortest and the longest path of each altitude.

    The inhomogeneity and its correlation along altitude come from all beams of the scan.
    """
    ends = _block.end_beams(beams)
    of_ends = _block.refit(ends, fit.inhomogeneity, fit.freedom)
    return _single_altitudes(ends, of_ends, settings, _correlation(beams, fit))


def _mld(
    beams: BeamBlock, fit: Regression, settings: BlockSettings, *, from_below: bool = False
) -> MultiAngleResult:
    """Differentiate along the slant path, each altitude on its own."""
    profiles = _start(beams, fit, settings)
    estimates = mld.solve_mld(
        beams, fit.inhomogeneity, from_below=from_below, strength=settings.regularisation
    )
    _fill_single(
        profiles,
        settings,
        depth=estimates.optical_depth,
        error=np.sqrt(estimates.variance),
        slopes=settings.largest_gradient * settings.height * estimates.slopes,
        data_share=estimates.data_share,
        freedom=estimates.freedom,
    )
    within = np.isfinite(profiles.data_share)
    profiles.regularisation[within] = estimates.strength[within]
    profiles.prior_optical_depth[within] = estimates.prior[within]
    with np.errstate(invalid="ignore"):
        dominated = np.asarray(profiles.data_share < THRESHOLDS.least_share)
    profiles.mark(MultiAngleQuality.PRIOR_DOMINATED, dominated)
    _withhold_extinction(profiles, dominated)
    return profiles


def _fill_single(
    profiles: MultiAngleResult,
    settings: BlockSettings,
    *,
    depth: Array,
    error: Array,
    slopes: Array,
    data_share: Array | float = 1.0,
    freedom: Array | float = 1.0,
    correlation: Array | float = 0.0,
) -> None:
    """Fill estimates of single altitudes within the reach, and what follows from them.

    `slopes`, (2, profile, altitude), are the errors by the largest gradient to the east and north,
    `correlation` is that of the error with the one at the altitude below.
    """
    within = np.isfinite(profiles.optical_depth) & np.isfinite(depth)
    for values, estimates in (
        (profiles.optical_depth, depth),
        (profiles.optical_depth_standard_error, error),
        (profiles.data_share, data_share),
    ):
        values[:] = np.where(within, estimates, np.nan)
    profiles.extinction[:] = _layer_means(profiles.optical_depth, settings.height)
    both = profiles.optical_depth_standard_error**2
    step = np.diff(settings.height, prepend=0.0)
    common = 2.0 * correlation * np.sqrt(both * _below(both))
    profiles.extinction_standard_error[:] = np.sqrt(both + _below(both) - common) / step
    _fill_gradient_errors(profiles, np.where(within, slopes, np.nan), settings)
    total = np.where(within, freedom, 0.0).sum(axis=1)
    profiles.effective_degrees_of_freedom[:] = np.where(within.any(axis=1), total, np.nan)
    bounds, squares = (_at_layers(values, settings) for values in (profiles.optical_depth, both))
    profiles.layer_optical_depth[:] = bounds[..., 1] - bounds[..., 0]
    profiles.layer_optical_depth_standard_error[:] = np.sqrt(squares[..., 1] + squares[..., 0])


def _joint(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> MultiAngleResult:
    """Combine the estimates of single altitudes into profiles with smooth extinction."""
    profiles = _start(beams, fit, settings)
    within = np.isfinite(profiles.optical_depth)
    rows = np.flatnonzero(within.any(axis=1))
    if rows.size == 0:
        return profiles
    noise = AltitudeNoise(_correlation(beams, fit), fit.shared, _block.pooled_freedom(fit))
    smooth = smooth_optical_depth(
        profiles.optical_depth[rows],
        np.where(within, fit.column(kh.INFORMATION), 0.0)[rows],
        settings.height,
        noise=noise.of(rows),
    )
    for name in (
        "optical_depth", "optical_depth_standard_error", "optical_depth_error_air", "extinction",
        "extinction_standard_error", "effective_degrees_of_freedom", "data_share",
    ):  # fmt: skip
        getattr(profiles, name)[rows] = getattr(smooth, name)
    slopes = np.full((2, *within.shape), np.nan)
    of_single = _gradient_slopes(profiles, beams, fit, settings)
    for slope, single in zip(slopes, of_single, strict=True):
        one = np.where(within, single, 0.0)[rows]
        slope[rows] = smooth.respond(one) if one.any() else 0.0 * smooth.optical_depth
    _fill_gradient_errors(profiles, slopes, settings)
    for number, (bottom, top) in enumerate(settings.levels):
        depth, error = smooth.layer(bottom - 1, top - 1)
        profiles.layer_optical_depth[rows, number] = depth
        profiles.layer_optical_depth_standard_error[rows, number] = error
    profiles.quality[rows] |= np.where(
        smooth.interpolated, np.int32(MultiAngleQuality.INTERPOLATED), np.int32(0)
    )
    return profiles


def _withhold_extinction(profiles: MultiAngleResult, where: Booleans) -> None:
    for values in (
        profiles.extinction,
        profiles.extinction_standard_error,
        profiles.extinction_gradient_error,
    ):
        values[where] = np.nan


def _start(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> MultiAngleResult:
    """Return profiles with the values common to all methods; optical depths within the reach."""
    count, angles, altitudes = beams.noise.shape
    profiles = MultiAngleResult.missing(count, angles, altitudes, len(settings.levels))
    tau = fit.column(kh.TAU)
    within = fit.within(beams)
    profiles.optical_depth[:] = np.where(within, tau, np.nan)
    profiles.log_intercept[:] = np.where(within, fit.column(kh.INTERCEPT), np.nan)
    factor = _block.student_factor(fit.freedom)
    error = np.sqrt(fit.column(kh.INTERCEPT_VARIANCE)) * factor
    profiles.log_intercept_standard_error[:] = np.where(within, error, np.nan)
    profiles.inhomogeneity[:] = np.where(within, np.sqrt(fit.inhomogeneity), np.nan)
    freedom = fit.column(kh.FREEDOM)
    with np.errstate(divide="ignore", invalid="ignore"):
        chi2 = fit.column(kh.CHI2) / freedom
    profiles.reduced_chi_square[:] = np.where(within & (freedom > 0), chi2, np.nan)
    profiles.residual[:] = fit.residual
    top = np.where(within, settings.height, -np.inf).max(axis=1, initial=-np.inf)
    profiles.reach[:] = np.where(np.isfinite(top), top + settings.station_altitude, np.nan)
    known = within.any(axis=1, keepdims=True)
    beyond = known & (settings.height > top[:, np.newaxis])
    profiles.mark(MultiAngleQuality.EXTRAPOLATED, beyond)
    profiles.mark(MultiAngleQuality.NO_LEVERAGE, ~known)
    return profiles


def _gradient_slopes(
    profiles: MultiAngleResult, beams: BeamBlock, fit: Regression, settings: BlockSettings
) -> Array:
    """Return the error of optical depth by a gradient to the east and to the north.

    The gradient is the declared one, or that which the residuals show where it is larger. One that
    is too large for air raises `POOR_STRATIFICATION`.
    """
    shown = _horizontal_variation.visible_gradient(beams, fit, settings.height)
    if shown > max(settings.largest_gradient, THRESHOLDS.largest_gradient):
        known = np.isfinite(profiles.optical_depth)
        profiles.mark(MultiAngleQuality.POOR_STRATIFICATION, known)
    scale = max(settings.largest_gradient, shown) * settings.height
    return np.stack([fit.column(kh.SLOPE_EAST) * scale, fit.column(kh.SLOPE_NORTH) * scale])


def _fill_gradient_errors(
    profiles: MultiAngleResult, slopes: Array, settings: BlockSettings
) -> None:
    """Fill the gradient errors from the signed errors of gradients to the east and north."""
    profiles.optical_depth_gradient_error[:] = np.hypot(*slopes)
    profiles.extinction_gradient_error[:] = np.hypot(
        *(_layer_means(slope, settings.height) for slope in slopes)
    )
    across = (np.diff(_at_layers(slope, settings), axis=2)[..., 0] for slope in slopes)
    profiles.layer_optical_depth_gradient_error[:] = np.hypot(*across)


def _layer_means(optical_depth: Array, height: Array) -> Array:
    """Return the mean extinction of the layers between altitudes; the lidar has depth zero."""
    return (optical_depth - _below(optical_depth)) / np.diff(height, prepend=0.0)


def _at_layers(values: Array, settings: BlockSettings) -> Array:
    """Return values at bottom and top of the layers, (profile, layer, 2); 0 at the lidar."""
    return np.pad(values, ((0, 0), (1, 0)))[:, settings.levels]


def _below(values: Array) -> Array:
    """Return the values at the altitude below, 0 at the lidar."""
    return np.concatenate([np.zeros((values.shape[0], 1)), values[:, :-1]], axis=1)


_METHODS: Final[dict[str, Callable[[BeamBlock, Regression, BlockSettings], MultiAngleResult]]] = {
    "two_angle": _two_angle,
    "kano_hamilton": _kano_hamilton,
    "joint": _joint,
    "mld": _mld,
    "mld_prior": partial(_mld, from_below=True),
}

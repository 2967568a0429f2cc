"""Optical depth and extinction from scans: one atmosphere seen along paths of different lengths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices
from lidarops.retrieve.multiangle import _block, mld, slant_paths
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression
from lidarops.retrieve.multiangle._horizontal_variation import path_variation_from, visible_gradient
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, correlation_of_air
from lidarops.retrieve.multiangle.flags import CARE, MultiAngleQuality
from lidarops.retrieve.multiangle.slant_paths import Scan
from lidarops.retrieve.multiangle.smooth_profile import VerticalResult, smooth_optical_depth
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
    method: str
    """One of `MultiAngleMethod`, which ran."""
    steps: tuple[str, ...]
    """Steps that ran or were left out, with the reason; the last one is the method."""

    def raised(self, bits: int) -> Booleans:
        """Return where any of the bits is raised."""
        return np.asarray((self.quality & np.int32(bits)) != 0)


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


_DEFAULT: Final = OpticalDepthSettings()
Values = dict[str, Any]
"""Arrays of `MultiAngleResult` by name."""


def retrieve_optical_depth(
    signal: npt.ArrayLike,
    zenith_angle: npt.ArrayLike,
    altitude: npt.ArrayLike,
    *,
    variance: npt.ArrayLike,
    azimuth: npt.ArrayLike | None = None,
    settings: OpticalDepthSettings = _DEFAULT,
    dead_time_change: npt.ArrayLike | None = None,
    signal_quality: Flags | None = None,
) -> MultiAngleResult:
    """Retrieve optical depth and extinction from signals at several zenith angles.

    All profiles are one block: inhomogeneity, correlation and smoothness are common to them. Model,
    estimators and thresholds are in ``docs/algorithms/multiangle.md``.

    Parameters
    ----------
    signal : (profile, angle, altitude) float
        Range-corrected, without background, in any unit, of altitude cells (see
        `lidarops.retrieve.multiangle._cell_means`), from full overlap upwards; NaN where missing.
    zenith_angle : (angle,) float
        degree, -90 to 90; a beam with a negative angle points opposite to its azimuth.
    altitude : (altitude,) float
        m, ascending, above the station; uniform for "joint".
    variance : (profile, angle, altitude) float
        Variance of the noise alone, in the square of the unit of the signal, broadcast against it.
    azimuth : (angle,) float, optional
        degree; the same for all angles if not given.
    settings : OpticalDepthSettings
    dead_time_change : (profile, angle, altitude) float, optional
        Change of the signal with one standard error of the dead time, in all beams together, which
        looks like a horizontal gradient near the lidar; NaN where there is no signal.
    signal_quality : (profile, altitude) int, optional
        Bits of the signals of all beams, which tell why values are missing; by default
        INPUT_MISSING where no beam has a signal and its variance.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    kano1968, hamilton1969, gobrusenko1989, dersimonian1986.
    """
    method = inputs.choice(settings.method, MultiAngleMethod, "method")
    station = settings.station_altitude
    height = slant_paths.altitude_grid(altitude, station)
    scan = slant_paths.make_scan(zenith_angle, height, azimuth)
    rows = _cube(signal, "signal", scan.path.shape)
    noise = inputs.broadcast(inputs.real_array(variance, "variance"), rows.shape, "variance")
    noise = noise[:1] if noise.strides[0] == 0 else noise
    if np.any(noise < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the signal's unit"
        )
    noise = _cube(noise, "variance", scan.path.shape)
    _check(settings, method)
    block = BlockSettings(
        **{item.name: getattr(settings, item.name) for item in fields(settings)},
        height=height,
        scan=scan,
        levels=layer_levels(settings.layers, altitude, station_altitude=station)[0],
    )
    change = None
    if dead_time_change is not None:
        change = np.nan_to_num(_cube(dead_time_change, "dead_time_change", rows.shape))
    beams = _block.make_beam_block(rows, noise, scan, change)
    fit = _block.regress(beams, settings.inhomogeneity)
    name, reason = _choose_method(beams, block)
    values = _METHODS[name](beams, fit, block)
    _mark_variation(values, beams, fit)
    _mark_missing(values, rows, noise, signal_quality)
    steps = *_steps(beams, block, name), f"{name}: {reason}"
    return MultiAngleResult(**values, method=name, steps=steps)


def layer_levels(
    layers: Sequence[tuple[float, float]], altitude: npt.ArrayLike, *, station_altitude: float
) -> tuple[Indices, Array]:
    """Return the levels at bottom and top of layers, as `retrieve_optical_depth` moves them.

    Parameters
    ----------
    layers : sequence of (float, float)
        m, bottom and top.
    altitude : (altitude,) float
        m, ascending, above `station_altitude`.
    station_altitude : float
        m.

    Returns
    -------
    levels : (layer, 2) int
        0 for the station, k + 1 for the altitude k.
    bounds : (layer, 2) float
        m, their altitudes.

    Raises
    ------
    RetrievalInputError
        For layers that contain no altitude of the grid, or extend beyond it.
    """
    height = slant_paths.altitude_grid(altitude, station_altitude)
    grid = np.append(height, 0.0) + station_altitude
    try:
        wanted = np.asarray(layers, dtype=np.float64).reshape(len(layers), 2)
    except (TypeError, ValueError):
        wanted = np.full((len(layers), 2), np.nan)
    if not np.all(np.isfinite(wanted)):
        raise RetrievalInputError(
            f"is {layers!r}", field="layers", remedy="give pairs (bottom, top) in m"
        )
    nearest = np.abs(grid - wanted[..., np.newaxis]).argmin(axis=-1)
    bounds = grid[nearest]
    off = np.abs(bounds - wanted).max(axis=1) > 0.5 * np.max(np.diff(np.sort(grid)))
    bad = np.flatnonzero(off | (bounds[:, 0] >= bounds[:, 1]))
    if bad.size:
        bottom, top = wanted[bad[0]]
        raise RetrievalInputError(
            f"[{bottom:g}, {top:g}] m contains no altitude of the grid, or extends beyond it",
            field="layers",
            remedy=f"give bounds from {grid.min():g} to {grid.max():g} m, bottom first",
        )
    return (nearest + 1) % grid.size, bounds


def _cube(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return values as (profile, angle, altitude).

    Compiled functions have one version, for writable float64 in C order.
    """
    array = inputs.real_array(values, name)
    if array.ndim != 3 or array.shape[-len(shape) :] != shape:
        raise RetrievalInputError(
            f"has the shape {array.shape}, with {shape[-2]} angles and {shape[-1]} altitudes",
            field=name,
            remedy="give (profile, angle, altitude)",
        )
    return np.require(array, np.float64, ["C", "W"])


def _check(settings: OpticalDepthSettings, method: MultiAngleMethod) -> None:
    """Refuse numbers below zero, and a strength of the penalty for a method that has none."""
    if settings.regularisation is not None and method not in REGULARISED:
        raise RetrievalInputError(
            f"is not accepted by the method {str(method)!r}",
            field="regularisation",
            remedy=f"leave it out, or choose {' or '.join(sorted(REGULARISED))}",
        )
    for name in ("inhomogeneity", "largest_gradient", "regularisation"):
        value = getattr(settings, name)
        if value is not None and not (np.isfinite(value) and value >= 0):
            raise RetrievalInputError(f"is {value}", field=name, remedy="give zero or more")


def _mark_variation(values: Values, beams: BeamBlock, fit: Regression) -> None:
    """Raise the bits of horizontal variation and of residuals, in place."""
    quality = values["quality"]
    lowest = path_variation_from(beams, fit)
    if lowest is not None:
        quality[:, lowest:] |= np.int32(MultiAngleQuality.POOR_STRATIFICATION)
    poor = (quality & np.int32(MultiAngleQuality.POOR_STRATIFICATION)) != 0
    _withhold_extinction(values, poor)
    untested = np.isfinite(values["optical_depth"]) & (_block.pooled_freedom(fit) == 0)
    _mark(quality, MultiAngleQuality.NO_RESIDUAL, untested)


def _mark_missing(values: Values, signal: Array, variance: Array, carried: Flags | None) -> None:
    """Raise the bits of the signals and the reasons for missing values, in place."""
    samples = np.isfinite(signal + variance).sum(axis=1, dtype=np.int32)
    if carried is None:
        carried = np.where(samples > 0, np.int32(0), np.int32(Quality.INPUT_MISSING))
    quality = values["quality"]
    _mark(quality, Quality.INPUT_MISSING, ~np.any(samples, axis=1, keepdims=True))
    lost = ~np.isfinite(values["optical_depth"]) & (quality == 0)
    reasons = carried & np.int32(WITHHELD)
    reasons[(samples > 1) | (reasons == 0)] = np.int32(MultiAngleQuality.NO_LEVERAGE)
    passed = np.int32(CARE | Quality.NO_SIGNAL)
    quality |= carried & passed | np.where(lost, reasons, np.int32(0))


def _mark(quality: Flags, bit: int, where: Booleans) -> None:
    quality |= np.where(where, np.int32(bit), np.int32(0))


def _withhold_extinction(values: Values, where: Booleans) -> None:
    for error in ("", "_standard_error", "_gradient_error"):
        values[f"extinction{error}"][where] = np.nan


def _steps(beams: BeamBlock, settings: BlockSettings, method: str) -> tuple[str, str]:
    """Return what the data decided before the method."""
    number = int(np.count_nonzero(~settings.scan.usable))
    low = f"{number or 'no'} {'beams are' if number else 'beam is'} less than 3 degrees"
    if method in WITHOUT_GRADIENT:
        fitted, reason = False, f"{method} fits none"
    else:
        around, free = "beams point to all sides", "a half turn around the zenith has no beam"
        fitted, reason = beams.sides, around if beams.sides else free
    return (
        f"{'' if number else 'left out '}drop_longest_paths: {low} above the horizon",
        f"{'' if fitted else 'left out '}horizontal_gradient: {reason}",
    )


def _choose_method(beams: BeamBlock, settings: BlockSettings) -> tuple[str, str]:
    if settings.method != "auto":
        return settings.method, "requested"
    if np.max(np.count_nonzero(beams.noise < np.inf, axis=1), initial=0) <= 2:
        return "two_angle", "no altitude has more than two beams"
    return "joint", "extinction is requested"


# Methods --------------------------------------------------------------------------------------


def _two_angle(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> Values:
    """Solve with the shortest and the longest path of each altitude.

    The inhomogeneity and its correlation along altitude come from all beams of the scan.
    """
    ends = _block.end_beams(beams)
    of_ends = _block.refit(ends, fit.inhomogeneity, fit.freedom)
    return _regression(ends, of_ends, settings, _correlation(beams, fit))


def _kano_hamilton(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> Values:
    """Solve with all beams of each altitude."""
    return _regression(beams, fit, settings, _correlation(beams, fit))


def _regression(
    beams: BeamBlock, fit: Regression, settings: BlockSettings, correlation: float
) -> Values:
    """Return the estimates of single altitudes, with the correlation that residuals show."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(1.0 / fit.column(kh.INFORMATION)) * _block.student_factor(fit.freedom)
    values = _common(beams, fit, settings)
    slopes = _gradient_slopes(values, beams, fit, settings)
    values |= _single_altitudes(
        (fit.within(beams), fit.column(kh.TAU), error), slopes, settings,
        correlation=np.hstack([np.zeros((len(fit.table), 1)), correlation * fit.shared]),
    )  # fmt: skip
    share = np.sqrt(fit.column(kh.AIR) * fit.inhomogeneity)
    values["optical_depth_error_air"] = values["optical_depth_standard_error"] * share
    return values


def _correlation(beams: BeamBlock, fit: Regression) -> float:
    """Return the correlation of the air at neighbouring altitudes, which residuals show."""
    every = _block.typical_profiles(beams.noise)
    return correlation_of_air(
        fit.residual[every], beams.noise[every], fit.leverage[every], fit.inhomogeneity,
        beams.columns if beams.sides else beams.columns[:2],
    )  # fmt: skip


def _mld(
    beams: BeamBlock, fit: Regression, settings: BlockSettings, *, from_below: bool = False
) -> Values:
    """Differentiate along the slant path, each altitude on its own."""
    beams = _block.strong_samples(beams)
    fit = _block.refit(beams, fit.inhomogeneity, fit.freedom)
    own = mld.solve_mld(
        beams, fit.inhomogeneity, from_below=from_below, strength=settings.regularisation
    )
    slopes = settings.largest_gradient * settings.height * own.slopes
    known = fit.within(beams), own.optical_depth, np.sqrt(own.variance)
    values = _common(beams, fit, settings) | _single_altitudes(
        known, slopes, settings, data_share=own.data_share, freedom=own.freedom
    )
    within = np.isfinite(values["data_share"])
    values["regularisation"] = np.where(within, own.strength, np.nan)
    values["prior_optical_depth"] = np.where(within, own.prior, np.nan)
    dominated = within & (np.nan_to_num(own.data_share) < THRESHOLDS.least_share)
    _mark(values["quality"], MultiAngleQuality.PRIOR_DOMINATED, dominated)
    _withhold_extinction(values, dominated)
    return values


def _single_altitudes(
    known: tuple[Booleans, Array, Array],
    slopes: Array,
    settings: BlockSettings,
    *,
    data_share: Array | float = 1.0,
    freedom: Array | float = 1.0,
    correlation: Array | float = 0.0,
) -> Values:
    """Return estimates of single altitudes within the reach, and what follows from them.

    `known` holds the reach, the optical depths and their errors; `slopes`, (axis, profile,
    altitude), the errors by the largest gradient along the axes; `correlation` is that of the error
    with the one at the altitude below.
    """
    reached, estimates, errors = known
    within = reached & np.isfinite(estimates)
    depth, error, share = (
        np.where(within, part, np.nan) for part in (estimates, errors, data_share)
    )
    square, step = error**2, np.diff(settings.height, prepend=0.0)
    below = _below(square)
    common = 2.0 * correlation * np.sqrt(square * below)
    bounds, of_bounds = (_at_layers(part, settings) for part in (depth, square))
    total = np.where(within, freedom, 0.0).sum(axis=1)
    return {
        "optical_depth": depth,
        "optical_depth_standard_error": error,
        "data_share": share,
        "extinction": (depth - _below(depth)) / step,
        "extinction_standard_error": np.sqrt(square + below - common) / step,
        "effective_degrees_of_freedom": np.where(within.any(axis=1), total, np.nan),
        "layer_optical_depth": bounds[..., 1] - bounds[..., 0],
        "layer_optical_depth_standard_error": np.sqrt(of_bounds[..., 1] + of_bounds[..., 0]),
        **_gradient_errors(np.where(within, slopes, np.nan), settings),
    }


def _joint(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> Values:
    """Combine the estimates of single altitudes into profiles with smooth extinction."""
    values, within = _common(beams, fit, settings), fit.within(beams)
    slopes = _gradient_slopes(values, beams, fit, settings)
    rows = np.flatnonzero(within.any(axis=1))
    if rows.size == 0:
        nothing = within, fit.column(kh.TAU), fit.column(kh.TAU)
        return values | _single_altitudes(nothing, slopes, settings)
    noise = AltitudeNoise(_correlation(beams, fit), fit.shared, _block.pooled_freedom(fit))
    smooth = smooth_optical_depth(
        np.where(within, fit.column(kh.TAU), np.nan)[rows],
        np.where(within, fit.column(kh.INFORMATION), 0.0)[rows],
        settings.height,
        noise=noise.of(rows),
    )
    single = np.where(within, slopes, 0.0)[:, rows]
    of_smooth = [smooth.respond(one) if one.any() else 0.0 * smooth.optical_depth for one in single]
    own = {name: getattr(smooth, name) for name in _OF_SMOOTH}
    own |= _gradient_errors(np.stack(of_smooth), settings) | _layers(smooth, settings)
    for name, part in own.items():
        values[name] = part
        if rows.size < len(within):
            values[name] = np.full((len(within), *part.shape[1:]), np.nan)
            values[name][rows] = part
    values["quality"][rows] |= np.where(
        smooth.interpolated, np.int32(MultiAngleQuality.INTERPOLATED), np.int32(0)
    )
    return values


_OF_SMOOTH: Final = (
    "optical_depth", "optical_depth_standard_error", "optical_depth_error_air", "extinction",
    "extinction_standard_error", "effective_degrees_of_freedom", "data_share",
)  # fmt: skip


def _layers(smooth: VerticalResult, settings: BlockSettings) -> Values:
    """Return the optical depths of layers, and their errors."""
    both = [smooth.layer(bottom - 1, top - 1) for bottom, top in settings.levels]
    found = np.array(both).reshape(-1, 2, len(smooth.optical_depth))
    return {
        "layer_optical_depth": found[:, 0].T,
        "layer_optical_depth_standard_error": found[:, 1].T,
    }


def _common(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> Values:
    """Return the values common to all methods, and NaN for those that a method may lack."""
    within, freedom = fit.within(beams), fit.column(kh.FREEDOM)
    error = np.sqrt(fit.column(kh.INTERCEPT_VARIANCE)) * _block.student_factor(fit.freedom)
    with np.errstate(divide="ignore", invalid="ignore"):
        chi2 = fit.column(kh.CHI2) / freedom
    top = np.where(within, settings.height, -np.inf).max(axis=1, initial=-np.inf)
    known = np.isfinite(top)[:, np.newaxis]
    quality = np.zeros(within.shape, dtype=np.int32)
    beyond = known & (settings.height > top[:, np.newaxis])
    _mark(quality, MultiAngleQuality.EXTRAPOLATED, beyond)
    _mark(quality, MultiAngleQuality.NO_LEVERAGE, ~known)
    nothing = np.full(within.shape, np.nan)
    return {
        "log_intercept": np.where(within, fit.column(kh.INTERCEPT), np.nan),
        "log_intercept_standard_error": np.where(within, error, np.nan),
        "inhomogeneity": np.where(within, np.sqrt(fit.inhomogeneity), np.nan),
        "reduced_chi_square": np.where(within & (freedom > 0), chi2, np.nan),
        "residual": fit.residual,
        "reach": np.where(np.isfinite(top), top + settings.station_altitude, np.nan),
        "quality": quality,
        "optical_depth_error_air": nothing,
        "regularisation": nothing,
        "prior_optical_depth": nothing,
    }


def _gradient_slopes(
    values: Values, beams: BeamBlock, fit: Regression, settings: BlockSettings
) -> Array:
    """Return the errors of optical depth by a gradient along the axes of the scan.

    The gradient is the declared one, or that which the residuals show where it is larger. One that
    is too large for air raises `POOR_STRATIFICATION`.
    """
    shown = visible_gradient(beams, fit, settings.height)
    if shown > max(settings.largest_gradient, THRESHOLDS.largest_gradient):
        # With the altitudes between, which have no estimate.
        reached = np.maximum.accumulate(fit.within(beams)[:, ::-1], axis=1)[:, ::-1]
        _mark(values["quality"], MultiAngleQuality.POOR_STRATIFICATION, reached)
    scale = max(settings.largest_gradient, shown) * settings.height
    return np.asarray((fit.table[:, kh.SLOPES : kh.SLOPES + 2] * scale).swapaxes(0, 1))


def _gradient_errors(slopes: Array, settings: BlockSettings) -> Values:
    """Return the gradient errors from the signed errors by gradients along the axes."""
    step = np.diff(settings.height, prepend=0.0)
    rise = [(slope - _below(slope)) / step for slope in slopes]
    across = [np.diff(_at_layers(slope, settings), axis=2)[..., 0] for slope in slopes]
    return {
        "optical_depth_gradient_error": _length(slopes),
        "extinction_gradient_error": _length(rise),
        "layer_optical_depth_gradient_error": _length(across),
    }


def _length(parts: Sequence[Array] | Array) -> Array:
    """Return the root of the sum of squares over axes."""
    return np.asarray(np.sqrt(np.square(parts).sum(axis=0)))


def _at_layers(values: Array, settings: BlockSettings) -> Array:
    """Return values at bottom and top of the layers, (profile, layer, 2); 0 at the lidar."""
    whole = np.concatenate([np.zeros((len(values), 1)), values], axis=1)
    return np.asarray(whole[:, settings.levels])


def _below(values: Array) -> Array:
    """Return the values at the altitude below, 0 at the lidar."""
    return np.concatenate([np.zeros((values.shape[0], 1)), values[:, :-1]], axis=1)


_METHODS: Final[dict[str, Callable[[BeamBlock, Regression, BlockSettings], Values]]] = {
    "two_angle": _two_angle,
    "kano_hamilton": _kano_hamilton,
    "joint": _joint,
    "mld": _mld,
    "mld_prior": partial(_mld, from_below=True),
}

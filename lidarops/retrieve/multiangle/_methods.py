"""One block of a scan solved by one of the named methods, with the record of what ran."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle import _block, _mld_blocks, _neighbours, _path_variation
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression
from lidarops.retrieve.multiangle._result import Profiles
from lidarops.retrieve.multiangle.mld import Regularisation
from lidarops.retrieve.multiangle.slant_paths import Scan
from lidarops.retrieve.multiangle.vertical import smooth_profile

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Step = tuple[str, bool, str]

LEAST_SPAN: Final = 0.1
"""Of slant paths, below which the flag of low leverage rises (0 to 25 degrees)."""
_HARMLESS: Final = 0.02
"""Of the declared gradient: too little to raise a flag, however certain it is."""


@dataclass(frozen=True, slots=True)
class BlockSettings:
    """What is common to the blocks of a retrieval."""

    method: str
    height: Array
    """(altitude,) m above the lidar."""
    scan: Scan
    station_altitude: float
    """m."""
    inhomogeneity: float | None
    largest_gradient: float
    """m-1."""
    robust: bool
    tolerance: float | None
    regularisation: Regularisation
    layers: tuple[tuple[int, int], ...]
    """Altitudes at the bottom and the top of layers, -1 for the lidar."""


def solve_block(
    signal: npt.NDArray[np.floating], variance: Array, prior: Array | None, settings: BlockSettings
) -> tuple[Profiles, list[Step]]:
    """Solve the profiles of one block.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    prior : (profile, altitude) float, optional
        Optical depth, of the methods that take one.
    settings : Settings

    Returns
    -------
    Profiles
    list of (str, bool, str)
        Steps, whether they ran, and why or why not.
    """
    beams = _block.make_beam_block(signal, variance, settings.scan)
    steps = [_angles_step(settings.scan)]
    fit = _block.regress(beams, inhomogeneity=settings.inhomogeneity, robust=settings.robust)
    steps += [_robust_step(fit, settings), _gradient_step(beams)]
    method, why = _chosen(beams, fit, settings)
    steps.append((method, True, why))
    part = _METHODS[method](beams, fit, prior, settings)
    alike = _neighbours.neighbours_alike(beams, fit)
    doubted = 0 if alike else _path_variation.doubted_from(beams, fit)
    if doubted is not None:
        part.flags["poor_stratification"][:, doubted:] = True
        _withhold_extinction(part, part.flags["poor_stratification"])
    _raise_common_flags(part, beams, fit)
    if method in _BLIND:
        # These fit no gradient, whatever sides the beams lead to.
        part.flags["one_sided"] |= np.isfinite(part.optical_depth)
    return part, steps


def _angles_step(scan: Scan) -> Step:
    left_out = int(np.count_nonzero(~scan.usable))
    if left_out:
        return ("drop_longest_paths", True, f"{left_out} beams are longer than 10 vertical paths")
    return ("drop_longest_paths", False, "no beam is longer than 10 vertical paths")


def _robust_step(fit: Regression, settings: BlockSettings) -> Step:
    if not settings.robust:
        return ("robust_passes", False, "not wanted")
    if fit.robust:
        return ("robust_passes", True, "a residual is too large for chance")
    return ("robust_passes", False, "no residual is too large for chance, or fewer than 4 beams")


def _gradient_step(beams: BeamBlock) -> Step:
    if beams.sides:
        return ("horizontal_gradient", True, "beams lead to all sides")
    return ("horizontal_gradient", False, "a half turn around the zenith is free of beams")


def _chosen(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> tuple[str, str]:
    if settings.method != "auto":
        return settings.method, "chosen by name"
    if np.max(np.count_nonzero(beams.noise < np.inf, axis=1), initial=0) <= 2:
        return "two_angle", "no altitude is seen by more than two beams"
    if settings.tolerance is not None:
        information = fit.column(kh.INFORMATION)
        known = information[information > 0]
        error = np.sqrt(1.0 / np.median(known)) if known.size else np.inf
        if error <= settings.tolerance:
            return "kano_hamilton", "its standard error is within the tolerance"
        return "joint", "the standard error of single altitudes exceeds the tolerance"
    return "joint", "extinction is wanted"


def _kano_hamilton(
    beams: BeamBlock, fit: Regression, _prior: Array | None, settings: BlockSettings
) -> Profiles:
    """Take the estimates of single altitudes as they are."""
    part = _start(beams, fit, settings)
    within = np.isfinite(part.optical_depth)
    factor = _block.student_factor(fit.freedom)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(1.0 / fit.column(kh.INFORMATION)) * factor
    part.optical_depth_standard_error[:] = np.where(within, error, np.nan)
    part.extinction[:] = _layer_means(part.optical_depth, settings.height)
    both = part.optical_depth_standard_error**2
    step = np.diff(settings.height, prepend=0.0)
    part.extinction_standard_error[:] = np.sqrt(both + _below(both)) / step
    slopes = np.where(within, _gradient_slopes(fit, settings), np.nan)
    _state_gradient_errors(part, slopes, settings)
    count = within.sum(axis=1)
    part.effective_degrees_of_freedom[:] = np.where(count > 0, count, np.nan)
    part.data_share[:] = np.where(within, 1.0, np.nan)
    _subtract_bounds(part, settings)
    _raise_gradient(part, beams, fit, settings, _lag_one(beams, fit))
    return part


def _two_angle(
    beams: BeamBlock, fit: Regression, prior: Array | None, settings: BlockSettings
) -> Profiles:
    """Use the shortest and the longest path of each altitude, with the scan's inhomogeneity."""
    ends = _block.end_beams(beams)
    part = _kano_hamilton(ends, _block.refit(ends, fit.inhomogeneity, fit.freedom), prior, settings)
    part.flags["gradient"][:] = False
    return part


def _joint(
    beams: BeamBlock, fit: Regression, _prior: Array | None, settings: BlockSettings
) -> Profiles:
    """Join the estimates of single altitudes into smooth profiles."""
    part = _start(beams, fit, settings)
    within = np.isfinite(part.optical_depth)
    share = fit.column(kh.SHARE) * fit.inhomogeneity * _block.kept_information(beams, fit)
    residuals = smooth_profile.residual_moments(
        fit.residual * _block.common_scale(beams, fit)[:, np.newaxis],
        np.where(np.isfinite(fit.residual), _block.weights_of(beams, fit), 0.0),
        np.nan_to_num(fit.leverage, nan=1.0),
        np.broadcast_to(fit.inhomogeneity, share.shape),
        np.where(within, share, 0.0),
        beams.gaps,
    )
    smooth = smooth_profile.smooth_optical_depth(
        part.optical_depth,
        np.where(within, fit.column(kh.INFORMATION), 0.0),
        settings.height,
        station_altitude=0.0,
        residuals=residuals,
    )
    part.optical_depth[:] = smooth.optical_depth
    part.optical_depth_standard_error[:] = smooth.optical_depth_standard_error
    part.extinction[:] = smooth.extinction
    part.extinction_standard_error[:] = smooth.extinction_standard_error
    part.effective_degrees_of_freedom[:] = smooth.effective_degrees_of_freedom
    part.data_share[:] = smooth.data_share
    slopes = _gradient_slopes(fit, settings)
    reply = [smooth_profile.respond(smooth.system, np.where(within, one, 0.0)) for one in slopes]
    _state_gradient_errors(part, np.stack(reply), settings)
    levels = np.append(settings.height, 0.0)
    for number, (bottom, top) in enumerate(settings.layers):
        layer = smooth_profile.layer_optical_depth(
            smooth, float(levels[bottom]), float(levels[top])
        )
        part.layer_optical_depth[:, number] = layer.optical_depth
        part.layer_optical_depth_standard_error[:, number] = layer.optical_depth_standard_error
    _take_vertical_flags(part, smooth)
    correlation = float(np.nanmax(np.append(smooth.correlation, 0.0)))
    _raise_gradient(part, beams, fit, settings, correlation)
    _withhold_extinction(part, _led(part))
    return part


def _take_vertical_flags(part: Profiles, smooth: smooth_profile.VerticalResult) -> None:
    part.flags["interpolated"] |= smooth.interpolated
    part.flags["outlier"] |= smooth.downweighted
    part.flags["prior_dominated"] |= smooth.prior_dominated
    for name, mask in (
        ("saturated", smooth.saturated),
        ("undersmoothed", smooth.undersmoothed),
        ("high_correlation", smooth.high_correlation),
    ):
        part.flags[name] |= mask[:, np.newaxis]


def _led(part: Profiles) -> Mask:
    """Tell where smoothness or a prior, not the data, decides."""
    with np.errstate(invalid="ignore"):
        below = part.data_share < smooth_profile.LEAST_SHARE
        return np.asarray(below | (part.data_share > smooth_profile.LARGEST_SHARE))


def _withhold_extinction(part: Profiles, where: Mask) -> None:
    for values in (part.extinction, part.extinction_standard_error, part.extinction_gradient_error):
        values[where] = np.nan


def _start(beams: BeamBlock, fit: Regression, settings: BlockSettings) -> Profiles:
    """Return profiles with what all methods share; optical depths only within the reach."""
    count, angles, bins = beams.noise.shape
    part = Profiles.missing(count, angles, bins, len(settings.layers))
    tau = fit.column(kh.TAU)
    within = (beams.alive >= beams.needed) & np.isfinite(tau)
    part.optical_depth[:] = np.where(within, tau, np.nan)
    part.log_intercept[:] = np.where(within, fit.column(kh.INTERCEPT), np.nan)
    factor = _block.student_factor(fit.freedom)
    error = np.sqrt(fit.column(kh.INTERCEPT_VARIANCE)) * factor
    part.log_intercept_standard_error[:] = np.where(within, error, np.nan)
    part.inhomogeneity[:] = np.where(within, np.sqrt(fit.inhomogeneity), np.nan)
    freedom = fit.column(kh.FREEDOM)
    with np.errstate(divide="ignore", invalid="ignore"):
        chi2 = fit.column(kh.CHI2) / freedom
    part.reduced_chi_square[:] = np.where(within & (freedom > 0), chi2, np.nan)
    part.residual[:] = fit.residual
    top = np.where(within, settings.height, -np.inf).max(axis=1, initial=-np.inf)
    part.reach[:] = np.where(np.isfinite(top), top + settings.station_altitude, np.nan)
    beyond = settings.height > np.where(np.isfinite(top), top, -np.inf)[:, np.newaxis]
    part.flags["extrapolated"][:] = beyond
    none = np.asarray(~within.any(axis=1))
    part.flags["no_data"][:] = none[:, np.newaxis]
    return part


def _raise_common_flags(part: Profiles, beams: BeamBlock, fit: Regression) -> None:
    """Raise the flags that depend on the geometry alone, wherever there is a value."""
    valued = np.isfinite(part.optical_depth)
    seen = fit.column(kh.INFORMATION) > 0
    part.flags["low_leverage"] |= valued & seen & (fit.column(kh.SPAN) < LEAST_SPAN)
    part.flags["no_residual"] |= valued & (_block.pooled_freedom(fit) == 0)
    one_sided = np.hypot(fit.column(kh.SLOPE_EAST), fit.column(kh.SLOPE_NORTH)) > 1e-6
    part.flags["one_sided"] |= (valued & one_sided) if beams.sides else valued
    if fit.robust:
        low = (fit.keep < 0.5) & (beams.noise < np.inf)
        part.flags["outlier"] |= low.any(axis=1)


def _raise_gradient(
    part: Profiles, beams: BeamBlock, fit: Regression, settings: BlockSettings, correlation: float
) -> None:
    found = _block.gradient_found(
        beams, fit, settings.height, correlation, _HARMLESS * settings.largest_gradient
    )
    part.flags["gradient"] |= found & np.isfinite(part.optical_depth)


def _lag_one(beams: BeamBlock, fit: Regression) -> float:
    """Return the correlation of residuals at neighbouring altitudes, 0 to 0.98."""
    u = np.nan_to_num(fit.residual) * np.sqrt(_block.weights_of(beams, fit))
    both = np.einsum("tak,tak->", u[:, :, :-1], u[:, :, 1:])
    whole = np.einsum("tak,tak->", u, u)
    return float(np.clip(both / whole, 0.0, 0.98)) if whole > 0 else 0.0


def _gradient_slopes(fit: Regression, settings: BlockSettings) -> Array:
    """Return what the largest gradient to the east and north makes of each optical depth."""
    scale = settings.largest_gradient * settings.height
    return np.stack([fit.column(kh.SLOPE_EAST) * scale, fit.column(kh.SLOPE_NORTH) * scale])


def _state_gradient_errors(part: Profiles, slopes: Array, settings: BlockSettings) -> None:
    """Fill what the largest gradient does, from what it does along east and north, signed."""
    part.optical_depth_gradient_error[:] = np.hypot(*slopes)
    part.extinction_gradient_error[:] = np.hypot(
        *(_layer_means(slope, settings.height) for slope in slopes)
    )
    levels = np.concatenate([slopes, np.zeros((*slopes.shape[:2], 1))], axis=2)
    for number, (bottom, top) in enumerate(settings.layers):
        across = levels[:, :, top] - levels[:, :, bottom]
        part.layer_optical_depth_gradient_error[:, number] = np.hypot(*across)


def _layer_means(optical_depth: Array, height: Array) -> Array:
    """Return the change from the altitude below over the distance; zero at the lidar."""
    return (optical_depth - _below(optical_depth)) / np.diff(height, prepend=0.0)


def _below(values: Array) -> Array:
    """Return the values of the altitude below, 0 at the lidar."""
    return np.concatenate([np.zeros((values.shape[0], 1)), values[:, :-1]], axis=1)


def _subtract_bounds(part: Profiles, settings: BlockSettings) -> None:
    """Take optical depths of layers as differences of those of their bounds."""
    none = np.zeros((part.optical_depth.shape[0], 1))
    tau = np.hstack([part.optical_depth, none])
    square = np.hstack([part.optical_depth_standard_error**2, none])
    for number, (bottom, top) in enumerate(settings.layers):
        part.layer_optical_depth[:, number] = tau[:, top] - tau[:, bottom]
        part.layer_optical_depth_standard_error[:, number] = np.sqrt(
            square[:, top] + square[:, bottom]
        )


def _mld(
    beams: BeamBlock, fit: Regression, _prior: Array | None, settings: BlockSettings
) -> Profiles:
    return _regularised(beams, fit, None, settings)


def _mld_prior(
    beams: BeamBlock, fit: Regression, prior: Array | None, settings: BlockSettings
) -> Profiles:
    return _regularised(beams, fit, _mld_blocks.MldPrior(prior), settings)


def _regularised(
    beams: BeamBlock, fit: Regression, prior: _mld_blocks.MldPrior | None, settings: BlockSettings
) -> Profiles:
    """Differentiate along the slant path, altitude by altitude."""
    part = _start(beams, fit, settings)
    answer = _mld_blocks.solve_mld_blocks(beams, fit.inhomogeneity, settings.regularisation, prior)
    within = np.isfinite(part.optical_depth) & np.isfinite(answer.optical_depth)
    part.optical_depth[:] = np.where(within, answer.optical_depth, np.nan)
    part.optical_depth_standard_error[:] = np.where(within, answer.standard_error, np.nan)
    part.data_share[:] = np.where(within, answer.data_share, np.nan)
    part.extinction[:] = _layer_means(part.optical_depth, settings.height)
    both = part.optical_depth_standard_error**2
    step = np.diff(settings.height, prepend=0.0)
    part.extinction_standard_error[:] = np.sqrt(both + _below(both)) / step
    slopes = np.where(within, settings.largest_gradient * settings.height * answer.slopes, np.nan)
    _state_gradient_errors(part, slopes, settings)
    part.effective_degrees_of_freedom[:] = np.where(
        within.any(axis=1), np.where(within, answer.freedom, 0.0).sum(axis=1), np.nan
    )
    led = _led(part)
    part.flags["prior_dominated"] |= within & led
    _subtract_bounds(part, settings)
    _withhold_extinction(part, led)
    return part


_BLIND: Final = ("two_angle", "mld", "mld_prior")
"""Methods that see no horizontal gradient."""
_METHODS: Final[
    dict[str, Callable[[BeamBlock, Regression, Array | None, BlockSettings], Profiles]]
] = {
    "two_angle": _two_angle,
    "kano_hamilton": _kano_hamilton,
    "joint": _joint,
    "mld": _mld,
    "mld_prior": _mld_prior,
}

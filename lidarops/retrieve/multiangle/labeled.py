"""Multi-angle retrieval over xarray: from the beams of a scan to the ``multiangle`` product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices, Integers
from lidarops.retrieve.multiangle import optical_depth, scan_cycles, slant_paths
from lidarops.retrieve.multiangle._horizontal_variation import gradient_scale
from lidarops.retrieve.multiangle.beam_backgrounds import ScanSignals
from lidarops.retrieve.multiangle.flags import REJECTING, MultiAngleQuality
from lidarops.retrieve.multiangle.labeled_altitudes import CARE
from lidarops.retrieve.multiangle.optical_depth import (
    MultiAngleResult,
)
from lidarops.retrieve.multiangle.smooth_profile import nearest_rising
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

__all__ = ["retrieve_optical_depth"]


QUALITY_OF_FLAG: Final = {
    "no_data": MultiAngleQuality.NO_LEVERAGE,
    "extrapolated": MultiAngleQuality.EXTRAPOLATED,
    "interpolated": MultiAngleQuality.INTERPOLATED,
    "no_residual": MultiAngleQuality.NO_RESIDUAL,
    "low_leverage": MultiAngleQuality.LOW_LEVERAGE,
    "poor_stratification": MultiAngleQuality.POOR_STRATIFICATION,
    "prior_dominated": MultiAngleQuality.PRIOR_DOMINATED,
    "undersmoothed": MultiAngleQuality.UNDERSMOOTHED,
    "high_correlation": MultiAngleQuality.HIGH_CORRELATION,
    "outlier": Quality.OUTLIER,
}
"""Of `MultiAngleFlags`."""
_PER_PROFILE: Final = ("effective_degrees_of_freedom", "reach")
_PER_ALTITUDE: Final = (
    "optical_depth",
    "optical_depth_standard_error",
    "optical_depth_gradient_error",
    "extinction",
    "extinction_standard_error",
    "extinction_gradient_error",
    "log_intercept",
    "log_intercept_standard_error",
    "data_share",
    "inhomogeneity",
    "reduced_chi_square",
)
_OF_PENALTY: Final = ("regularisation", "prior_optical_depth")
"""Of the methods with a penalty."""
_PER_LAYER: Final = (
    "layer_optical_depth",
    "layer_optical_depth_standard_error",
    "layer_optical_depth_gradient_error",
)
_PER_PLANE: Final = (
    "optical_depth",
    "optical_depth_standard_error",
    "optical_depth_gradient_error",
    "extinction",
    "extinction_standard_error",
    "extinction_gradient_error",
)
_SEVERAL: Final = 2
"""Planes of a volume."""
_FEWEST_OF_PLANE: Final = 3
"""Beams of a plane that leave a residual."""
_LINEARISATIONS: Final = 3
"""Fits that the agreement of beams starts from: about a biased first one, large backgrounds are off
(`test_unflagged_optical_depths_lie_within_three_standard_errors`, bright beams)."""


def retrieve_optical_depth(
    beams: xr.Dataset,
    *,
    station_altitude: float,
    method: str = "auto",
    largest_gradient: float = optical_depth.LARGEST_GRADIENT,
    layers: Sequence[tuple[float, float]] = (),
    regularisation: float | None = None,
) -> xr.Dataset:
    """Retrieve optical depth and extinction from the cycles of a scan.

    Parameters
    ----------
    beams : xr.Dataset
        From `lidarops.retrieve.multiangle.labeled_altitudes.AltitudeCycles`.
    station_altitude : float
        m above mean sea level.
    method : {"auto", "two_angle", "kano_hamilton", "joint", "mld", "mld_prior"}
        See `MultiAngleMethod`.
    largest_gradient : float
        m-1, horizontal gradient of ln backscatter covered by the gradient errors.
    layers : sequence of (float, float)
        m above mean sea level: bottom and top of the layers whose optical depth is requested;
        moved to the nearest of the altitudes and the station.
    regularisation : float, optional
        Strength of the penalty of "mld" and "mld_prior"; see
        `lidarops.retrieve.multiangle.optical_depth.retrieve_optical_depth`.

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``multiangle`` product. Where a value is NaN, a bit of
        ``quality_flag`` gives the reason; the optical depth of a layer is NaN where a bit at one of
        its bounds rejects the value there. The attribute ``method`` names the method that ran;
        ``steps`` lists it and the methods that did not, with reasons.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.
    """
    altitude, zenith_angle = (beams[n].to_numpy() for n in ("altitude", "beam_zenith_angle"))
    bounds = optical_depth.layer_bounds(layers, altitude, station_altitude=station_altitude)
    settings: dict[str, Any] = {
        "azimuth": beams["beam_azimuth"].to_numpy() if "beam_azimuth" in beams.coords else None,
        "method": method,
        "station_altitude": station_altitude,
        "largest_gradient": largest_gradient,
        "regularisation": regularisation,
    }
    signals = _agreed_signals(beams, zenith_angle, altitude, settings)
    levels = np.searchsorted(altitude, bounds, side="right")
    retrieval = _solve_all(signals, zenith_angle, altitude, levels, layers=layers, **settings)
    signal = signals.signal
    sampled = np.isfinite(signal).any(axis=-1)
    values = {
        _variable(name): (("time", "altitude"), getattr(retrieval, name))
        for name in (*_PER_ALTITUDE, *(_OF_PENALTY if method in optical_depth.REGULARISED else ()))
    }
    depth = nearest_rising(retrieval.optical_depth)
    values["monotone_vertical_optical_depth"] = (("time", "altitude"), depth)
    quality = _quality(retrieval, beams["quality"].to_numpy(), np.isfinite(signal).sum(axis=1))
    product = xr.Dataset(
        {
            **values,
            **{name: ("time", getattr(retrieval, name)) for name in _PER_PROFILE},
            "beam_signal": (("time", "beam", "altitude"), signal),
            "beam_obstruction": beams["obstruction"],
            "residual": (("time", "beam", "altitude"), retrieval.residual),
            "quality_flag": (("time", "altitude"), quality),
            "beams": ("time", sampled.sum(axis=1).astype(np.int32)),
            "shots": beams["shots"],
        },
        coords={name: beams[name] for name in beams.coords},
        attrs={"steps": _step_texts(retrieval), "method": _method_of(retrieval)},
    )
    product = product.assign(_plane_variables(signals, beams, settings))
    product = product.assign(_systematic_variables(retrieval, signals, beams, station_altitude))
    if not layers:
        return product
    return product.assign(_layer_variables(retrieval, quality, levels, bounds))


def _variable(field: str) -> str:
    """Return the variable of a field of `MultiAngleResult`, whose package says which quantity."""
    return (
        field.replace("optical_depth", "vertical_optical_depth")
        .replace("extinction", "total_extinction")
        .replace("reduced_chi_square", "reduced_chi2")
    )


def _agreed_signals(
    beams: xr.Dataset, zenith_angle: Array, altitude: Array, settings: dict[str, Any]
) -> ScanSignals:
    """Return the signals with the backgrounds with which the beams agree best."""
    left = beams["left"].to_numpy()
    height = altitude - settings["station_altitude"]
    prior = signals = ScanSignals.of(
        beams["signal"].to_numpy(),
        beams["variance"].to_numpy(),
        left,
        slant_paths.slant_path(zenith_angle, height),
        beams["response"].to_numpy(),
        beams["dead_time_error"].to_numpy() if "dead_time_error" in beams else None,
    )
    for _ in range(_LINEARISATIONS if (left > 0.0).any() else 0):
        signals = prior.agreed(_solve(signals, zenith_angle, altitude, **settings))
    return signals


def _plane_variables(
    signals: ScanSignals, beams: xr.Dataset, settings: dict[str, Any]
) -> dict[str, xr.Variable]:
    """Return the variables of the vertical planes of a volume; none where it has one plane only.

    The inhomogeneity of a plane is its own. Values that a flag rejects are NaN. Where the planes
    surround the zenith, their scatter tells the gradient error.
    """
    if settings["azimuth"] is None:
        return {}
    altitude, zenith_angle = (beams[n].to_numpy() for n in ("altitude", "beam_zenith_angle"))
    planes = _planes_with_leverage(signals, zenith_angle, settings["azimuth"])
    if len(planes) < _SEVERAL:
        return {}
    pieces: dict[str, list[Array]] = {name: [] for name in _PER_PLANE}
    for members in planes:
        part = signals.of_beams(members)
        own = settings | {"azimuth": settings["azimuth"][members]}
        nothing = np.empty((0, 2), dtype=np.intp)
        retrieval = _solve_all(part, zenith_angle[members], altitude, nothing, layers=(), **own)
        samples = np.isfinite(part.signal).sum(axis=1)
        quality = _quality(retrieval, beams["quality"].to_numpy(), samples)
        rejected = (quality & np.int32(REJECTING)) != 0
        for name, values in pieces.items():
            values.append(np.where(rejected, np.nan, getattr(retrieval, name)))
    stacked = {name: np.stack(values) for name, values in pieces.items()}
    every = np.concatenate(planes)
    height = altitude - settings["station_altitude"]
    scan = slant_paths.make_scan(zenith_angle[every], height, settings["azimuth"][every])
    if slant_paths.surrounds_zenith(scan.tilted_azimuths):
        names = (f"optical_depth{error}" for error in ("", "_standard_error", "_gradient_error"))
        scale = gradient_scale(*(stacked[name] for name in names))
        for quantity in ("optical_depth", "extinction"):
            stacked[f"{quantity}_gradient_error"] *= scale
    cube = ("time", "plane", "altitude")
    azimuths = [_azimuth_of_plane(settings["azimuth"], zenith_angle, own) for own in planes]
    return {
        "plane": xr.Variable("plane", np.arange(len(planes), dtype=np.int32)),
        "plane_azimuth": xr.Variable("plane", np.array(azimuths)),
        **{
            f"plane_{_variable(name)}": xr.Variable(cube, values.swapaxes(0, 1))
            for name, values in stacked.items()
        },
    }


def _systematic_variables(
    retrieval: MultiAngleResult, signals: ScanSignals, beams: xr.Dataset, station_altitude: float
) -> dict[str, xr.Variable]:
    """Return the errors by dead time and baseline, as far as the signals have them."""
    thickness = np.diff(beams["altitude"].to_numpy(), prepend=station_altitude)
    variables = {}
    for cause in ("dead_time_error", "baseline_error"):
        if cause not in beams:
            continue
        shift = signals.shift_by(retrieval, beams[cause].to_numpy())
        errors = {
            "optical_depth": np.abs(shift),
            "extinction": np.abs(np.diff(shift, axis=1, prepend=0.0)) / thickness,
        }
        for name, error in errors.items():
            known = np.isfinite(getattr(retrieval, name))
            variables[f"{_variable(name)}_{cause}"] = xr.Variable(
                ("time", "altitude"), np.where(known, error, np.nan)
            )
    return variables


def _planes_with_leverage(
    signals: ScanSignals, zenith_angle: Array, azimuth: Array
) -> list[Integers]:
    """Return the beams of the vertical planes of which three or more see different paths."""
    lowest = signals.path[:, 0]
    return [
        members
        for members in scan_cycles.vertical_planes(zenith_angle, azimuth)
        if members.size >= _FEWEST_OF_PLANE and np.ptp(lowest[members]) >= THRESHOLDS.least_span
    ]


def _azimuth_of_plane(azimuth: Array, zenith_angle: Array, members: Integers) -> float:
    """Return the azimuth of the lowest beam of a plane, degree."""
    return float(azimuth[members][np.argmax(zenith_angle[members])])


def _layer_variables(
    retrieval: MultiAngleResult, quality: Flags, levels: Indices, bounds: Array
) -> dict[str, xr.Variable]:
    """Return the variables of layers; NaN where a flag rejects the value at a bound."""
    rejected = (quality & np.int32(REJECTING)) != 0
    # At the station the optical depth is zero, and nothing is rejected.
    rejected = np.hstack([np.zeros((len(quality), 1), dtype=np.bool_), rejected])
    hidden = rejected[:, levels].any(axis=2)
    variables = {
        _variable(name): xr.Variable(
            ("time", "layer"), np.where(hidden, np.nan, getattr(retrieval, name))
        )
        for name in _PER_LAYER
    }
    middle = xr.Variable("layer", bounds.mean(axis=1))
    limits = xr.Variable(("layer", "nv"), bounds)
    return {**variables, "layer_altitude": middle, "layer_bnds": limits}


def _solve_all(
    beams: ScanSignals,
    zenith_angle: Array,
    altitude: Array,
    levels: Indices,
    **settings: Any,
) -> MultiAngleResult:
    """Return the result of the method, with errors by what the backgrounds may hold."""
    retrieval = _solve(beams, zenith_angle, altitude, **settings)
    thickness = np.diff(altitude, prepend=settings["station_altitude"])
    return _with_background_errors(retrieval, beams, thickness, levels)


def _solve(
    beams: ScanSignals, zenith_angle: Array, altitude: Array, **settings: Any
) -> MultiAngleResult:
    """Return the result of the method."""
    return optical_depth.retrieve_optical_depth(
        beams.signal,
        zenith_angle,
        altitude,
        variance=beams.variance,
        dead_time_change=beams.dead_time_change,
        **settings,
    )


def _method_of(retrieval: MultiAngleResult) -> str:
    """Return the method that ran."""
    ran = (step.step for step in retrieval.steps if step.ran)
    return next(name for name in ran if name in set(optical_depth.MultiAngleMethod))


def _step_texts(retrieval: MultiAngleResult) -> str:
    return "; ".join(
        f"{step.step if step.ran else f'left out {step.step}'}: {step.reason}"
        for step in retrieval.steps
    )


def _quality(retrieval: MultiAngleResult, carried: Flags, samples: Indices) -> Flags:
    """Return the quality bits of each value; a missing value has at least one.

    Parameters
    ----------
    retrieval : MultiAngleResult
    carried : (time, altitude) int
        Bits of the signals.
    samples : (time, altitude) int
        Number of beams with a signal.
    """
    raised = {field.name: getattr(retrieval.flags, field.name) for field in fields(retrieval.flags)}
    raised["extrapolated"] = raised["extrapolated"] & ~raised["no_data"]
    bits = carried & np.int32(CARE)
    for name, bit in QUALITY_OF_FLAG.items():
        bits |= np.where(raised[name], np.int32(bit), np.int32(0))
    # Values missing at single altitudes take their reasons from the signals, below.
    empty = (retrieval.quality & np.int32(Quality.INPUT_MISSING)).all(axis=-1, keepdims=True)
    bits |= np.where(empty, np.int32(Quality.INPUT_MISSING), np.int32(0))
    untested = np.isfinite(retrieval.optical_depth) & ~np.isfinite(retrieval.reduced_chi_square)
    untested &= ~raised["interpolated"]
    bits |= np.where(untested, np.int32(MultiAngleQuality.NO_RESIDUAL), np.int32(0))
    unflagged = (bits & ~np.int32(CARE)) == 0
    lost = ~np.isfinite(retrieval.optical_depth) & unflagged
    reasons = np.where(
        samples > 1, np.int32(MultiAngleQuality.NO_LEVERAGE), carried & np.int32(WITHHELD)
    )
    reasons = np.where(reasons == 0, np.int32(MultiAngleQuality.NO_LEVERAGE), reasons)
    bits |= np.where(lost, reasons, np.int32(0))
    negative = np.zeros(lost.shape, dtype=np.bool_)
    for name in ("optical_depth", "extinction"):
        error = getattr(retrieval, f"{name}_standard_error")
        negative |= getattr(retrieval, name) < -THRESHOLDS.negative * error
    depth, error = retrieval.optical_depth, retrieval.optical_depth_standard_error
    negative |= _below_others(depth, error, (bits == 0) & ~negative)
    bits |= np.where(negative, np.int32(MultiAngleQuality.NEGATIVE_OPTICAL_DEPTH), np.int32(0))
    # The layer that ends at a valid altitude may begin in a gap.
    gapped = np.zeros(lost.shape, dtype=bool)
    for name in _PER_ALTITUDE:
        gapped |= ~np.isfinite(getattr(retrieval, name))
    return bits | np.where(
        gapped & unflagged & ~lost, np.int32(MultiAngleQuality.INTERPOLATED), np.int32(0)
    )


def _below_others(depth: Array, error: Array, good: Booleans) -> Booleans:
    """Return the values below a good one under them, by the error of the difference."""
    below = np.zeros(depth.shape, dtype=np.bool_)
    for k in range(depth.shape[-1]):
        known = (good & ~below)[:, [k]]
        most = THRESHOLDS.negative * np.hypot(error[:, k:], error[:, [k]])
        below[:, k:] |= known & (depth[:, [k]] - depth[:, k:] > most)
    return below


def _with_background_errors(
    retrieval: MultiAngleResult,
    beams: ScanSignals,
    thickness: Array,
    levels: Indices,
) -> MultiAngleResult:
    """Return the result with standard errors that include signal in the background of all beams.

    `thickness` is that of the layers between altitudes in m; `levels` are the bottom and top of
    requested layers, 0 for the station and k + 1 for altitude k.
    """
    shift = np.pad(beams.shift(retrieval), ((0, 0), (1, 0)))
    of_layers = np.diff(shift[:, levels], axis=2)[..., 0]
    return replace(
        retrieval,
        optical_depth_standard_error=np.hypot(retrieval.optical_depth_standard_error, shift[:, 1:]),
        extinction_standard_error=np.hypot(
            retrieval.extinction_standard_error, np.diff(shift, axis=1) / thickness
        ),
        layer_optical_depth_standard_error=np.hypot(
            retrieval.layer_optical_depth_standard_error, of_layers
        ),
    )

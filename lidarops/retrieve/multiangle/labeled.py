"""Scans over xarray: from the profiles of a scene to optical depth over cycle and altitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.multiangle import optical_depth, slant_paths
from lidarops.retrieve.multiangle.labeled_altitudes import (
    CARE,
    WITHHELD,
    Background,
    on_altitudes,
)
from lidarops.retrieve.multiangle.optical_depth import (
    MultiAngleMethod,
    MultiAngleResult,
    StepRecord,
)
from lidarops.retrieve.multiangle.vertical.monotone import project as monotone

__all__ = ["Background", "on_altitudes", "retrieve_optical_depth", "retrieve_scan"]

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

_QUALITY_OF_FLAG: Final = {
    "no_data": Quality.NO_LEVERAGE,
    "extrapolated": Quality.EXTRAPOLATED,
    "interpolated": Quality.INTERPOLATED,
    "no_residual": Quality.NO_RESIDUAL,
    "low_leverage": Quality.LOW_LEVERAGE,
    "one_sided": Quality.ONE_SIDED,
    "gradient": Quality.HORIZONTAL_GRADIENT,
    "poor_stratification": Quality.POOR_STRATIFICATION,
    "prior_dominated": Quality.PRIOR_DOMINATED,
    "undersmoothed": Quality.UNDERSMOOTHED,
    "high_correlation": Quality.HIGH_CORRELATION,
    "outlier": Quality.OUTLIER,
}
"""Of `MultiAngleFlags`; `saturated` is a part of `prior_dominated`."""
_SHARE_OF_ERROR: Final = 0.5
"""Of the standard error: the most that signal left in the background may move an optical depth
without a flag."""
_PROFILES: Final = ("effective_degrees_of_freedom", "reach")
_LEVELS: Final = (
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
_OF_LAYERS: Final = (
    "layer_optical_depth",
    "layer_optical_depth_standard_error",
    "layer_optical_depth_gradient_error",
)


def retrieve_scan(
    conditioned: xr.Dataset,
    *,
    zenith_angle: npt.ArrayLike,
    azimuth: npt.ArrayLike | None,
    time: npt.ArrayLike,
    time_bnds: npt.ArrayLike,
    shots: npt.ArrayLike,
    altitude_grid: npt.ArrayLike,
    station_altitude: float,
    background: Background,
    overlap: Array | None = None,
    method: str = "auto",
    largest_gradient: float = optical_depth.LARGEST_GRADIENT,
    layers: Sequence[tuple[float, float]] = (),
) -> xr.Dataset:
    """Retrieve optical depth and extinction from the profiles of a scanning lidar.

    `on_altitudes`, computed, and `retrieve_optical_depth`, whose arguments these are.

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``multiangle`` product.

    Raises
    ------
    RetrievalInputError
        Where arguments cannot be right, or no beam leads above the horizon.
    """
    beams = on_altitudes(
        conditioned,
        zenith_angle=zenith_angle,
        azimuth=azimuth,
        time=time,
        time_bnds=time_bnds,
        shots=shots,
        altitude_grid=altitude_grid,
        station_altitude=station_altitude,
        background=background,
        overlap=overlap,
    )
    return retrieve_optical_depth(
        beams.compute(),
        station_altitude=station_altitude,
        method=method,
        largest_gradient=largest_gradient,
        layers=layers,
    )


def retrieve_optical_depth(
    beams: xr.Dataset,
    *,
    station_altitude: float,
    method: str = "auto",
    largest_gradient: float = optical_depth.LARGEST_GRADIENT,
    layers: Sequence[tuple[float, float]] = (),
) -> xr.Dataset:
    """Retrieve optical depth and extinction from the cycles of a scan.

    Parameters
    ----------
    beams : xr.Dataset
        From `on_altitudes`, in memory. All its cycles are one block of
        `lidarops.retrieve.multiangle.optical_depth.retrieve_optical_depth`.
    station_altitude : float
        m above mean sea level.
    method : {"auto", "two_angle", "kano_hamilton", "joint", "mld", "mld_prior"}
        Where "auto" takes "joint" and that doubts all its intervals, "kano_hamilton" follows.
    largest_gradient : float
        m-1, of ln backscatter along the horizontal, for which the gradient errors allow.
    layers : sequence of (float, float)
        m above mean sea level: bottom and top of layers whose optical depth is wanted; moved to
        the nearest of the altitudes and the station.

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``multiangle`` product. Where a value is NaN, a bit of
        ``quality_flag`` says why; the optical depth of a layer is NaN where a bit at one of its
        bounds forbids the use of a value there. The attribute ``steps`` tells what ran and what
        did not.

    Raises
    ------
    RetrievalInputError
        Where arguments cannot be right.
    """
    signal = beams["signal"].to_numpy()
    found = _solved(
        signal,
        beams["beam_zenith_angle"].to_numpy(),
        beams["altitude"].to_numpy(),
        variance=beams["variance"].to_numpy(),
        azimuth=beams["beam_azimuth"].to_numpy() if "beam_azimuth" in beams.coords else None,
        method=method,
        station_altitude=station_altitude,
        largest_gradient=largest_gradient,
        layers=layers,
    )
    sampled = np.isfinite(signal).any(axis=-1)
    values = {name: (("time", "altitude"), getattr(found, name)) for name in _LEVELS}
    values["reduced_chi2"] = values.pop("reduced_chi_square")
    values["monotone_optical_depth"] = (("time", "altitude"), monotone(found.optical_depth))
    quality = _judged(found, beams["quality"].to_numpy(), np.isfinite(signal).sum(axis=1))
    quality |= _moved(found, beams, station_altitude) * np.int32(Quality.BACKGROUND_UNCERTAIN)
    result = xr.Dataset(
        {
            **values,
            **{name: ("time", getattr(found, name)) for name in _PROFILES},
            "residual": (("time", "beam", "altitude"), found.residual),
            "quality_flag": (("time", "altitude"), quality),
            "beams": ("time", sampled.sum(axis=1).astype(np.int32)),
            "shots": beams["shots"],
        },
        coords={name: beams[name] for name in beams.coords},
        attrs={"steps": _told(found)},
    )
    if not layers:
        return result
    bounds = optical_depth.layer_bounds(
        layers, beams["altitude"], station_altitude=station_altitude
    )
    return result.assign(_in_layers(found, quality, beams["altitude"].to_numpy(), bounds))


def _in_layers(
    found: MultiAngleResult, quality: Flags, altitude: Array, bounds: Array
) -> dict[str, xr.Variable]:
    """Return what is wanted of layers, withheld where a bound is not to be used."""
    unusable = (quality & np.int32(Quality.rejecting())) != 0
    # The station, below all altitudes, is beyond doubt.
    unusable = np.hstack([np.zeros((len(quality), 1), dtype=np.bool_), unusable])
    levels = np.searchsorted(altitude, bounds, side="right")
    hidden = unusable[:, levels].any(axis=2)
    variables = {
        name: xr.Variable(("time", "layer"), np.where(hidden, np.nan, getattr(found, name)))
        for name in _OF_LAYERS
    }
    middle = xr.Variable("layer", bounds.mean(axis=1))
    limits = xr.Variable(("layer", "nv"), bounds)
    return {**variables, "layer_altitude": middle, "layer_bnds": limits}


def _solved(*data: Array, method: str, **settings: Any) -> MultiAngleResult:
    """Return what `optical_depth.retrieve_optical_depth` finds, of single altitudes where "auto" joined in vain.

    Errors that go along with altitude, as of the energy of the shots, are no smooth profile's:
    there the joint solution doubts its own intervals, and single altitudes still stand.
    """
    found = optical_depth.retrieve_optical_depth(*data, method=method, **settings)
    flags = found.flags
    valued = np.isfinite(found.optical_depth)
    doubted = flags.undersmoothed | flags.high_correlation
    if method != MultiAngleMethod.AUTO or not valued.any() or not doubted[valued].all():
        return found
    single = optical_depth.retrieve_optical_depth(
        *data, method=MultiAngleMethod.KANO_HAMILTON.value, **settings
    )
    causes = [name for name in ("undersmoothed", "high_correlation") if getattr(flags, name).any()]
    why = f"its intervals would be too narrow ({' and '.join(causes)})"
    return replace(
        single,
        steps=(*single.steps, StepRecord(0, MultiAngleMethod.JOINT.value, ran=False, reason=why)),
    )


def _told(found: MultiAngleResult) -> str:
    return "; ".join(
        f"{step.step if step.ran else f'left out {step.step}'}: {step.reason}"
        for step in found.steps
    )


def _judged(found: MultiAngleResult, carried: Flags, samples: npt.NDArray[np.intp]) -> Flags:
    """Return what speaks against each value, and a reason for each that is missing."""
    raised = {field.name: getattr(found.flags, field.name) for field in fields(found.flags)}
    raised["extrapolated"] = raised["extrapolated"] & ~raised["no_data"]
    bits = carried & np.int32(CARE)
    for name, bit in _QUALITY_OF_FLAG.items():
        bits |= np.where(raised[name], np.int32(bit), np.int32(0))
    # What is missing at single altitudes has its reasons below, as the signals carry them.
    gone = (found.quality & np.int32(Quality.INPUT_MISSING)).all(axis=-1, keepdims=True)
    bits |= np.where(gone, np.int32(Quality.INPUT_MISSING), np.int32(0))
    untested = np.isfinite(found.optical_depth) & ~np.isfinite(found.reduced_chi_square)
    untested &= ~raised["interpolated"]
    bits |= np.where(untested, np.int32(Quality.NO_RESIDUAL), np.int32(0))
    silent = (bits & ~np.int32(CARE)) == 0
    lost = ~np.isfinite(found.optical_depth) & silent
    reasons = np.where(samples > 1, np.int32(Quality.NO_LEVERAGE), carried & np.int32(WITHHELD))
    reasons = np.where(reasons == 0, np.int32(Quality.NO_LEVERAGE), reasons)
    bits |= np.where(lost, reasons, np.int32(0))
    # The layer below a value that stands reaches down into a gap.
    gapped = np.zeros(lost.shape, dtype=bool)
    for name in _LEVELS:
        gapped |= ~np.isfinite(getattr(found, name))
    return bits | np.where(gapped & silent & ~lost, np.int32(Quality.INTERPOLATED), np.int32(0))


def _moved(found: MultiAngleResult, beams: xr.Dataset, station_altitude: float) -> Flags:
    """Return 1 where signal left in the background may move an optical depth, else 0.

    By the weighted regression on the slant path of the relative change of each signal.
    """
    height = beams["altitude"].to_numpy() - station_altitude
    path = slant_paths.slant_path(beams["beam_zenith_angle"].to_numpy(), height)
    signal, variance = beams["signal"].to_numpy(), beams["variance"].to_numpy()
    scatter = np.nan_to_num(found.inhomogeneity)[:, np.newaxis, :] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        change = beams["left"].to_numpy()[:, :, np.newaxis] * (path * height) ** 2 / signal
        weight = 1.0 / (variance / signal**2 + scatter)
        used = np.isfinite(found.residual) & np.isfinite(change) & np.isfinite(weight)
        weight = np.where(used, weight, 0.0)
        mean = (weight * path).sum(axis=1) / weight.sum(axis=1)
        arm = weight * (path - mean[:, np.newaxis, :])
        change = np.where(used, change, 0.0)
        shift = 0.5 * (arm * change).sum(axis=1) / (arm * path).sum(axis=1)
        moved = np.abs(shift) > _SHARE_OF_ERROR * found.optical_depth_standard_error
    return np.asarray(moved, dtype=np.int32)

"""Multi-angle retrieval over xarray: from the beams of a scan to the ``multiangle`` product."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple, Self

import numpy as np
import xarray as xr

from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices, Integers
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.multiangle import optical_depth, scan_cycles, slant_paths
from lidarops.retrieve.multiangle._horizontal_variation import gradient_scale
from lidarops.retrieve.multiangle.beam_backgrounds import ScanSignals
from lidarops.retrieve.multiangle.flags import CARE, REJECTING, MultiAngleQuality
from lidarops.retrieve.multiangle.optical_depth import MultiAngleResult, OpticalDepthSettings
from lidarops.retrieve.multiangle.smooth_profile import nearest_rising
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

__all__ = ["retrieve_optical_depth"]


_PER_PROFILE: Final = ("effective_degrees_of_freedom", "reach")
_PER_PLANE: Final = tuple(
    f"{quantity}{error}"
    for quantity in ("optical_depth", "extinction")
    for error in ("", "_standard_error", "_gradient_error")
)
_PER_LAYER: Final = tuple(f"layer_{name}" for name in _PER_PLANE[:3])
_PER_ALTITUDE: Final = (
    *_PER_PLANE,
    "log_intercept",
    "log_intercept_standard_error",
    "data_share",
    "inhomogeneity",
    "reduced_chi_square",
)
_OF_PENALTY: Final = ("regularisation", "prior_optical_depth")
"""Of the methods with a penalty."""
_WITHOUT_PENALTY: Final = ("optical_depth_error_air",)
"""Of the others."""
_SEVERAL: Final = 2
"""Planes of a volume."""
_FEWEST_OF_PLANE: Final = 3
"""Beams of a plane that leave a residual."""
_LINEARISATIONS: Final = 3
"""Fits that the agreement of beams starts from: about a biased first one, large backgrounds are off
(`test_unflagged_optical_depths_lie_within_three_standard_errors`, bright beams)."""


def retrieve_optical_depth(beams: xr.Dataset, settings: OpticalDepthSettings) -> xr.Dataset:
    """Retrieve optical depth and extinction from the cycles of a scan.

    Parameters
    ----------
    beams : xr.Dataset
        From `lidarops.retrieve.multiangle.labeled_altitudes.AltitudeCycles`.
    settings : OpticalDepthSettings
        Altitudes in m above mean sea level.

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
    scan = _Scan.of(beams, settings)
    levels, bounds = optical_depth.layer_levels(
        settings.layers, scan.altitude, station_altitude=settings.station_altitude
    )
    signals = _agreed_signals(beams, scan)
    retrieval = scan.solve_with_errors(signals, levels)
    signal = signals.signal
    sampled = np.isfinite(signal).any(axis=-1)
    penalised = settings.method in optical_depth.REGULARISED
    values = {
        _variable(name): (("time", "altitude"), getattr(retrieval, name))
        for name in (*_PER_ALTITUDE, *(_OF_PENALTY if penalised else _WITHOUT_PENALTY))
    }
    depth = nearest_rising(retrieval.optical_depth)
    values["monotone_vertical_optical_depth"] = (("time", "altitude"), depth)
    quality = _quality(retrieval)
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
        attrs={"steps": "; ".join(retrieval.steps), "method": retrieval.method},
    )
    product = product.assign(_plane_variables(signals, scan))
    product = product.assign(
        _systematic_variables(retrieval, signals, beams, settings.station_altitude)
    )
    if not settings.layers:
        return product
    return product.assign(_layer_variables(retrieval, quality, levels, bounds))


class _Scan(NamedTuple):
    """What the signals of the beams are solved with."""

    zenith_angle: Array
    """(beam,), degree."""
    azimuth: Array | None
    """(beam,), degree."""
    altitude: Array
    """m."""
    quality: Flags
    """(time, altitude)."""
    settings: OpticalDepthSettings

    @classmethod
    def of(cls, beams: xr.Dataset, settings: OpticalDepthSettings) -> Self:
        """Return the scan of the cycles."""
        return cls(
            beams["beam_zenith_angle"].to_numpy(),
            beams["beam_azimuth"].to_numpy() if "beam_azimuth" in beams.coords else None,
            beams["altitude"].to_numpy(),
            beams["quality"].to_numpy(),
            settings,
        )

    @property
    def height(self) -> Array:
        """Altitudes above the station, m."""
        return self.altitude - self.settings.station_altitude

    def solve(self, signals: ScanSignals) -> MultiAngleResult:
        """Return the result of the method."""
        return optical_depth.retrieve_optical_depth(
            signals.signal,
            self.zenith_angle,
            self.altitude,
            variance=signals.variance,
            azimuth=self.azimuth,
            settings=self.settings,
            dead_time_change=signals.dead_time_change,
            signal_quality=self.quality,
        )

    def solve_with_errors(self, signals: ScanSignals, levels: Indices) -> MultiAngleResult:
        """Return the result of the method, with errors by what the backgrounds may hold.

        `levels` are the bottom and top of requested layers, 0 for the station and k + 1 for the
        altitude k.
        """
        retrieval = self.solve(signals)
        thickness = np.diff(self.altitude, prepend=self.settings.station_altitude)
        shift = np.pad(signals.shift(retrieval), ((0, 0), (1, 0)))
        parts = {
            "optical_depth": shift[:, 1:],
            "extinction": np.diff(shift, axis=1) / thickness,
            "layer_optical_depth": np.diff(shift[:, levels], axis=2)[..., 0],
        }
        errors = {f"{name}_standard_error": part for name, part in parts.items()}
        return replace(
            retrieval,
            **{name: np.hypot(getattr(retrieval, name), part) for name, part in errors.items()},
        )


def _variable(field: str) -> str:
    """Return the variable of a field of `MultiAngleResult`, whose package says which quantity."""
    return (
        field.replace("optical_depth", "vertical_optical_depth")
        .replace("extinction", "total_extinction")
        .replace("reduced_chi_square", "reduced_chi2")
    )


def _agreed_signals(beams: xr.Dataset, scan: _Scan) -> ScanSignals:
    """Return the signals with the backgrounds with which the beams agree best."""
    left = beams["left"].to_numpy()
    prior = signals = ScanSignals.of(
        beams["signal"].to_numpy(),
        beams["variance"].to_numpy(),
        left,
        slant_paths.slant_path(scan.zenith_angle, scan.height),
        beams["response"].to_numpy(),
        beams["dead_time_error"].to_numpy() if "dead_time_error" in beams else None,
    )
    for _ in range(_LINEARISATIONS if (left > 0.0).any() else 0):
        signals = prior.agreed(scan.solve(signals))
    return signals


def _plane_variables(signals: ScanSignals, scan: _Scan) -> dict[str, xr.Variable]:
    """Return the variables of the vertical planes of a volume; none where it has one plane only.

    The inhomogeneity of a plane is its own. Values that a flag rejects are NaN. Where the planes
    surround the zenith, their scatter tells the gradient error.
    """
    if scan.azimuth is None:
        return {}
    zenith_angle, azimuth = scan.zenith_angle, scan.azimuth
    planes = _planes_with_leverage(signals, zenith_angle, azimuth)
    if len(planes) < _SEVERAL:
        return {}
    pieces: dict[str, list[Array]] = {name: [] for name in _PER_PLANE}
    without_layers = replace(scan.settings, layers=())
    for members in planes:
        plane = scan._replace(
            zenith_angle=zenith_angle[members], azimuth=azimuth[members], settings=without_layers
        )
        nothing = np.empty((0, 2), dtype=np.intp)
        retrieval = plane.solve_with_errors(signals.of_beams(members), nothing)
        rejected = retrieval.raised(REJECTING)
        for name, values in pieces.items():
            values.append(np.where(rejected, np.nan, getattr(retrieval, name)))
    stacked = {name: np.stack(values) for name, values in pieces.items()}
    every = np.concatenate(planes)
    geometry = slant_paths.make_scan(zenith_angle[every], scan.height, azimuth[every])
    if slant_paths.surrounds_zenith(geometry.tilted_azimuths):
        names = (f"optical_depth{error}" for error in ("", "_standard_error", "_gradient_error"))
        scale = gradient_scale(*(stacked[name] for name in names))
        for quantity in ("optical_depth", "extinction"):
            stacked[f"{quantity}_gradient_error"] *= scale
    cube = ("time", "plane", "altitude")
    # That of the lowest beam of a plane.
    azimuths = [float(azimuth[own][np.argmax(zenith_angle[own])]) for own in planes]
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


def _quality(retrieval: MultiAngleResult) -> Flags:
    """Return the bits of values, also of those without residual, below zero, or behind a gap."""
    bits = retrieval.quality.copy()
    untested = np.isfinite(retrieval.optical_depth) & ~np.isfinite(retrieval.reduced_chi_square)
    untested &= ~retrieval.raised(MultiAngleQuality.INTERPOLATED)
    bits |= np.where(untested, np.int32(MultiAngleQuality.NO_RESIDUAL), np.int32(0))
    unflagged = (bits & ~np.int32(CARE)) == 0
    negative = np.zeros(bits.shape, dtype=np.bool_)
    for name in ("optical_depth", "extinction"):
        error = getattr(retrieval, f"{name}_standard_error")
        negative |= getattr(retrieval, name) < -COMMON.by_noise * error
    depth, error = retrieval.optical_depth, retrieval.optical_depth_standard_error
    negative |= _below_others(depth, error, (bits == 0) & ~negative)
    bits |= np.where(negative, np.int32(MultiAngleQuality.NEGATIVE_OPTICAL_DEPTH), np.int32(0))
    # The layer that ends at a valid altitude may begin in a gap.
    missing = [~np.isfinite(getattr(retrieval, name)) for name in _PER_ALTITUDE]
    gapped = np.any(missing, axis=0) & unflagged
    return bits | np.where(gapped, np.int32(MultiAngleQuality.INTERPOLATED), np.int32(0))


def _below_others(depth: Array, error: Array, good: Booleans) -> Booleans:
    """Return the values below a good one under them, by the error of the difference."""
    below = np.zeros(depth.shape, dtype=np.bool_)
    for k in range(depth.shape[-1]):
        known = (good & ~below)[:, [k]]
        most = COMMON.by_noise * np.hypot(error[:, k:], error[:, [k]])
        below[:, k:] |= known & (depth[:, [k]] - depth[:, k:] > most)
    return below

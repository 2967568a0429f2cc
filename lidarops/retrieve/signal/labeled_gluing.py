"""Lag correction and gluing of an analog and a photon counting channel in xarray."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.signal import gluing
from lidarops.retrieve.signal import lag as _lag
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH, DEAD_TIME_ERROR

Array = npt.NDArray[np.float64]
_Block = npt.NDArray[Any]

LAG_PROFILES: Final = 256
"""Number of profiles, the first of a scene, from which the lag is estimated."""

_PARTS: Final = ("power", "variance", "quality")
_LINE: Final = {"glue_slope": "MHz mV-1", "glue_slope_standard_error": "MHz mV-1"}
_LAG: Final = {"glue_lag": "1", "glue_lag_standard_error": "1"}
_WINDOW: Final = {"glue_bottom": "m", "glue_top": "m"}
_MISSING: Final = np.int32(Quality.INPUT_MISSING)


def range_lag(analog_range: Array, photon_range: Array) -> float:
    """Return the lag of analog behind photon counting in bins, as given by their ranges in m."""
    return float((photon_range[0] - analog_range[0]) / (photon_range[1] - photon_range[0]))


@dataclass(frozen=True, slots=True)
class ChannelLag:
    """Lag of analog behind photon counting."""

    bins: float = 0.0
    standard_error: float = math.nan
    """Bins; NaN where the lag is not estimated."""


NO_LAG: Final = ChannelLag()


def estimate_lag(groups: Iterable[tuple[Array, Array]], *, known: float) -> ChannelLag:
    """Return the lag of analog behind photon counting, estimated from their noise.

    Parameters
    ----------
    groups : iterable of (analog, photon), (time, range) float
        Power of the first `LAG_PROFILES` profiles of a scene, in groups
        (`lidarops.retrieve.signal.lag.profile_groups`).
    known : float
        Bins, where the correlation is not significant
        (`lidarops.retrieve.signal.lag.estimate_lag`).
    """
    estimate = _lag.estimate_lag_of_groups(_same_bins(*group) for group in groups)
    if not estimate.significant:
        return ChannelLag(known)
    return ChannelLag(float(estimate.lag), float(estimate.standard_error))


def _same_bins(analog: Array, photon: Array) -> tuple[Array, Array]:
    bins = min(analog.shape[-1], photon.shape[-1])
    return analog[:, :bins], photon[:, :bins]


def glue(analog: xr.Dataset, photon: xr.Dataset, lag: ChannelLag = NO_LAG) -> xr.Dataset:
    """Return the glued profiles of two channels that record the same light.

    Analog signals are shifted by the lag, the mean of the last tenth of the bins is subtracted
    from both, and each profile is glued by its own line (`lidarops.retrieve.signal.gluing.glue`).
    Photon counting is corrected for dead time before. Its background remains in the result.

    Parameters
    ----------
    analog, photon : xr.Dataset
        ``power``, ``variance``, ``quality`` over (time, range), of the same profiles and bins of
        the same width; may be dask-backed.
    lag : ChannelLag
        Lag of analog behind photon counting (`range_lag`, `estimate_lag`).

    Returns
    -------
    xr.Dataset
        ``power`` (MHz), ``variance`` (MHz2, with the error of the line) and ``quality`` over
        (time, range); ``noise_correlation_length`` of the analog channel over time;
        ``dead_time_error`` (MHz), the change of the power with one standard error of the dead
        time, where the power of photon counting states that; ``glue_lag`` and ``glue_slope`` with
        their standard errors, and the ends of the window, ``glue_bottom`` and ``glue_top``, over
        time. NO_GLUING where there is no line.
    """
    bins = min(analog.sizes["range"], photon.sizes["range"])
    analog, photon = analog.isel(range=slice(bins)), photon.isel(range=slice(bins))
    inputs = [channel[name] for channel in (analog, photon) for name in _PARTS]
    inputs.append(analog[CORRELATION_LENGTH])
    dead_time_error = photon["power"].attrs.get(DEAD_TIME_ERROR)
    settings = {
        "lag": lag.bins,
        "distance": photon["range"].to_numpy().astype(np.float64),
        "dead_time_error": (dead_time_error or 0.0) * 1e6,
    }
    outputs = xr.apply_ufunc(
        _glue,
        *(_whole_profiles(array) for array in inputs),
        input_core_dims=[["range"]] * 6 + [[]],
        output_core_dims=[["range"]] * 4 + [[]] * 4,
        kwargs=settings,
        dask="parallelized",
        output_dtypes=[np.float64, np.float64, np.int32, *[np.float64] * 5],
    )
    units = {"power": "MHz", "variance": "MHz2", "quality": None, "dead_time_error": "MHz"}
    units |= _LINE | _WINDOW
    result = xr.Dataset(dict(zip(units, outputs, strict=True)))
    result = result.assign_coords(range=photon["range"])
    for name, value in zip(_LAG, (lag.bins, lag.standard_error), strict=True):
        result[name] = xr.full_like(result["glue_slope"], value)
    # That of photon counting is less, so that errors of its part become too large.
    result[CORRELATION_LENGTH] = analog[CORRELATION_LENGTH].assign_attrs(units="1")
    for name, unit in {**units, **_LAG}.items():
        result[name].attrs = {"units": unit} if unit else {}
    if dead_time_error is None:
        return result.drop_vars("dead_time_error")
    result["power"].attrs[DEAD_TIME_ERROR] = dead_time_error
    return result


def glue_cells(analog: xr.Dataset, photon: xr.Dataset, glued: xr.Dataset) -> dict[str, Any]:
    """Return ``part_power`` and ``part_variance`` of glued means, by the lines of the means.

    Parameters
    ----------
    analog, photon : xr.Dataset
        From `lidarops.retrieve.signal.labeled_screening.ScreenedAverage`, the lag corrected.
    glued : xr.Dataset
        From `glue`.
    """
    cells_of_parts = photon["part_power"].attrs
    bins = int(cells_of_parts["bins"])
    distance = photon["range"].to_numpy()
    cells = distance[distance > 0.0][bins // 2 :: bins][: photon.sizes["cell"]]
    middle = (0.5 * (glued["glue_bottom"] + glued["glue_top"])).to_numpy()[
        :, np.newaxis, np.newaxis
    ]
    slope = glued["glue_slope"].to_numpy()[:, np.newaxis, np.newaxis]
    near = cells <= middle
    along = ("time", "part", "cell")
    power, variance = (
        np.where(near, analog[name].to_numpy() * slope**exponent, photon[name].to_numpy())
        for name, exponent in (("part_power", 1), ("part_variance", 2))
    )
    # Without a line it is not known which record holds.
    power[~np.isfinite(middle[:, 0, 0])] = np.nan
    return {"part_power": (along, power, cells_of_parts), "part_variance": (along, variance)}


def _whole_profiles(array: xr.DataArray) -> xr.DataArray:
    if "range" not in array.dims:
        return array
    return array.drop_vars("range").chunk(range=-1) if array.chunks else array.drop_vars("range")


def _glue(
    analog: _Block,
    analog_variance: _Block,
    analog_quality: _Block,
    photon: _Block,
    photon_variance: _Block,
    photon_quality: _Block,
    correlation_length: _Block,
    *,
    lag: float,
    distance: npt.NDArray[np.float64],
    dead_time_error: float,
) -> tuple[_Block, ...]:
    # Bins at negative ranges hold no light and are not glued.
    ahead = slice(int(np.searchsorted(distance, 0.0, side="right")), None)
    r = distance[ahead]
    if lag:
        analog, analog_variance = _lag.shift_signal(analog, lag, variance=analog_variance)
        analog_quality = _shifted_quality(analog_quality, lag)
    dark, sky = (
        cubic_and_tail.tail_mean(_unsaturated(power, quality)[..., ahead], r).background
        for power, quality in ((analog, analog_quality), (photon, photon_quality))
    )
    sky_change = sky**2 * dead_time_error
    change = photon**2
    change *= dead_time_error
    change -= sky_change[..., np.newaxis]
    glued = gluing.glue(
        (analog - dark[..., np.newaxis])[..., ahead],
        (photon - sky[..., np.newaxis])[..., ahead],
        r,
        analog_variance=np.nan_to_num(analog_variance[..., ahead]),
        photon_variance=np.nan_to_num(photon_variance[..., ahead]),
        photon_background=np.nan_to_num(sky),
        photon_change=np.nan_to_num(change, copy=False)[..., ahead],
        analog_correlation_length=correlation_length,
    )
    power, variance, change = (np.full(photon.shape, np.nan) for _ in range(3))
    change[..., ahead] = glued.change + sky_change[..., np.newaxis]
    power[..., ahead] = glued.power + sky[..., np.newaxis]
    variance[..., ahead] = glued.variance + glued.systematic_variance
    quality = _quality(glued, analog_quality, photon_quality, distance)
    power[(quality & int(Quality.NO_GLUING | Quality.INPUT_MISSING)) != 0] = np.nan
    line = (glued.slope, glued.slope_standard_error, glued.start, glued.stop)
    return power, variance, quality, change, *line


def _unsaturated(power: _Block, quality: _Block) -> _Block:
    """Return power without bins that were saturated in some profiles of a mean."""
    return np.where((quality & np.int32(Quality.SATURATED)) != 0, np.nan, power)


def _quality(
    glued: gluing.GluedSignal,
    analog: _Block,
    photon: _Block,
    distance: npt.NDArray[np.float64],
) -> _Block:
    """Return the bits of the signal that a bin comes from; in the window, those of both."""
    near = distance <= glued.stop[..., np.newaxis]
    far = distance >= glued.start[..., np.newaxis]
    not_glued = (glued.no_window | glued.poor_fit)[..., np.newaxis]
    bits = np.where(near, analog, 0) | np.where(far, photon, 0)
    bits |= np.where(not_glued, int(Quality.NO_GLUING), 0)
    bits |= np.where(distance <= 0.0, _MISSING, 0)
    return bits.astype(np.int32)


def _shifted_quality(quality: _Block, lag: float) -> _Block:
    """Return the bits of the two bins from which a shifted bin is interpolated."""
    index = np.arange(quality.shape[-1])
    shifted = np.zeros_like(quality)
    for source in (index + int(np.floor(lag)), index + int(np.ceil(lag))):
        inside = (source >= 0) & (source < index.size)
        bits = quality[..., np.clip(source, 0, index.size - 1)]
        shifted |= np.where(inside, bits, _MISSING).astype(quality.dtype)
    return shifted

"""Gluing of analog and photon counting channels over xarray."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.signal import gluing
from lidarops.retrieve.signal import lag as _lag

_Block = npt.NDArray[Any]

LAG_PROFILES: Final = 256
"""Profiles, the first of a scene, from which a lag is estimated."""

_PARTS: Final = ("power", "variance", "quality")
_LINE: Final = {"glue_slope": "MHz mV-1", "glue_slope_standard_error": "MHz mV-1"}
_WINDOW: Final = {"glue_bottom": "m", "glue_top": "m"}
_MISSING: Final = np.int32(Quality.INPUT_MISSING)


def told_lag(analog: xr.Dataset, photon: xr.Dataset) -> float:
    """Return by how many bins analog lies farther than photon counting, as their ranges say."""
    here, there = photon["range"].to_numpy(), analog["range"].to_numpy()
    return float((here[0] - there[0]) / (here[1] - here[0]))


def estimate_lag(analog: xr.Dataset, photon: xr.Dataset) -> float:
    """Return by how many bins analog lies farther than photon counting, as their noise says.

    Parameters
    ----------
    analog, photon : xr.Dataset
        From `lidarops.retrieve.signal.labeled.condition`; the first 256 profiles are computed.

    Returns
    -------
    float
        Bins; what the ranges say where noise shows no common cause
        (`lidarops.retrieve.signal.lag.estimate_lag`).
    """
    bins = min(analog.sizes["range"], photon.sizes["range"])
    some = {"time": slice(LAG_PROFILES), "range": slice(bins)}
    found = _lag.estimate_lag(
        analog["power"].isel(some).to_numpy(), photon["power"].isel(some).to_numpy()
    )
    return float(found.lag) if found.found else told_lag(analog, photon)


def glue(analog: xr.Dataset, photon: xr.Dataset, *, lag: float = 0.0) -> xr.Dataset:
    """Join the profiles of two channels that record the same light.

    Analog signals are moved by the lag, the mean of the last tenth of the bins is subtracted
    from both, and every profile is glued by its own line (`lidarops.retrieve.signal.gluing.glue`). The
    background of photon counting is left in the result.

    Parameters
    ----------
    analog, photon : xr.Dataset
        ``power``, ``variance``, ``quality`` over (time, range), of the same profiles and bins of
        the same width; may be dask-backed.
    lag : float
        Bins by which analog lies farther (`told_lag`, `estimate_lag`).

    Returns
    -------
    xr.Dataset
        ``power`` (MHz), ``variance`` (MHz2, with the error of the line) and ``quality`` over
        (time, range); ``glue_slope`` with its standard error, and the ends of the window,
        ``glue_bottom`` and ``glue_top``, over time. NO_GLUING where there is no line.
    """
    bins = min(analog.sizes["range"], photon.sizes["range"])
    analog, photon = analog.isel(range=slice(bins)), photon.isel(range=slice(bins))
    inputs = [part[name] for part in (analog, photon) for name in _PARTS]
    settings = {
        "lag": lag,
        "distance": photon["range"].to_numpy().astype(np.float64),
    }
    outputs = xr.apply_ufunc(
        _glue,
        *(
            array.drop_vars("range").chunk(range=-1) if array.chunks else array.drop_vars("range")
            for array in inputs
        ),
        input_core_dims=[["range"]] * 6,
        output_core_dims=[["range"]] * 3 + [[]] * 4,
        kwargs=settings,
        dask="parallelized",
        output_dtypes=[np.float64, np.float64, np.int32, *[np.float64] * 4],
    )
    units = dict(zip(_PARTS, ("MHz", "MHz2", None), strict=True)) | _LINE | _WINDOW
    result = xr.Dataset(dict(zip(units, outputs, strict=True)))
    result = result.assign_coords(range=photon["range"])
    for name, unit in units.items():
        result[name].attrs = {"units": unit} if unit else {}
    return result


def _glue(
    analog: _Block,
    analog_variance: _Block,
    analog_quality: _Block,
    photon: _Block,
    photon_variance: _Block,
    photon_quality: _Block,
    *,
    lag: float,
    distance: npt.NDArray[np.float64],
) -> tuple[_Block, ...]:
    # What lies behind the lidar holds no light, and gluing looks for none there.
    ahead = slice(int(np.searchsorted(distance, 0.0, side="right")), None)
    r = distance[ahead]
    if lag:
        analog, analog_variance = _lag.shift_signal(analog, lag, variance=analog_variance)
        analog_quality = _moved(analog_quality, lag)
    dark, sky = (
        cubic_and_tail.tail_mean(power[..., ahead], r).background for power in (analog, photon)
    )
    found = gluing.glue(
        (analog - dark[..., np.newaxis])[..., ahead],
        (photon - sky[..., np.newaxis])[..., ahead],
        r,
        analog_variance=np.nan_to_num(analog_variance[..., ahead]),
        photon_variance=np.nan_to_num(photon_variance[..., ahead]),
        photon_background=np.nan_to_num(sky),
        # Both record the same photoelectrons: a mean of the two has more noise than it seems.
        hand_over="switch",
    )
    power, variance = (np.full(photon.shape, np.nan) for _ in range(2))
    power[..., ahead] = found.power + sky[..., np.newaxis]
    variance[..., ahead] = found.variance + found.systematic_variance
    quality = _quality(found, analog_quality, photon_quality, distance)
    power[(quality & int(Quality.NO_GLUING | Quality.INPUT_MISSING)) != 0] = np.nan
    return (
        power,
        variance,
        quality,
        found.slope,
        found.slope_standard_error,
        found.start,
        found.stop,
    )


def _quality(
    found: gluing.GluedSignal,
    analog: _Block,
    photon: _Block,
    distance: npt.NDArray[np.float64],
) -> _Block:
    """Return the bits of that part of which a bin is made; in the window, of both."""
    near = distance <= found.stop[..., np.newaxis]
    far = distance >= found.start[..., np.newaxis]
    lost = (found.no_window | found.poor_fit)[..., np.newaxis]
    bits = np.where(near, analog, 0) | np.where(far, photon, 0)
    bits |= np.where(lost, int(Quality.NO_GLUING), 0)
    bits |= np.where(distance <= 0.0, _MISSING, 0)
    return bits.astype(np.int32)


def _moved(quality: _Block, lag: float) -> _Block:
    """Return the bits of both bins from which a shifted one is read."""
    index = np.arange(quality.shape[-1])
    moved = np.zeros_like(quality)
    for place in (index + int(np.floor(lag)), index + int(np.ceil(lag))):
        inside = (place >= 0) & (place < index.size)
        taken = quality[..., np.clip(place, 0, index.size - 1)]
        moved |= np.where(inside, taken, _MISSING).astype(quality.dtype)
    return moved

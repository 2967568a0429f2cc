"""Lag correction and gluing of an analog and a photon counting channel in xarray."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.common.arrays import Array, Block
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal import gluing
from lidarops.retrieve.signal import lag as _lag
from lidarops.retrieve.signal.labeled import (
    BASELINE_ERROR,
    CORRELATION_LENGTH,
    DEAD_TIME_ERROR,
    analog_alone,
    baseline_error,
)
from lidarops.retrieve.signal.lag import ChannelLag
from lidarops.retrieve.signal.thresholds import THRESHOLDS

Slope = tuple[float, float]
"""MHz mV-1, and its standard error."""

UNKNOWN_SLOPE: Final[Slope] = (math.nan, math.nan)

LAG_PROFILES: Final = 256
"""Number of profiles, the first of a scene, from which the lag is estimated."""
SLOPE_PROFILES: Final = 64
"""Number of profiles, all over a scene, that give its slope."""

_PARTS: Final = ("power", "variance", "quality")
_LINE: Final = {"glue_slope": "MHz mV-1", "glue_slope_standard_error": "MHz mV-1"}
_LAG: Final = {"glue_lag": "1", "glue_lag_standard_error": "1"}
_WINDOW: Final = {"glue_bottom": "m", "glue_top": "m"}
_MISSING: Final = np.int32(Quality.INPUT_MISSING)
_NEAR: Final = np.int32(Quality.INCOMPLETE_OVERLAP)
_WITHHELD: Final = Quality.INPUT_MISSING | Quality.NO_SIGNAL | Quality.NO_GLUING


def range_lag(analog_range: Array, photon_range: Array) -> float:
    """Return the lag of analog behind photon counting in bins, as given by their ranges in m."""
    return float((photon_range[0] - analog_range[0]) / (photon_range[1] - photon_range[0]))


NO_LAG: Final = ChannelLag()


def scene_slope(parts: Iterable[tuple[xr.Dataset, xr.Dataset]], lag: ChannelLag) -> Slope:
    """Return the slope of the profiles of a scene that can be glued, from some of all, `glue`'s.

    The standard error holds the scatter of the slopes, as by a drift of the gain. NaN without any.
    """
    glued = [glue(*part, lag, UNKNOWN_SLOPE)[[*_LINE]] for part in parts]
    slope, error = (np.concatenate([part[name].to_numpy() for part in glued]) for name in _LINE)
    slope, error = slope[lines := np.isfinite(slope)], error[lines]
    if not slope.size:
        return UNKNOWN_SLOPE
    return float(np.median(slope)), math.hypot(slope.std(), np.median(error))


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
    estimate = _lag.estimate_lag(
        (analog[:, : photon.shape[-1]], photon[:, : analog.shape[-1]]) for analog, photon in groups
    )
    return estimate if estimate.significant else ChannelLag(known)


def glue(
    analog: xr.Dataset, photon: xr.Dataset, lag: ChannelLag = NO_LAG, slope: Slope | None = None
) -> xr.Dataset:
    """Return the glued profiles of two channels that record the same light.

    Analog signals are shifted by the lag, the mean of the last tenth of the bins is subtracted
    from both, and each profile is glued by its own line (`lidarops.retrieve.signal.gluing.glue`).
    Photon counting is corrected for dead time before. Its background remains in the result.

    Without a line, as by day, the record alone serves that shows light in more bins, photon
    counting within `Thresholds.count_rates` (SINGLE_RECORD). So it does where the error of the dead
    time explains a misfit; any other misfit says that one of the records is wrong.

    Parameters
    ----------
    analog, photon : xr.Dataset
        ``power``, ``variance``, ``quality`` over (time, range), of the same profiles and bins of
        the same width.
    lag : ChannelLag
        Lag of analog behind photon counting (`range_lag`, `estimate_lag`).
    slope : (float, float), optional
        Of analog alone, whose background is 0; without a known one it does not serve. None where
        profiles are not compared: 1 mV is then 1 MHz.

    Returns
    -------
    xr.Dataset
        ``power`` (MHz), ``variance`` (MHz2, with the error of the line) and ``quality`` over
        (time, range); ``noise_correlation_length`` of the analog channel over time;
        ``dead_time_error`` (MHz), the change of the power with one standard error of the dead
        time, where the power of photon counting states that; ``baseline_standard_error`` (MHz) of
        the analog part (`lidarops.retrieve.signal.labeled.baseline_error`); ``glue_lag`` and
        ``glue_slope`` with their standard errors, and the ends of the window, ``glue_bottom`` and
        ``glue_top``, over time: both the end of the bins for analog alone, and 0 for photon
        counting alone. NO_GLUING where no record serves.
    """
    bins = min(analog.sizes["range"], photon.sizes["range"])
    analog, photon = analog.isel(range=slice(bins)), photon.isel(range=slice(bins))
    dead_time_error = photon["power"].attrs.get(DEAD_TIME_ERROR)
    records = [tuple(channel[name].to_numpy() for name in _PARTS) for channel in (analog, photon)]
    outputs = _glue(
        records[0],
        records[1],
        analog[CORRELATION_LENGTH].to_numpy(),
        lag=lag.bins,
        distances=[c["range"].to_numpy().astype(np.float64) for c in (analog, photon)],
        dead_time_error=(dead_time_error or 0.0) * 1e6,
        slope=slope,
    )
    units = {"power": "MHz", "variance": "MHz2", "quality": None, "dead_time_error": "MHz"}
    units |= _LINE | _WINDOW
    plane = photon["power"].dims
    variables = {n: (plane[: v.ndim], v) for n, v in zip(units, outputs, strict=True)}
    result = xr.Dataset(variables, coords=photon["power"].coords)
    for name, value in zip(_LAG, (lag.bins, lag.standard_error), strict=True):
        result[name] = xr.full_like(result["glue_slope"], value)
    # That of photon counting is less, so that errors of its part become too large.
    length = analog[CORRELATION_LENGTH].where(result["glue_top"] != 0.0, 1.0)
    result[CORRELATION_LENGTH] = length.assign_attrs(units="1")
    for name, unit in {**units, **_LAG}.items():
        result[name].attrs = {"units": unit} if unit else {}
    baseline = baseline_error(analog.assign_coords(range=photon["range"]))
    if baseline is not None:
        middle = 0.5 * (result["glue_bottom"] + result["glue_top"])
        result[BASELINE_ERROR] = (
            (baseline * result["glue_slope"].fillna(1.0))
            .where(result["range"] <= middle, 0.0)
            .fillna(0.0)
            .transpose(*result["power"].dims)
            .assign_attrs(units="MHz")
        )
    if dead_time_error is None:
        return result.drop_vars("dead_time_error")
    result["power"].attrs[DEAD_TIME_ERROR] = dead_time_error
    return result


def glue_cells(analog: xr.Dataset, photon: xr.Dataset, glued: xr.Dataset) -> dict[str, Any]:
    """Return ``part_power``, ``part_variance`` and ``part_quantum`` of glued means.

    They follow from the lines of the means.

    Parameters
    ----------
    analog, photon : xr.Dataset
        From `lidarops.retrieve.signal.labeled_averaging.ClockAverage` with a screening, the lag
        corrected.
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
    slope = glued["glue_slope"].fillna(1.0).to_numpy()[:, np.newaxis, np.newaxis]
    near = cells <= middle
    along = ("time", "part", "cell")
    power, variance = (
        np.where(near, analog[name].to_numpy() * slope**exponent, photon[name].to_numpy())
        for name, exponent in (("part_power", 1), ("part_variance", 2))
    )
    # Without a line it is not known which record holds.
    power[~np.isfinite(middle[:, 0, 0])] = np.nan
    return {
        "part_power": (along, power, cells_of_parts),
        "part_variance": (along, variance),
        "part_quantum": photon["part_quantum"].where(~analog_alone(glued), 0.0),
    }


def _glue(
    of_analog: tuple[Block, ...],
    of_photon: tuple[Block, ...],
    correlation_length: Block,
    *,
    lag: float,
    distances: Sequence[Array],
    dead_time_error: float,
    slope: Slope | None,
) -> tuple[Block, ...]:
    analog, analog_variance, analog_quality = of_analog
    photon, photon_variance, photon_quality = of_photon
    qualities, distance = (analog_quality, photon_quality), distances[-1]
    # Full overlap is a matter of range, which a lag that the ranges do not state changes.
    full = np.maximum(*map(_last_near, qualities, distances))[..., np.newaxis]
    analog_quality, photon_quality = (quality & ~_NEAR for quality in qualities)
    # Bins at negative ranges hold no light and are not glued.
    ahead = slice(int(np.searchsorted(distance, 0.0, side="right")), None)
    r = distance[ahead]
    if lag:
        analog, analog_variance = _lag.shift_signal(analog, lag, variance=analog_variance)
        analog_quality = _shifted_quality(analog_quality, lag)
    analog, photon = _unsaturated(analog, analog_quality), _unsaturated(photon, photon_quality)
    dark, sky = (
        cubic_and_tail.tail_mean(power[..., ahead], r).background for power in (analog, photon)
    )
    change = photon**2
    change *= dead_time_error
    change -= (sky_change := sky**2 * dead_time_error)[..., np.newaxis]
    x, y = (analog - dark[..., np.newaxis])[..., ahead], (photon - sky[..., np.newaxis])[..., ahead]
    # Without power there is no variance, and without shots it is infinite.
    xv, yv = (np.nan_to_num(v[..., ahead], posinf=0.0) for v in (analog_variance, photon_variance))
    glued = gluing.glue(
        x,
        y,
        r,
        analog_variance=xv,
        photon_variance=yv,
        photon_background=np.nan_to_num(sky),
        photon_change=np.nan_to_num(change[..., ahead]),
        analog_correlation_length=correlation_length,
    )
    used, error = slope or (1.0, 0.0)
    level, of_sky = sky[..., np.newaxis], sky_change[..., np.newaxis]
    by_analog = gluing.lit_bins(x * used, xv * used**2)
    by_photons = gluing.lit_bins(y, yv, THRESHOLDS.count_rates[1] - sky)
    line = ~(glued.no_window | glued.poor_fit)
    alone = ~(line | glued.misfit)
    alone &= np.maximum(by_analog, by_photons) >= COMMON.fewest_bins
    records = line, alone & (by_analog >= by_photons), alone & (by_analog < by_photons)

    def of_records(*values: Block) -> Block:
        """Return those of the line, of analog or of photon counting alone, (..., range)."""
        joined = np.full(photon.shape, np.nan)
        joined[..., ahead] = np.select([r[..., np.newaxis] for r in records], values, np.nan)
        return joined

    power = of_records(glued.power + level, used * x, y + level)
    variance = glued.variance + glued.systematic_variance
    variance = of_records(variance, used**2 * xv + (error * x) ** 2, yv)
    change = of_records(glued.change + of_sky, np.zeros(x.shape), change[..., ahead] + of_sky)
    end = np.full(sky.shape, 1.5 * distance[-1] - 0.5 * distance[-2])
    window = [np.select(records, (e, end, 0.0 * end), np.nan) for e in (glued.start, glued.stop)]
    bottom, top = (edge[..., np.newaxis] for edge in window)
    quality = np.where(distance <= top, analog_quality, 0)
    quality |= np.where(distance >= bottom, photon_quality, 0)
    quality |= np.where(alone, int(Quality.SINGLE_RECORD), 0)[..., np.newaxis]
    quality |= np.where(alone | line, 0, int(Quality.NO_GLUING))[..., np.newaxis]
    quality |= np.where(distance <= 0.0, _MISSING, 0) | np.where(distance <= full, _NEAR, 0)
    # One record alone may be off, or weaker than its noise.
    unlit = analog_quality & photon_quality & np.int32(Quality.NO_SIGNAL)
    quality[unlit.any(axis=-1)] = np.int32(Quality.NO_SIGNAL)
    power[(quality & int(_WITHHELD)) != 0] = np.nan
    variance[np.isnan(power)] = np.nan
    own = zip((glued.slope, glued.slope_standard_error), slope or UNKNOWN_SLOPE, strict=True)
    slopes = (np.select(records[:2], values, np.nan) for values in own)
    return power, variance, quality.astype(np.int32), change, *slopes, *window


def _last_near(quality: Block, distance: Array) -> Block:
    """Return the range of the last bin before full overlap, m, (...); minus infinity for none."""
    farthest: Block = np.where((quality & _NEAR) != 0, distance, -np.inf).max(axis=-1)
    return farthest


def _unsaturated(power: Block, quality: Block) -> Block:
    """Return power without bins that were saturated in some profiles of a mean."""
    return np.where((quality & np.int32(Quality.SATURATED)) != 0, np.nan, power)


def _shifted_quality(quality: Block, lag: float) -> Block:
    """Return the bits of the two bins from which a shifted bin is interpolated."""
    index = np.arange(quality.shape[-1])
    shifted = np.zeros_like(quality)
    for source in (index + int(np.floor(lag)), index + int(np.ceil(lag))):
        inside = (source >= 0) & (source < index.size)
        bits = quality[..., np.clip(source, 0, index.size - 1)]
        shifted |= np.where(inside, bits, _MISSING).astype(quality.dtype)
    return shifted

"""Counts of one channel to signals in xarray: `counts_to_signal` applied to all profiles.

`condition` corrects for dead time (photon counting) or subtracts the dark signal (analog), and
estimates the noise. `correct_for_range` then subtracts the background and corrects for range.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.constants import DEAD_TIME_UNCERTAINTY, LICEL_RANGE_PER_MICROSECOND
from lidarops.flags import Quality
from lidarops.records import DetectionMode
from lidarops.retrieve.background.estimate import Background, from_cubic, from_tail
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Block
from lidarops.retrieve.signal import counts_to_signal
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation
from lidarops.retrieve.signal.thresholds import THRESHOLDS

DEAD_TIME_ERROR: Final = "dead_time_standard_error"
"""Attribute of the power of photon counting, s."""
BASELINE_ERROR: Final = "baseline_standard_error"
"""Attribute of the power of analog, mV and the share of the largest power."""

SKY: Final = "sky"
"""Name of the background as bins before the pulse give it, and its variance, (time, 2)."""
CORRELATION_LENGTH: Final = "noise_correlation_length"
"""Name of the integral correlation length of noise along range, bins."""


class BackgroundMethod(StrEnum):
    """Methods for the background of the product ``signal``."""

    TAIL_MEAN = "tail_mean"
    CUBIC = "cubic"
    BEFORE_PULSE = "before_pulse"


_BACKGROUNDS: Final[dict[BackgroundMethod, tuple[Callable[..., Background], str]]] = {
    BackgroundMethod.TAIL_MEAN: (from_tail, "mean of the bins"),
    BackgroundMethod.CUBIC: (from_cubic, "cubic of a homogeneous section"),
    BackgroundMethod.BEFORE_PULSE: (from_tail, "mean of the bins before the pulse,"),
}
"""Function of each method, and the words of ``steps``."""


def condition(
    archive: xr.Dataset,
    channel: str,
    *,
    dead_time: float | None = None,
    dead_time_uncertainty: float = DEAD_TIME_UNCERTAINTY,
    noise_variance: float | None = None,
    baseline_uncertainty: float | None = None,
    dark: DarkSignals | None = None,
    range_offset: float = 0.0,
    full_overlap_range: float = 0.0,
) -> xr.Dataset:
    """Return the signal of one channel from its raw counts, with noise variance and quality.

    Parameters
    ----------
    archive : xr.Dataset
        From `lidarops.open_archive(..., mask_and_scale=False)`.
    channel : str
        Name of the channel.
    dead_time : float, optional
        s; photon counting only, corrected here.
    dead_time_uncertainty : float
        Relative standard error of the dead time; photon counting only.
    noise_variance : float, optional
        mV^2; analog only.
    baseline_uncertainty : float, optional
        mV, standard error of the baseline, in place of the default or of what dark files show;
        analog only.
    dark : DarkSignals, optional
        From `read_dark`; analog only.
    range_offset : float
        m, added to the range of every bin.
    full_overlap_range : float
        m; nearer bins are flagged.

    Returns
    -------
    xr.Dataset
        ``power`` (mV or MHz), ``variance`` and ``quality`` over (time, range), and
        ``noise_correlation_length`` (bins) over time, in memory. The attribute
        ``dead_time_standard_error`` (s) of the power of photon counting, and
        ``baseline_standard_error`` of analog, are the inputs of `systematic_changes`.
    """
    counts, shots = archive[channel], archive[f"{channel}_shots"].to_numpy()
    grid = str(counts.dims[-1])
    distance = counts[grid].to_numpy()
    if range_offset:
        distance = distance + range_offset
    along = distance.astype(np.float64)
    unit = "MHz" if counts.attrs["detection_mode"] == DetectionMode.PHOTON else "mV"
    if unit == "MHz":
        signal = counts_to_signal.photon_signal(
            counts.to_numpy(),
            shots,
            along,
            bin_width=counts.attrs["bin_width"],
            dead_time=dead_time,
            dead_time_uncertainty=dead_time_uncertainty,
            full_overlap_range=full_overlap_range,
        )
        error = counts_to_signal.dead_time_standard_error(dead_time, dead_time_uncertainty)
        attributes: dict[str, Any] = {DEAD_TIME_ERROR: error}
    else:
        given = (None, None) if dark is None else dark.at(archive["time"].to_numpy())
        signal = counts_to_signal.analog_signal(
            counts.to_numpy(),
            shots,
            along,
            adc_bits=counts.attrs["adc_bits"],
            input_range=archive[f"{channel}_input_range"].to_numpy(),
            dark=given[0],
            dark_variance=given[1],
            noise_variance=noise_variance,
            full_overlap_range=full_overlap_range,
        )
        attributes = {BASELINE_ERROR: _baseline(baseline_uncertainty, dark)}
    dims = (*counts.dims[:-1], "range")
    return xr.Dataset(
        {
            "power": (dims, signal.power, {"units": unit, **attributes}),
            "variance": (dims, signal.variance, {"units": f"{unit}2"}),
            "quality": (dims, signal.quality),
            CORRELATION_LENGTH: (dims[:-1], signal.correlation_length, {"units": "1"}),
        },
        coords={
            **{name: array for name, array in counts.coords.items() if name != grid},
            "range": ("range", distance, counts[grid].attrs),
        },
    )


def sky_before(profiles: xr.Dataset) -> npt.NDArray[np.float64]:
    """Return mean power and its variance, (time, 2), of bins before the pulse from `condition`."""
    power, distance = profiles["power"], profiles["range"].to_numpy().astype(np.float64)
    noise = actual_noise(profiles)
    of_means = noise.variance * noise.correlation_length[..., np.newaxis]
    sky = from_tail(power.to_numpy(), distance, of_means, (distance[0], distance[-1]))
    return np.stack([sky.background, sky.standard_error**2], axis=-1)


def background_before(profiles: xr.Dataset) -> Background | None:
    """Return the background that bins before the pulse gave; None of profiles without it."""
    if SKY not in profiles:
        return None
    value, variance = profiles[SKY].to_numpy().T
    none, no = np.zeros(value.shape), np.zeros(value.shape, dtype=np.bool_)
    missing = np.where(np.isnan(value), np.int32(Quality.INPUT_MISSING), np.int32(0))
    return Background(value, np.sqrt(variance), none, none, no, no, missing)


def _baseline(given: float | None, dark: DarkSignals | None) -> tuple[float, float]:
    """Return the standard error of the baseline, mV, and its share of the largest power.

    Dark files show that of the electronics, but no undershoot after light.
    """
    if given is not None:
        return given, 0.0
    shown = np.nan if dark is None else dark.drift
    return (shown if np.isfinite(shown) else THRESHOLDS.baseline), THRESHOLDS.baseline_share


def baseline_error(profiles: xr.Dataset, *, decaying: bool = False) -> xr.DataArray | None:
    """Return the standard error of the baseline of analog signals.

    A baseline is a voltage without light that varies slowly with range, so that the background is
    not that of nearer bins. Its shape is not known: bins in front of the far range are taken to be
    off together, which changes results more than a baseline that decays, and by the undershoot
    after the largest power.

    Parameters
    ----------
    profiles : xr.Dataset
        From `condition`, `lidarops.retrieve.signal.labeled_gluing.glue`, or means of these.
    decaying : bool
        Whether all of it decays as undershoot does, for what does not depend on a constant; not of
        glued profiles.

    Returns
    -------
    xr.DataArray or None
        In the unit of the power, over its dimensions; of glued profiles 0 where they are photon
        counting. None for photon counting.
    """
    power = profiles["power"]
    if BASELINE_ERROR in profiles:
        return profiles[BASELINE_ERROR]
    if BASELINE_ERROR not in power.attrs:
        return None
    fixed, share = power.attrs[BASELINE_ERROR]
    decay = np.exp(-np.maximum(profiles["range"], 0.0) / THRESHOLDS.baseline_decay)
    undershoot = share * (power.max("range") - power.min("range")).fillna(0.0)
    error: xr.DataArray = np.hypot(fixed * (decay if decaying else 1.0), undershoot * decay)
    return error


def systematic_changes(profiles: xr.Dataset, background: xr.DataArray) -> dict[str, xr.DataArray]:
    r"""Return the changes of signals without background with one standard error of each cause.

    Power :math:`P` and background :math:`P^*` of photon counting change together with the dead
    time, by :math:`(P^2 - P^{*2}) \sigma_\tau`. All bins and profiles share this error.

    Parameters
    ----------
    profiles : xr.Dataset
        From `condition`, `lidarops.retrieve.signal.labeled_gluing.glue`, or means of these.
    background : xr.DataArray, (...)
        In the unit of the power.

    Returns
    -------
    dict of str to xr.DataArray
        In the unit of the power, over its dimensions: ``dead_time`` of photon counting,
        ``baseline`` (`baseline_error`) of analog, both of glued signals.
    """
    changes, of_power = {}, dead_time_change(profiles)
    if of_power is not None:
        changes["dead_time"] = profiles["power"].copy(data=of_power[0])
        # In place, because these are the largest arrays of a chunk.
        changes["dead_time"] -= background**2 * of_power[1]
    baseline = baseline_error(profiles)
    return changes if baseline is None else {**changes, "baseline": baseline}


def dead_time_change(profiles: xr.Dataset) -> tuple[Block, float] | None:
    """Return the change of power with one standard error of the dead time, and a factor.

    That of a background is the factor times its square; None for analog. The array is a new one.
    """
    error = profiles["power"].attrs.get(DEAD_TIME_ERROR)
    if error is None:
        return None
    per_square = error * 1e6
    if "dead_time_error" in profiles:
        return profiles["dead_time_error"].to_numpy().copy(), per_square
    change = profiles["power"].to_numpy() ** 2
    change *= per_square
    return change, per_square


def correct_for_range(
    conditioned: xr.Dataset,
    background_range: tuple[float, float],
    background_method: str = "tail_mean",
) -> xr.Dataset:
    r"""Return signals minus their background, multiplied by the square of range.

    .. math:: X = (P - P^*) R^2, \qquad \mathrm{var}(X) = (v_P + v_{P^*}) R^4

    Parameters
    ----------
    conditioned : xr.Dataset
        From `condition`.
    background_range : (float, float)
        m; the bins whose mean is the background, or the homogeneous section of the cubic.
    background_method : {"tail_mean", "cubic", "before_pulse"}
        See `lidarops.retrieve.background.estimate`.

    Returns
    -------
    xr.Dataset
        ``signal``, ``signal_standard_error`` (mV m2 or MHz m2, float32) and ``quality_flag``
        over (time, range), ``background``, ``background_standard_error`` and
        ``noise_correlation_length`` over time, NaN where it is not known; the attribute ``steps``
        states the method of the background. ``signal_dead_time_error`` and
        ``signal_baseline_error`` over (time, range) are the changes of the signal with one standard
        error of these (`systematic_changes`), which are not part of ``signal_standard_error``.
        INPUT_MISSING without a background, or NO_REAL_SOLUTION where the cubic has no admissible
        root. BACKGROUND_UNCERTAIN where the background may contain signal.

        The noise of the far half of each profile, and its correlation between bins, raise the
        standard errors where it exceeds the stated variance
        (`lidarops.retrieve.signal.noise_correlation`); those of glued channels from the middle of
        the gluing window on.

    Raises
    ------
    RetrievalInputError
        If no bin lies in the range of the background, or the method is another.
    """
    method = inputs.choice(background_method, BackgroundMethod, "background_method")
    noise = actual_noise(conditioned)
    power, length = conditioned["power"].to_numpy(), noise.correlation_length
    distance = conditioned["range"].to_numpy().astype(np.float64)
    of_means = noise.variance * length[..., np.newaxis]
    sky = background_before(conditioned) if method is BackgroundMethod.BEFORE_PULSE else None
    sky = sky or _BACKGROUNDS[method][0](power, distance, of_means, background_range)
    level, level_error = sky.background[..., np.newaxis], sky.standard_error[..., np.newaxis]
    square = distance**2
    # Negative values are kept: clipping would bias every mean.
    signal = ((power - level) * square).astype(np.float32)
    error = np.sqrt(((noise.variance + level_error**2) * (square * square)).astype(np.float32))
    plane = conditioned["power"].dims
    result = xr.Dataset(
        {
            "signal": (plane, signal),
            "signal_standard_error": (plane, error),
            "quality_flag": (
                plane,
                conditioned["quality"].to_numpy() | sky.quality[..., np.newaxis],
            ),
            "background": (plane[:-1], sky.background),
            "background_standard_error": (plane[:-1], sky.standard_error),
            CORRELATION_LENGTH: (
                plane[:-1],
                np.where(noise.known | (length > 1.0), length, np.nan),
            ),
        },
        coords=conditioned.coords,
        attrs={"steps": background_words(method, background_range)},
    )
    along = conditioned["range"].astype(np.float64) ** 2
    changes = systematic_changes(conditioned, result["background"])
    errors = {f"signal_{cause}_error": change * along for cause, change in changes.items()}
    result = result.assign({name: error.astype(np.float32) for name, error in errors.items()})
    return without_analog_background(result, conditioned)


class ActualNoise(NamedTuple):
    """Noise of profiles as the far half of each shows it.

    See `lidarops.retrieve.signal.noise_correlation`.
    """

    variance: Block
    """(..., range): raised where the noise exceeds it; of glued channels from the middle of the
    gluing window on, because before it the noise is that of the analog channel."""
    excess: Block
    """(...), the factor."""
    correlation_length: Block
    """(...), bins; of glued channels at least that of the analog part. 1 where not `known`."""
    known: Block
    """(...), False where too few bins are complete to tell excess and correlation."""


def actual_noise(profiles: xr.Dataset) -> ActualNoise:
    """Return the noise of profiles, in memory.

    Parameters
    ----------
    profiles : xr.Dataset
        ``power`` and ``variance`` over (time, range), of all bins of a channel or their means.
    """
    power, variance = profiles["power"].to_numpy(), profiles["variance"].to_numpy()
    distance = profiles["range"].to_numpy().astype(np.float64)
    rows, leading = (-1, distance.size), power.shape[:-1]
    glued_until, stated = np.full(leading, -np.inf), np.ones(leading)
    if "glue_top" in profiles:
        stated = profiles[CORRELATION_LENGTH].to_numpy()
        bottom, top = profiles["glue_bottom"].to_numpy(), profiles["glue_top"].to_numpy()
        # Of a single record, the far half tells the noise of all.
        glued_until = np.where(bottom != top, 0.5 * (bottom + top), -np.inf)
    noise = estimate_noise_correlation(power.reshape(rows), variance.reshape(rows))
    excess = noise.excess.reshape(leading)
    beyond = distance > glued_until[..., np.newaxis]
    raised = variance * np.where(beyond, excess[..., np.newaxis], 1.0)
    length = np.maximum(noise.length.reshape(leading), stated)
    return ActualNoise(raised, excess, length, noise.known.reshape(leading))


def counts_per_power(
    profiles: xr.Dataset, shots: npt.ArrayLike, *, glued: bool = False
) -> Block | None:
    """Return the counts of a bin per MHz of power, (time,); None but for photon counting.

    Parameters
    ----------
    profiles : xr.Dataset
        From `condition`, or means of these.
    shots : (time,) int
        Number of shots of each profile; without a shot, one is taken.
    glued : bool
        Whether glued profiles have counts too, those of their far range. Their near bins, with the
        noise of analog detection, then seem to hold more counts than they do.
    """
    if DEAD_TIME_ERROR not in profiles["power"].attrs or ("glue_top" in profiles and not glued):
        return None
    width = float(np.median(np.diff(profiles["range"].to_numpy().astype(np.float64))))
    counts = np.asarray(np.maximum(shots, 1) * (width / LICEL_RANGE_PER_MICROSECOND))
    # A count is nothing of analog detection.
    return np.where(analog_alone(profiles), np.inf, counts)


def analog_alone(profiles: xr.Dataset) -> xr.DataArray:
    """Return which profiles of a glued channel are analog detection alone, (time,).

    They are without background.
    """
    if "glue_top" not in profiles:
        return xr.zeros_like(profiles["power"].isel(range=0, drop=True), dtype=bool)
    top = profiles["glue_top"]
    return (top > 0.0) & (top == profiles["glue_bottom"])


def without_analog_background(product: xr.Dataset, profiles: xr.Dataset) -> xr.Dataset:
    """Return a product without the backgrounds of glued profiles that are `analog_alone`."""
    known = ~analog_alone(profiles)
    names = ("background", "background_standard_error")
    return product.assign({name: product[name].where(known) for name in names})


def background_words(method: str, background_range: tuple[float, float]) -> str:
    """Return in words how the background is estimated, from a range in m."""
    start, stop = background_range
    return f"background: {_BACKGROUNDS[BackgroundMethod(method)][1]} from {start:g} to {stop:g} m"


def read_dark(archive: xr.Dataset, channel: str, *, method: str) -> DarkSignals:
    """Read the dark files of one analog channel.

    Parameters
    ----------
    archive : xr.Dataset
        The dark files, from `lidarops.open_archive(..., mask_and_scale=False)`.
    channel : str
        Name of the channel.
    method : {"nearest", "interpolated"}
        See `lidarops.retrieve.signal.dark.DarkSignals`.

    Returns
    -------
    DarkSignals
        The means of their sessions, in memory.
    """
    power = np.concatenate(
        [
            condition(
                archive.isel(time=slice(first, first + _DARK_TOGETHER)), channel, noise_variance=0.0
            )["power"].to_numpy()
            for first in range(0, archive.sizes["time"], _DARK_TOGETHER)
        ]
    )
    return DarkSignals(power, archive["time"].to_numpy(), method=method)


_DARK_TOGETHER: Final = 32
"""Dark files that are converted together, which bounds the memory of the conversion."""

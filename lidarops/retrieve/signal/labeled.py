"""Counts of one channel to signals in xarray: `counts_to_signal` applied to all profiles.

`condition` corrects for dead time (photon counting) or subtracts the dark signal (analog), and
estimates the noise. `correct_for_range` then subtracts the background and corrects for range.
`range_corrected_signals` does both in one pass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.records import DetectionMode
from lidarops.retrieve.background.estimate import Background, from_cubic, from_tail
from lidarops.retrieve.common import inputs
from lidarops.retrieve.signal import counts_to_signal
from lidarops.retrieve.signal.counts_to_signal import Signal
from lidarops.retrieve.signal.dark import DarkProfile, DarkSessions

_Block = npt.NDArray[Any]

_SIGNAL_NAMES = ("power", "variance", "quality")
_SIGNAL_DTYPES: Final = (np.float64, np.float64, np.int32)
_RANGE_CORRECTED_DTYPES: Final = (np.float32, np.float32, np.int32, np.float64, np.float64)
_PROFILES_IN_CACHE: Final = 64
"""Profiles processed together; their arrays fit the processor cache."""


class BackgroundMethod(StrEnum):
    """Methods for the background of the product ``signal``."""

    TAIL_MEAN = "tail_mean"
    CUBIC = "cubic"


_BACKGROUNDS: Final[dict[BackgroundMethod, tuple[Callable[..., Background], str]]] = {
    BackgroundMethod.TAIL_MEAN: (from_tail, "mean of the bins"),
    BackgroundMethod.CUBIC: (from_cubic, "cubic of a homogeneous section"),
}
"""Function of each method, and the words of ``steps``."""


def condition(
    archive: xr.Dataset,
    channel: str,
    *,
    dead_time: float | None = None,
    noise_variance: float | None = None,
    dark: DarkSignals | None = None,
    range_offset: float = 0.0,
    full_overlap_range: float = 0.0,
) -> xr.Dataset:
    """Return the signal of one channel from its raw counts, with noise variance and quality.

    Parameters
    ----------
    archive : xr.Dataset
        From `lidarops.open_archive(..., mask_and_scale=False)`; may be dask-backed.
    channel : str
        Name of the channel.
    dead_time : float, optional
        s; photon counting only, corrected here.
    noise_variance : float, optional
        mV^2; analog only.
    dark : Dark, optional
        From `read_dark`; analog only.
    range_offset : float
        m, added to the range of every bin.
    full_overlap_range : float
        m; nearer bins are flagged.

    Returns
    -------
    xr.Dataset
        ``power`` (mV or MHz), ``variance`` and ``quality`` over (time, range), as lazy as the
        input.
    """
    source = _Source(
        archive,
        channel,
        dead_time=dead_time,
        noise_variance=noise_variance,
        dark=dark,
        range_offset=range_offset,
        full_overlap_range=full_overlap_range,
    )
    arrays = source.mapped(_conditioned, ranged=3, plain=0, dtypes=_SIGNAL_DTYPES)
    # All parts have the same coordinates; passing them avoids a comparison.
    variables = {name: array.variable for name, array in zip(_SIGNAL_NAMES, arrays, strict=True)}
    result = xr.Dataset(variables, coords=arrays[0].coords)
    result["power"].attrs = {"units": source.unit}
    result["variance"].attrs = {"units": f"{source.unit}2"}
    result["range"].attrs = source.inputs[0]["range"].attrs
    return result


def range_corrected_signals(
    archive: xr.Dataset,
    channel: str,
    *,
    background_range: tuple[float, float],
    background_method: str = "tail_mean",
    **settings: Any,
) -> xr.Dataset:
    """Return range-corrected signals without background of one channel from its raw counts.

    Equal to `condition` and then `correct_for_range`, to the last bit, in one pass over the
    counts.

    Parameters
    ----------
    background_range, background_method
        As in `correct_for_range`.
    archive, channel, **settings
        As in `condition`.

    Returns
    -------
    xr.Dataset
        As from `correct_for_range`.
    """
    source = _Source(archive, channel, **settings)
    method = inputs.choice(background_method, BackgroundMethod, "background_method")
    arrays = source.mapped(
        _signals,
        ranged=3,
        plain=2,
        dtypes=_RANGE_CORRECTED_DTYPES,
        background_range=background_range,
        background_method=method,
    )
    return _named(arrays, method, background_range)


def correct_for_range(
    conditioned: xr.Dataset,
    background_range: tuple[float, float],
    background_method: str = "tail_mean",
) -> xr.Dataset:
    """Return signals minus their background, multiplied by the square of range.

    Parameters
    ----------
    conditioned : xr.Dataset
        From `condition`.
    background_range : (float, float)
        m; the bins whose mean is the background, or the homogeneous section of the cubic.
    background_method : {"tail_mean", "cubic"}
        See `lidarops.retrieve.background.estimate`.

    Returns
    -------
    xr.Dataset
        ``signal``, ``signal_standard_error`` (mV m2 or MHz m2, float32) and ``quality_flag``
        over (time, range), ``background`` and ``background_standard_error`` over time; the
        attribute ``steps`` states the method of the background.
        INPUT_MISSING without a background, or NO_REAL_SOLUTION where the cubic has no admissible
        root. BACKGROUND_UNCERTAIN where the background may contain signal.

    Raises
    ------
    RetrievalInputError
        If no bin lies in the range of the background, or the method is another.
    """
    method = inputs.choice(background_method, BackgroundMethod, "background_method")
    arrays = xr.apply_ufunc(
        _corrected,
        *(conditioned[name] for name in _SIGNAL_NAMES),
        input_core_dims=[["range"]] * 3,
        output_core_dims=[["range"]] * 3 + [[]] * 2,
        kwargs={
            "range": conditioned["range"].to_numpy().astype(np.float64),
            "background_range": background_range,
            "background_method": method,
        },
        dask="parallelized",
        output_dtypes=list(_RANGE_CORRECTED_DTYPES),
    )
    return _named(arrays, method, background_range)


def channel_unit(archive: xr.Dataset, channel: str) -> str:
    """Return the unit of the power of a channel: MHz for photon counting, mV for analog."""
    return "MHz" if archive[channel].attrs["detection_mode"] == DetectionMode.PHOTON else "mV"


def _named(
    arrays: Sequence[xr.DataArray], method: BackgroundMethod, background_range: tuple[float, float]
) -> xr.Dataset:
    names = ("signal", "signal_standard_error", "quality_flag")
    along_time = ("background", "background_standard_error")
    words = background_words(method, background_range)
    return xr.Dataset(dict(zip((*names, *along_time), arrays, strict=True)), attrs={"steps": words})


def background_words(method: str, background_range: tuple[float, float]) -> str:
    """Return in words how the background is estimated, from a range in m."""
    start, stop = background_range
    return f"background: {_BACKGROUNDS[BackgroundMethod(method)][1]} from {start:g} to {stop:g} m"


class _Source:
    """The counts of one channel, and the settings of their conversion to a signal."""

    def __init__(
        self,
        archive: xr.Dataset,
        channel: str,
        *,
        dead_time: float | None = None,
        noise_variance: float | None = None,
        dark: DarkSignals | None = None,
        range_offset: float = 0.0,
        full_overlap_range: float = 0.0,
    ) -> None:
        counts = archive[channel]
        grid = str(counts.dims[-1])
        if grid != "range":
            counts = counts.rename({grid: "range"})
        if range_offset:
            counts = counts.assign_coords(
                range=counts["range"].copy(data=counts["range"].to_numpy() + range_offset)
            )
        self.settings: dict[str, Any] = {
            "range": counts["range"].to_numpy().astype(np.float64),
            "full_overlap_range": full_overlap_range,
        }
        self.inputs = [counts, archive[f"{channel}_shots"]]
        self.unit = channel_unit(archive, channel)
        self.photon = self.unit == "MHz"
        if self.photon:
            self.settings |= {"bin_width": counts.attrs["bin_width"], "dead_time": dead_time}
            return
        self.inputs.append(archive[f"{channel}_input_range"])
        self.settings |= {"adc_bits": counts.attrs["adc_bits"], "noise_variance": noise_variance}
        if dark is not None:
            self.inputs.append(archive["time"].astype(np.int64).drop_vars(archive["time"].coords))
            self.settings["dark"] = dark

    def mapped(
        self,
        function: Callable[..., tuple[_Block, ...]],
        *,
        ranged: int,
        plain: int,
        dtypes: Sequence[type[np.generic]],
        **settings: Any,
    ) -> tuple[xr.DataArray, ...]:
        """Apply a function that returns `ranged` arrays over range and `plain` without range."""
        outputs: tuple[xr.DataArray, ...] = xr.apply_ufunc(
            function,
            *self.inputs,
            input_core_dims=[["range"]] + [[]] * (len(self.inputs) - 1),
            output_core_dims=[["range"]] * ranged + [[]] * plain,
            kwargs={"photon": self.photon, **self.settings, **settings},
            dask="parallelized",
            output_dtypes=list(dtypes),
        )
        return outputs


@dataclass(frozen=True, slots=True)
class DarkSignals:
    """The dark files of one analog channel, and the method that gives dark signals at times."""

    sessions: DarkSessions
    """mV."""
    method: str

    def at(self, times: npt.NDArray[np.datetime64]) -> DarkProfile:
        """Return dark signal and variance at times."""
        return self.sessions.at(times, method=self.method)

    def variance(self, times: npt.NDArray[np.datetime64]) -> npt.NDArray[np.float64]:
        """Return the variance of the dark signal at times, (time, range), mV2."""
        return self.at(times).variance


def read_dark(archive: xr.Dataset, channel: str, *, method: str) -> DarkSignals:
    """Read the dark files of one analog channel.

    Parameters
    ----------
    archive : xr.Dataset
        The dark files, from `lidarops.open_archive(..., mask_and_scale=False)`.
    channel : str
        Name of the channel.
    method : {"nearest", "interpolated"}
        See `lidarops.retrieve.signal.dark.dark_profile`.

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
    return DarkSignals(DarkSessions(power, archive["time"].to_numpy()), method)


_DARK_TOGETHER: Final = 32
"""Dark files that are converted together, which bounds the memory of the conversion."""


def _conditioned(*inputs: _Block, photon: bool, **settings: Any) -> tuple[_Block, _Block, _Block]:
    result = (counts_to_signal.photon_signal if photon else _analog)(*inputs, **settings)
    return result.power, result.variance, result.quality


def _analog(
    counts: _Block,
    shots: _Block,
    input_range: _Block,
    times: _Block | None = None,
    *,
    dark: DarkSignals | None = None,
    **settings: Any,
) -> Signal:
    if dark is not None and times is not None:
        at_times = dark.at(times.astype("datetime64[ns]"))
        settings |= {"dark": at_times.dark, "dark_variance": at_times.variance}
    return counts_to_signal.analog_signal(counts, shots, input_range=input_range, **settings)


def _corrected(
    power: _Block,
    variance: _Block,
    quality: _Block,
    *,
    range: _Block,  # noqa: A002
    background_range: tuple[float, float],
    background_method: BackgroundMethod,
) -> tuple[_Block, ...]:
    sky = _BACKGROUNDS[background_method][0](power, range, variance, background_range)
    result = counts_to_signal.range_corrected(
        Signal(power, variance, np.empty(0, np.int32)),
        range,
        background=sky.background,
        background_variance=sky.standard_error**2,
        dtype=np.float32,
    )
    # Noise is far above the precision of float32, which halves the memory of a day of profiles.
    return (
        result.power,
        np.sqrt(result.variance, out=result.variance),
        quality | sky.quality[..., np.newaxis],
        sky.background,
        sky.standard_error,
    )


def _signals(
    counts: _Block,
    *other_inputs: _Block,
    range: _Block,  # noqa: A002
    background_range: tuple[float, float],
    background_method: BackgroundMethod,
    **settings: Any,
) -> tuple[_Block, ...]:
    chunks = [
        _corrected(
            *_conditioned(
                counts[rows], *(array[rows] for array in other_inputs), range=range, **settings
            ),
            range=range,
            background_range=background_range,
            background_method=background_method,
        )
        for first in np.arange(0, max(len(counts), 1), _PROFILES_IN_CACHE)
        for rows in [slice(first, first + _PROFILES_IN_CACHE)]
    ]
    return tuple(np.concatenate(pieces) for pieces in zip(*chunks, strict=True))

"""The signal chain over xarray: `lidarops.retrieve.signal` mapped along time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.records import DetectionMode
from lidarops.retrieve import signal
from lidarops.retrieve.dark import DarkProfile
from lidarops.retrieve.dark import profile as dark_profile
from lidarops.retrieve.signal import Signal

_PARTS = ("power", "variance", "quality")
_DTYPES = [np.dtype(np.float64), np.dtype(np.float64), np.dtype(np.int32)]


def condition(
    archive: xr.Dataset,
    channel: str,
    *,
    dead_time: float | None = None,
    noise_variance: float | None = None,
    dark: Dark | None = None,
    range_offset: float = 0.0,
    full_overlap_range: float = 0.0,
) -> xr.Dataset:
    """Turn the raw counts of one channel into a signal with known noise.

    Parameters
    ----------
    archive : xr.Dataset
        As `lidarops.open_archive(..., mask_and_scale=False)` gives it; may be dask-backed.
    channel : str
        Name of the channel.
    dead_time : float, optional
        s; photon counting only.
    noise_variance : float, optional
        mV^2; analog only.
    dark : Dark, optional
        From `dark_of`; analog only.
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
    counts = archive[channel]
    grid = str(counts.dims[-1])
    if grid != "range":
        counts = counts.rename({grid: "range"})
    counts = counts.assign_coords(
        range=counts["range"].copy(data=counts["range"].to_numpy() + range_offset)
    )
    settings: dict[str, Any] = {
        "range": counts["range"].to_numpy().astype(np.float64),
        "full_overlap_range": full_overlap_range,
    }
    inputs = [counts, archive[f"{channel}_shots"]]
    photon = counts.attrs["detection_mode"] == DetectionMode.PHOTON
    if photon:
        settings |= {"bin_width": counts.attrs["bin_width"], "dead_time": dead_time}
    else:
        inputs.append(archive[f"{channel}_input_range"])
        settings |= {"adc_bits": counts.attrs["adc_bits"], "noise_variance": noise_variance}
        if dark is not None:
            inputs.append(archive["time"].astype(np.int64).drop_vars(archive["time"].coords))
            settings["dark"] = dark
    parts = xr.apply_ufunc(
        _photon if photon else _analog,
        *inputs,
        input_core_dims=[["range"]] + [[]] * (len(inputs) - 1),
        output_core_dims=[["range"]] * 3,
        kwargs=settings,
        dask="parallelized",
        output_dtypes=_DTYPES,
    )
    result = xr.Dataset(dict(zip(_PARTS, parts, strict=True)))
    unit = "MHz" if photon else "mV"
    result["power"].attrs = {"units": unit}
    result["variance"].attrs = {"units": f"{unit}2"}
    result["range"].attrs = counts["range"].attrs
    return result


@dataclass(frozen=True, slots=True)
class Dark:
    """The dark signals of one analog channel, and how they serve a profile."""

    signals: npt.NDArray[np.float64]
    """(dark, range), mV."""
    times: npt.NDArray[np.datetime64]
    """(dark,)"""
    method: str

    def at(self, times: npt.NDArray[np.datetime64]) -> DarkProfile:
        """Return dark signal and variance at times; see `lidarops.retrieve.dark.profile`."""
        return dark_profile(self.signals, self.times, times, method=self.method)

    def variance(self, times: npt.NDArray[np.datetime64]) -> npt.NDArray[np.float64]:
        """Return the variance of the dark signal at times, (time, range), mV2."""
        return self.at(times).variance


def dark_of(archive: xr.Dataset, channel: str, *, method: str) -> Dark:
    """Read the dark files of one analog channel.

    Parameters
    ----------
    archive : xr.Dataset
        The dark files, as `lidarops.open_archive(..., mask_and_scale=False)` gives them.
    channel : str
        Name of the channel.
    method : {"nearest", "interpolated"}
        See `lidarops.retrieve.dark.profile`.

    Returns
    -------
    Dark
        In memory.
    """
    power = condition(archive, channel, noise_variance=0.0)["power"]
    return Dark(power.to_numpy(), archive["time"].to_numpy(), method)


def range_corrected(
    conditioned: xr.Dataset, background: xr.DataArray, background_standard_error: xr.DataArray
) -> xr.Dataset:
    """Subtract the background and correct for range.

    Parameters
    ----------
    conditioned : xr.Dataset
        From `condition`.
    background, background_standard_error : xr.DataArray
        Over time, in the unit of the signal.

    Returns
    -------
    xr.Dataset
        ``signal``, ``signal_standard_error`` (mV m2 or MHz m2) over (time, range).
    """
    range_ = conditioned["range"].to_numpy().astype(np.float64)
    parts = xr.apply_ufunc(
        _range_corrected,
        conditioned["power"],
        conditioned["variance"],
        background,
        background_standard_error,
        input_core_dims=[["range"], ["range"], [], []],
        output_core_dims=[["range"], ["range"]],
        kwargs={"range": range_},
        dask="parallelized",
        output_dtypes=[np.dtype(np.float32)] * 2,
    )
    return xr.Dataset({"signal": parts[0], "signal_standard_error": parts[1]})


_Block = npt.NDArray[Any]


def _analog(
    counts: _Block,
    shots: _Block,
    input_range: _Block,
    times: _Block | None = None,
    *,
    dark: Dark | None = None,
    **settings: Any,
) -> tuple[_Block, _Block, _Block]:
    if dark is None or times is None:
        return _tuple(signal.analog(counts, shots, input_range=input_range, **settings))
    found = dark.at(times.astype("datetime64[ns]"))
    return _tuple(
        signal.analog(
            counts,
            shots,
            input_range=input_range,
            dark=found.dark,
            dark_variance=found.variance,
            **settings,
        )
    )


def _photon(counts: _Block, shots: _Block, **settings: Any) -> tuple[_Block, _Block, _Block]:
    return _tuple(signal.photon(counts, shots, **settings))


def _tuple(result: Signal) -> tuple[_Block, _Block, _Block]:
    return result.power, result.variance, result.quality


def _range_corrected(
    power: _Block,
    variance: _Block,
    background: _Block,
    error: _Block,
    *,
    range: _Block,  # noqa: A002
) -> tuple[_Block, _Block]:
    result = signal.range_corrected(
        Signal(power, variance, np.empty(0, np.int32)),
        range,
        background=background,
        background_variance=error**2,
        dtype=np.float32,
    )
    # The noise is far above the 24 bits of float32, and a day of profiles fits in memory.
    return result.power, np.sqrt(result.variance, out=result.variance)

"""The retrievals over xarray: units checked, dask-aware, quality merged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve import background
from lidarops.retrieve import homogeneous as _homogeneous
from lidarops.retrieve.homogeneous import Method

EXCLUDED: Final = int(Quality.INPUT_MISSING | Quality.SATURATED | Quality.INCOMPLETE_OVERLAP)
"""Bits of a bin that keep it out of a fit."""
CARRIED: Final = int(Quality.SATURATED | Quality.PILE_UP | Quality.INCOMPLETE_OVERLAP)
"""Bits of a bin that its section carries too."""

_VALUES: Final = (
    "background",
    "background_standard_error",
    "amplitude",
    "amplitude_standard_error",
    "extinction",
    "extinction_standard_error",
    "reduced_chi2",
)
_COUNTS: Final = ("valid_bins", "quality_flag")
_Block = npt.NDArray[Any]


def homogeneous(
    power: xr.DataArray,
    *,
    sections: Sequence[tuple[float, float]],
    variance: xr.DataArray | float | None = None,
    quality: xr.DataArray | None = None,
    method: Method = "auto",
) -> xr.Dataset:
    """Retrieve background, amplitude and extinction of sections of range.

    Parameters
    ----------
    power : xr.DataArray
        With dimension ``range`` and its coordinate in m; may be dask-backed. Any unit.
    sections : sequence of (float, float)
        m; bins with near <= range < far.
    variance : xr.DataArray or float, optional
        Of the noise of `power`.
    quality : xr.DataArray, optional
        Bits of each bin, as `lidarops.retrieve.labeled_signal.condition` gives them. Missing,
        saturated and incompletely overlapping bins are left out; a section carries the bits
        SATURATED, PILE_UP and INCOMPLETE_OVERLAP of its bins.
    method : {"auto", "direct", "cubic"}

    Returns
    -------
    xr.Dataset
        Over the other dimensions of `power` and ``section``; as lazy as the input. The same bits
        for any chunking.

    Raises
    ------
    RetrievalInputError
        Where units or sections cannot be right.
    """
    distance = _distance(power)
    parts = [_section(power, distance, section, variance, quality, method) for section in sections]
    if not parts:
        raise RetrievalInputError(
            "is empty", field="sections", remedy="give [[near, far], ...] in m"
        )
    result: xr.Dataset = xr.concat(parts, dim="section")
    others = [dim for dim in power.dims if dim != "range"]
    edges = np.asarray(sections, dtype=np.float64)
    result = result.transpose(*others, "section").assign_coords(
        section=("section", np.arange(len(parts), dtype=np.int32)),
        section_range=("section", edges.mean(axis=1), {"units": "m"}),
        section_bounds=(("section", "nv"), edges, {"units": "m"}),
    )
    unit = power.attrs.get("units", "1")
    for name in _VALUES:
        result[name].attrs["units"] = (
            unit if "background" in name else f"{unit} m2" if "amplitude" in name else "m-1"
        )
    result["reduced_chi2"].attrs["units"] = "1"
    return result


def _distance(power: xr.DataArray) -> npt.NDArray[np.float64]:
    if "range" not in power.dims or "range" not in power.coords:
        raise RetrievalInputError(
            f"has dimensions {power.dims}",
            field="power",
            remedy="give it a dimension range with a coordinate in m",
        )
    unit = power["range"].attrs.get("units")
    if unit not in ("m", "meter", "metre"):
        raise RetrievalInputError(
            f"has units {unit!r}",
            field="range",
            remedy="convert the coordinate to m and set its attribute units to 'm'",
        )
    return power["range"].to_numpy().astype(np.float64)


def _section(
    power: xr.DataArray,
    distance: npt.NDArray[np.float64],
    section: tuple[float, float],
    variance: xr.DataArray | float | None,
    quality: xr.DataArray | None,
    method: Method,
) -> xr.Dataset:
    near, far = section
    inside = np.flatnonzero((distance >= near) & (distance < far))
    if inside.size < 4:
        raise RetrievalInputError(
            f"[{near:g}, {far:g}] m holds {inside.size} bins",
            field="sections",
            remedy=f"the bins reach from {distance.min():g} to {distance.max():g} m",
        )
    part = slice(int(inside[0]), int(inside[-1]) + 1)
    arrays: list[Any] = [power.isel(range=part)]
    arrays.append(variance.isel(range=part) if isinstance(variance, xr.DataArray) else variance)
    arrays.append(None if quality is None else quality.isel(range=part))
    present = [array for array in arrays if isinstance(array, xr.DataArray)]
    outputs = xr.apply_ufunc(
        _solve,
        *[_one_chunk(array) for array in present],
        input_core_dims=[["range"] if "range" in array.dims else [] for array in present],
        output_core_dims=[[]] * (len(_VALUES) + len(_COUNTS)),
        kwargs={
            "range": distance[part],
            "method": method,
            "has_variance": isinstance(variance, xr.DataArray),
            "has_quality": quality is not None,
            "variance": None if isinstance(variance, xr.DataArray) else variance,
        },
        dask="parallelized",
        output_dtypes=[np.float64] * len(_VALUES) + [np.int32] * len(_COUNTS),
    )
    return xr.Dataset(dict(zip((*_VALUES, *_COUNTS), outputs, strict=True)))


def _one_chunk(array: xr.DataArray) -> xr.DataArray:
    if array.chunks is not None and "range" in array.dims:
        return array.chunk({"range": -1})
    return array


def _solve(
    power: _Block,
    *others: _Block,
    range: _Block,  # noqa: A002 - the field's word
    method: Method,
    has_variance: bool,
    has_quality: bool,
    variance: float | None,
) -> tuple[_Block, ...]:
    noise: Any = others[0] if has_variance else variance
    carried = np.int32(0)
    if has_quality:
        bits = others[-1]
        power = np.where((bits & EXCLUDED) != 0, np.nan, power)
        carried = np.bitwise_or.reduce(bits, axis=-1) & np.int32(CARRIED)
    result = _homogeneous.solve(power, range, variance=noise, method=method)
    values = [getattr(result, name) for name in _VALUES]
    return (*values, result.valid_bins, result.quality | carried)


def tail_mean(
    power: xr.DataArray,
    *,
    start: float | None = None,
    variance: xr.DataArray | None = None,
) -> xr.Dataset:
    """Average the far bins of a signal; see `lidarops.retrieve.background.tail_mean`.

    Parameters
    ----------
    power : xr.DataArray
        With dimension ``range`` and its coordinate in m.
    start : float, optional
        m; nearest bin to average. The last tenth of the bins where absent.
    variance : xr.DataArray, optional
        Of the noise of `power`.

    Returns
    -------
    xr.Dataset
        ``background``, ``background_standard_error`` and ``quality_flag`` over the other
        dimensions.

    Raises
    ------
    RetrievalInputError
        As the function it maps.
    """
    arrays = [power] if variance is None else [power, variance]
    outputs = xr.apply_ufunc(
        _tail_mean,
        *[_one_chunk(array) for array in arrays],
        input_core_dims=[["range"]] * len(arrays),
        output_core_dims=[[]] * 3,
        kwargs={"range": _distance(power), "start": start},
        dask="parallelized",
        output_dtypes=[np.float64, np.float64, np.int32],
    )
    names = ("background", "background_standard_error", "quality_flag")
    return xr.Dataset(dict(zip(names, outputs, strict=True)))


def _tail_mean(
    power: _Block,
    variance: _Block | None = None,
    *,
    range: _Block,  # noqa: A002 - the field's word
    start: float | None,
) -> tuple[_Block, _Block, _Block]:
    found = background.tail_mean(power, range, start=start, variance=variance)
    return found.background, found.background_standard_error, found.quality

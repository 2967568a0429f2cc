"""Homogeneous path over xarray: checks units, cuts sections, merges quality; in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.background.estimate import Background, from_bounded_tail
from lidarops.retrieve.common.arrays import Array, Block, Flags
from lidarops.retrieve.homogeneous import path_fit as _homogeneous
from lidarops.retrieve.homogeneous._problem import UNKNOWNS
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import Noise
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

EXCLUDED: Final = WITHHELD & ~int(Quality.NO_GLUING)
"""Bits that exclude a bin from a fit."""
CARRIED: Final = EXCLUDED & ~int(Quality.INPUT_MISSING) | int(Quality.PILE_UP)
"""Bits that a section takes over from its bins."""
_METRES: Final = frozenset({"m", "meter", "meters", "metre", "metres"})
_UNITS: Final = {
    "background": "{}",
    "background_standard_error": "{}",
    "background_model_error": "{}",
    "amplitude": "{} m2",
    "amplitude_standard_error": "{} m2",
    "total_extinction": "m-1",
    "total_extinction_standard_error": "m-1",
    "total_extinction_model_error": "m-1",
    "reduced_chi2": "1",
}
"""Variables and their units, in terms of the unit of the power."""
_VARIABLES: Final = (*_UNITS, "valid_bins", "quality_flag")
_OF_BINS: Final = ("power", "variance", "quality")
"""Values of bins; all others are of whole profiles."""
_INDEPENDENT: Final = Noise()


def fit_homogeneous_path(
    power: xr.DataArray,
    *,
    sections: Sequence[tuple[float, float]],
    variance: xr.DataArray | float | None = None,
    quality: xr.DataArray | None = None,
    method: str = "direct",
    noise: Noise = _INDEPENDENT,
    background_range: tuple[float, float] | None = None,
    extinction: xr.DataArray | float | None = None,
    background: tuple[float, float] | None = None,
    lag: int | None = None,
) -> xr.Dataset:
    """Return background, amplitude and extinction of sections of range.

    Parameters
    ----------
    power : xr.DataArray, (..., range)
        Any unit; the coordinate of ``range`` ascending, in m.
    sections : sequence of (float, float)
        m; a section holds the bins with near <= range < far.
    variance, extinction : xr.DataArray or float, optional
        As for `lidarops.retrieve.homogeneous.path_fit.fit_homogeneous_path`, as are `method` and
        `lag`; their dimensions are among those of `power`.
    noise : Noise, optional
        Of values whose dimensions are among those of `power`.
    quality : xr.DataArray, optional
        Bits of `lidarops.flags.Quality` of each bin. Missing, saturated and incompletely
        overlapping bins are excluded; a section takes over SATURATED, PILE_UP and
        INCOMPLETE_OVERLAP from its bins.
    background_range : (float, float), optional
        m; far range whose mean is the background of "known_background", which needs `variance`. Its
        error holds the signal that may be left there. Where that cannot be estimated,
        BACKGROUND_UNCERTAIN is raised.
    background : (float, float), optional
        Of "known_background", in place of `background_range`: the background and its standard
        error, in the unit of the power.

    Returns
    -------
    xr.Dataset, (..., section)
        ``background``, ``amplitude``, ``total_extinction``, each with ``_standard_error``,
        ``background_model_error``, ``total_extinction_model_error``, ``reduced_chi2``,
        ``valid_bins`` and ``quality_flag``, with the coordinates ``section``, ``section_range``
        (its middle) and ``section_bounds``; in memory.

    Raises
    ------
    RetrievalInputError
        Where units or ranges are invalid, or a section holds too few bins.
    """
    distance, edges = _distance(power), np.asarray(sections, dtype=np.float64)
    power = power.transpose(..., "range")
    given = {
        "power": power,
        "variance": variance,
        "quality": quality,
        "noise_correlation_length": noise.correlation_length,
        "extinction": extinction,
        "exposure": noise.exposure,
    }
    arrays = {
        name: _along(xr.DataArray(values), power, name)
        for name, values in given.items()
        if values is not None
    }
    bins: dict[str, Block] = {name: arrays.pop(name) for name in _OF_BINS if name in arrays}
    length = arrays["noise_correlation_length"]
    of_profiles = {name: values[..., 0] for name, values in arrays.items()}
    noise = Noise(
        noise.relative,
        of_profiles.pop("noise_correlation_length"),
        of_profiles.pop("exposure", None),
    )
    known: dict[str, Any] = {**of_profiles, "noise": noise, "method": method, "lag": lag}
    doubt: Any = np.int32(0)
    if background is not None:
        if background_range is not None:
            raise RetrievalInputError(
                "is given together with background_range",
                field="background",
                remedy="give one of them",
            )
        known["background"], known["background_standard_error"] = background
    elif background_range is not None:
        sky = _far_background(bins, length, distance, background_range)
        known["background"] = sky.background
        known["background_standard_error"] = np.hypot(sky.standard_error, sky.left)
        doubt = sky.quality & np.int32(Quality.BACKGROUND_UNCERTAIN)
    solutions = [_solve(bins, distance, _bins(distance, *edge), known, doubt) for edge in edges]
    return _joined(solutions, power, edges)


def _joined(
    solutions: Sequence[tuple[Block, ...]], power: xr.DataArray, edges: Array
) -> xr.Dataset:
    """Return `_VARIABLES` of all sections, with their units and coordinates."""
    dims = (*power.dims[:-1], "section")
    stacked = (np.stack(values, axis=-1) for values in zip(*solutions, strict=True))
    result = xr.Dataset(
        {name: (dims, values) for name, values in zip(_VARIABLES, stacked, strict=True)},
        coords=power.coords,
    ).drop_dims("range")
    for name, pattern in _UNITS.items():
        result[name].attrs["units"] = pattern.format(power.attrs.get("units", "1")).removeprefix(
            "1 "
        )
    return result.assign_coords(
        section=("section", np.arange(len(edges), dtype=np.int32)),
        section_range=("section", edges.mean(axis=1), {"units": "m"}),
        section_bounds=(("section", "nv"), edges, {"units": "m"}),
    )


def _along(values: xr.DataArray, power: xr.DataArray, name: str) -> Block:
    """Return values over the dimensions of the power, of length 1 where they lack one."""
    extra = set(values.dims) - set(power.dims)
    if extra:
        raise RetrievalInputError(
            f"has the dimensions {values.dims}, power has {power.dims}", field=name
        )
    try:
        xr.align(power, values, join="exact", copy=False)
    except ValueError as error:
        raise RetrievalInputError(f"does not fit power: {error}", field=name) from error
    missing = [dim for dim in power.dims if dim not in values.dims]
    return values.expand_dims(missing).transpose(*power.dims).to_numpy()


def not_level(result: xr.Dataset, zenith_angle: xr.DataArray) -> xr.DataArray:
    r"""Return NOT_LEVEL for the sections along which the height of the beam changes too much.

    Backscatter that decreases with height as :math:`e^{-z/H}` mimics an additional extinction of
    :math:`\cos\theta / 2H` exactly. Residuals do not show it; the geometry does.

    Parameters
    ----------
    result : xr.Dataset
        From `fit_homogeneous_path`.
    zenith_angle : xr.DataArray
        degree, over the dimensions of `result` but ``section``, or fewer.

    Returns
    -------
    xr.DataArray
        Bits to merge into ``quality_flag``.
    """
    length = result["section_bounds"].isel(nv=1) - result["section_bounds"].isel(nv=0)
    climb = length * np.abs(np.cos(np.deg2rad(zenith_angle)))
    # Negated, so that an unknown angle does not count as level.
    sloping = ~(climb <= THRESHOLDS.level)
    bits: xr.DataArray = sloping.astype(np.int32) * np.int32(HomogeneousQuality.NOT_LEVEL)
    return bits.drop_vars(bits.coords)


def _far_background(
    bins: Mapping[str, Block],
    length: Block,
    distance: Array,
    background_range: tuple[float, float],
) -> Background:
    """Return the background of the far range, of noise with a correlation length."""
    if "variance" not in bins:
        raise RetrievalInputError("is needed for a background of the far range", field="variance")
    power, front = _usable(bins), slice(int(np.searchsorted(distance, 0.0, side="right")), None)
    noise = np.broadcast_to(bins["variance"] * length, power.shape)
    return from_bounded_tail(
        power[..., front], distance[front], noise[..., front], None, background_range
    )


def _usable(arrays: Mapping[str, Block]) -> Block:
    """Return the power, NaN in bins that are excluded from a fit."""
    if "quality" not in arrays:
        return arrays["power"]
    return np.where((arrays["quality"] & EXCLUDED) != 0, np.nan, arrays["power"])


def _bins(distance: Array, near: float, far: float) -> slice:
    inside = np.flatnonzero((distance >= near) & (distance < far))
    if inside.size <= UNKNOWNS:
        raise RetrievalInputError(
            f"[{near:g}, {far:g}] m holds {inside.size} bins of the range grid, which reaches"
            f" from {distance.min():g} to {distance.max():g} m",
            field="sections",
            remedy=f"choose sections that hold at least {UNKNOWNS + 1}, better 50, bins",
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)


def _solve(
    arrays: Mapping[str, Block],
    distance: Array,
    bins: slice,
    known: Mapping[str, Any],
    doubt: Flags | np.int32,
) -> tuple[Block, ...]:
    """Return `_VARIABLES` of a section, over the leading dimensions of the power.

    `known` are the other arguments of the fit, and `doubt` the bits of the background.
    """
    inside = {n: a[..., bins] if a.shape[-1] > 1 else a for n, a in arrays.items()}
    fit = _homogeneous.fit_homogeneous_path(
        _usable(inside), distance[bins], variance=inside.get("variance"), **known
    )
    bits = fit.quality | doubt
    if "quality" in inside:
        bits = bits | np.bitwise_or.reduce(inside["quality"] & CARRIED, axis=-1).astype(np.int32)
    values = (getattr(fit, name.removeprefix("total_")) for name in _UNITS)
    return (*values, fit.valid_bins, bits)


def _distance(power: xr.DataArray) -> Array:
    """Return the range coordinate, in m."""
    unit = power["range"].attrs.get("units")
    if unit not in _METRES:
        raise RetrievalInputError(
            f"is in {unit!r}, not in 'm'" if unit else "has no attribute units",
            field="range",
            remedy="convert the coordinate to m and set its attribute units to 'm'",
        )
    distance = power["range"].to_numpy().astype(np.float64)
    if not np.all(np.diff(distance) > 0):
        raise RetrievalInputError("is not finite, or does not ascend", field="range")
    return distance

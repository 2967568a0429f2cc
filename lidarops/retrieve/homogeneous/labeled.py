"""Homogeneous path over xarray: checks units, cuts sections, merges quality; in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background.estimate import from_bounded_tail
from lidarops.retrieve.common.arrays import Array, Block
from lidarops.retrieve.homogeneous import path_fit as _homogeneous
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

EXCLUDED: Final = int(Quality.INPUT_MISSING | Quality.SATURATED | Quality.INCOMPLETE_OVERLAP)
"""Bits that exclude a bin from a fit."""
CARRIED: Final = int(Quality.SATURATED | Quality.PILE_UP | Quality.INCOMPLETE_OVERLAP)
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
_BACKGROUND: Final = ("background", "background_error", "background_bits")
_OF_PROFILES: Final = {
    "correlation_length": "noise_correlation_length",
    "background": "background",
    "background_error": "background_standard_error",
    "extinction": "extinction",
    "exposure": "exposure",
}
"""Values of whole profiles, and the arguments of the fit that they are."""


def fit_homogeneous_path(
    power: xr.DataArray,
    *,
    sections: Sequence[tuple[float, float]],
    variance: xr.DataArray | float | None = None,
    quality: xr.DataArray | None = None,
    method: str = "direct",
    relative_variance: bool = False,
    noise_correlation_length: xr.DataArray | None = None,
    background_range: tuple[float, float] | None = None,
    extinction: xr.DataArray | float | None = None,
    exposure: xr.DataArray | None = None,
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
    variance, noise_correlation_length, extinction, exposure : xr.DataArray or float, optional
        As for `lidarops.retrieve.homogeneous.path_fit.fit_homogeneous_path`, as are `method` and
        `lag`; their dimensions are among those of `power`.
    quality : xr.DataArray, optional
        Bits of `lidarops.flags.Quality` of each bin. Missing, saturated and incompletely
        overlapping bins are excluded; a section takes over SATURATED, PILE_UP and
        INCOMPLETE_OVERLAP from its bins.
    relative_variance : bool
        Whether `variance` is known up to a factor only, which each section estimates: for a
        variance estimated from the same data.
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
        Where units, dimensions or sections are invalid.
    """
    distance, edges = _distance(power), _edges(sections)
    power = power.transpose(..., "range")
    inputs = {
        "power": power,
        "variance": variance,
        "quality": quality,
        "correlation_length": noise_correlation_length,
        "extinction": extinction,
        "exposure": exposure,
    }
    arrays = {
        name: _along(xr.DataArray(values), power, name)
        for name, values in inputs.items()
        if values is not None
    }
    if background is not None:
        arrays |= _given_background(background, background_range)
    elif background_range is not None:
        arrays |= _far_background(arrays, distance, background_range)
    solutions = [
        _solve(arrays, distance, _bins(distance, *edge), method, lag, relative=relative_variance)
        for edge in edges
    ]
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
    own = [dim for dim in power.dims if dim in values.dims]
    sizes = [values.sizes.get(dim, 1) for dim in power.dims]
    return np.asarray(values.transpose(*own).to_numpy()).reshape(sizes)


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


def _given_background(
    background: tuple[float, float], background_range: tuple[float, float] | None
) -> dict[str, Block]:
    """Return a background that is given for all profiles, and its standard error."""
    if background_range is not None:
        raise RetrievalInputError(
            "is given together with background_range", field="background", remedy="give one of them"
        )
    return dict(zip(_BACKGROUND, (np.full(1, value) for value in background), strict=False))


def _far_background(
    arrays: Mapping[str, Block], distance: Array, background_range: tuple[float, float]
) -> dict[str, Block]:
    """Return the mean of the far range, its standard error, and whether that is uncertain."""
    if "variance" not in arrays:
        raise RetrievalInputError("is needed for a background of the far range", field="variance")
    power, front = arrays["power"], slice(int(np.searchsorted(distance, 0.0, side="right")), None)
    used = _usable(arrays)[..., front]
    noise = arrays["variance"] * arrays.get("correlation_length", 1.0)
    noise = np.broadcast_to(noise, power.shape)[..., front]
    sky = from_bounded_tail(used, distance[front], noise, None, background_range)
    bits = sky.quality & np.int32(Quality.BACKGROUND_UNCERTAIN)
    error = np.hypot(sky.standard_error, sky.left.most)
    found = (sky.background, error, bits)
    return {name: part[..., np.newaxis] for name, part in zip(_BACKGROUND, found, strict=True)}


def _usable(arrays: Mapping[str, Block]) -> Block:
    """Return the power, NaN in bins that are excluded from a fit."""
    if "quality" not in arrays:
        return arrays["power"]
    return np.where((arrays["quality"] & EXCLUDED) != 0, np.nan, arrays["power"])


def _bins(distance: Array, near: float, far: float) -> slice:
    inside = np.flatnonzero((distance >= near) & (distance < far))
    fewest = THRESHOLDS.fewest_solved_bins
    if inside.size < fewest:
        raise RetrievalInputError(
            f"[{near:g}, {far:g}] m holds {inside.size} bins of the range grid, which reaches"
            f" from {distance.min():g} to {distance.max():g} m",
            field="sections",
            remedy=f"choose sections that hold at least {fewest}, better 50, bins",
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)


def _solve(
    arrays: Mapping[str, Block],
    distance: Array,
    bins: slice,
    method: str,
    lag: int | None,
    *,
    relative: bool,
) -> tuple[Block, ...]:
    """Return `_VARIABLES` of a section, over the leading dimensions of the power."""
    inside = {n: a[..., bins] if a.shape[-1] > 1 else a for n, a in arrays.items()}
    noise = {"variance": inside.get("variance")}
    if relative and "variance" in inside:
        with np.errstate(divide="ignore"):
            noise = {"weights": 1.0 / inside["variance"]}
    of_profile = {name: array[..., 0] for name, array in inside.items() if name in _OF_PROFILES}
    fit = _homogeneous.fit_homogeneous_path(
        _usable(inside),
        distance[bins],
        method=method,
        lag=lag,
        **noise,
        **{_OF_PROFILES[name]: values for name, values in of_profile.items()},
    )
    bits = fit.quality | inside.get("background_bits", np.zeros(1, np.int32))[..., 0]
    if "quality" in inside:
        bits = bits | np.bitwise_or.reduce(inside["quality"] & CARRIED, axis=-1).astype(np.int32)
    values = (getattr(fit, name.removeprefix("total_")) for name in _UNITS)
    return (*values, fit.valid_bins, bits)


def _distance(power: xr.DataArray) -> Array:
    """Return the range coordinate, in m and ascending."""
    if "range" not in power.dims or "range" not in power.coords:
        raise RetrievalInputError(
            f"has the dimensions {power.dims} and coordinates {tuple(power.coords)}",
            field="power",
            remedy="give it a dimension range with a coordinate in m",
        )
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


def _edges(sections: Sequence[tuple[float, float]]) -> Array:
    try:
        edges = np.asarray(sections, dtype=np.float64)
    except (TypeError, ValueError):
        edges = np.empty(0)
    if edges.ndim != 2 or edges.shape[1] != 2 or not np.all(edges[:, 0] < edges[:, 1]):
        raise RetrievalInputError(
            f"is {sections!r}", field="sections", remedy="give pairs (near, far) in m, near first"
        )
    return edges

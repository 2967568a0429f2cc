"""Homogeneous path over xarray: checks units, cuts sections, merges quality."""

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
_VALUES: Final = {
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
_COUNTS: Final = ("valid_bins", "quality_flag")


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
        Any unit; the coordinate of ``range`` in m. May be dask-backed, chunked in any way.
    sections : sequence of (float, float)
        m; a section holds the bins with near <= range < far.
    variance : xr.DataArray or float, optional
        Noise variance in the square of the power's unit. Its dimensions are among those of
        `power`.
    quality : xr.DataArray, optional
        Bits of `lidarops.flags.Quality` of each bin. Missing, saturated and incompletely
        overlapping bins are excluded; a section takes over SATURATED, PILE_UP and
        INCOMPLETE_OVERLAP from its bins.
    method : str
        A method of `lidarops.retrieve.homogeneous.path_fit.fit_homogeneous_path`;
        "known_background" needs `background_range` or `background`, "linearized" and
        "known_extinction" need `extinction`.
    relative_variance : bool
        Whether `variance` is known up to a factor only, which each section estimates: for a
        variance estimated from the same data.
    noise_correlation_length : xr.DataArray, optional
        Bins, over the dimensions of `power` but range; see
        `lidarops.retrieve.homogeneous.path_fit.fit_homogeneous_path`.
    background_range : (float, float), optional
        m; far range whose mean is the background of "known_background", which needs `variance`. Its
        error holds the signal that may be left there. Where that cannot be estimated,
        BACKGROUND_UNCERTAIN is raised.
    extinction : xr.DataArray or float, optional
        m-1, of molecules and particles, over the dimensions of `power` but range: the prior of
        "linearized", which must be known to some percent, and exact for "known_extinction".
    exposure : xr.DataArray, optional
        Of Poisson counts: counts per unit of power, over the dimensions of `power` but range; not
        with `relative_variance`.
    background : (float, float), optional
        Of "known_background", in place of `background_range`: the background and its standard
        error, in the unit of the power.
    lag : int, optional
        Bins, of "cubic"; see `lidarops.retrieve.homogeneous.path_fit.fit_homogeneous_path`.

    Returns
    -------
    xr.Dataset, (..., section)
        ``background``, ``amplitude``, ``total_extinction``, each with ``_standard_error``,
        ``background_model_error``, ``total_extinction_model_error``, ``reduced_chi2``,
        ``valid_bins`` and ``quality_flag``, with the coordinates ``section``, ``section_range``
        (its middle) and ``section_bounds``. As lazy as the input, with the same bits for any
        chunking.

    Raises
    ------
    RetrievalInputError
        Where units, dimensions or sections are invalid.
    """
    distance, edges = _distance(power), _edges(sections)
    bins = [_bins(distance, near, far) for near, far in edges]
    used = slice(min(section.start for section in bins), max(section.stop for section in bins))
    checked = _checked_inputs(power, variance, quality, noise_correlation_length)
    inputs = {
        name: array.isel(range=used, missing_dims="ignore") for name, array in checked.items()
    }
    if extinction is not None:
        given = xr.DataArray(extinction)
        _check_dimensions(given, power, "extinction")
        inputs["extinction"] = given
    if exposure is not None:
        _check_dimensions(exposure, power, "exposure")
        inputs["exposure"] = exposure
    if background is not None:
        inputs |= _given_background(background, background_range)
    elif background_range is not None:
        inputs |= _far_background(checked, distance, background_range)
    outputs = xr.apply_ufunc(
        _solve,
        *inputs.values(),
        input_core_dims=[["range"] if "range" in a.dims else [] for a in inputs.values()],
        output_core_dims=[["section"]] * (len(_VALUES) + len(_COUNTS)),
        kwargs={
            "ranged": {name: "range" in array.dims for name, array in inputs.items()},
            "range": distance[used],
            "sections": [slice(b.start - used.start, b.stop - used.start) for b in bins],
            "method": method,
            "relative": relative_variance,
            "lag": lag,
        },
        dask="parallelized",
        output_dtypes=[np.float64] * len(_VALUES) + [np.int32] * len(_COUNTS),
        dask_gufunc_kwargs={"output_sizes": {"section": len(bins)}},
        keep_attrs=False,
    )
    result = xr.Dataset(dict(zip((*_VALUES, *_COUNTS), outputs, strict=True)))
    return _described(result, edges, power.attrs.get("units", "1"))


def _described(result: xr.Dataset, edges: Array, power_unit: str) -> xr.Dataset:
    """Return values of sections with their units and coordinates."""
    for name, pattern in _VALUES.items():
        result[name].attrs["units"] = pattern.format(power_unit).removeprefix("1 ")
    return result.assign_coords(
        section=("section", np.arange(len(edges), dtype=np.int32)),
        section_range=("section", edges.mean(axis=1), {"units": "m"}),
        section_bounds=(("section", "nv"), edges, {"units": "m"}),
    )


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


def _checked_inputs(
    power: xr.DataArray,
    variance: xr.DataArray | float | None,
    quality: xr.DataArray | None,
    correlation_length: xr.DataArray | None,
) -> dict[str, xr.DataArray]:
    """Return the arrays that are given, each with its range in one chunk."""
    inputs = {"power": power}
    if variance is not None:
        inputs["variance"] = xr.DataArray(variance)
    if correlation_length is not None:
        inputs["correlation_length"] = correlation_length
    if quality is not None:
        inputs["quality"] = quality
        if quality.dtype.kind not in "iu":
            raise RetrievalInputError(
                f"holds {quality.dtype}", field="quality", remedy="give bits as integers"
            )
    for name, array in inputs.items():
        _check_dimensions(array, power, name)
    return {
        name: array.chunk({"range": -1}) if array.chunks and "range" in array.dims else array
        for name, array in inputs.items()
    }


def _given_background(
    background: tuple[float, float], background_range: tuple[float, float] | None
) -> dict[str, xr.DataArray]:
    """Return a background that is given for all profiles, and its standard error."""
    if background_range is not None:
        raise RetrievalInputError(
            "is given together with background_range", field="background", remedy="give one of them"
        )
    value, error = background
    return {"background": xr.DataArray(value), "background_error": xr.DataArray(error)}


def _far_background(
    inputs: Mapping[str, xr.DataArray],
    distance: Array,
    background_range: tuple[float, float],
) -> dict[str, xr.DataArray]:
    """Return the mean of the far range, its standard error, and whether that is uncertain."""
    if "variance" not in inputs:
        raise RetrievalInputError("is needed for a background of the far range", field="variance")
    front = slice(int(np.searchsorted(distance, 0.0, side="right")), None)

    def mean(
        power: Block, variance: Block, quality: Block, length: Block
    ) -> tuple[Block, Block, Block]:
        values = np.where((quality & EXCLUDED) != 0, np.nan, power)[..., front]
        noise = np.broadcast_to(variance * length, power.shape)[..., front]
        sky = from_bounded_tail(values, distance[front], noise, None, background_range)
        bits = sky.quality & np.int32(Quality.BACKGROUND_UNCERTAIN)
        return sky.background, np.hypot(sky.standard_error, sky.left.most), bits

    power = inputs["power"]
    arrays = [
        power,
        inputs["variance"].broadcast_like(power),
        inputs.get("quality", xr.zeros_like(power, dtype=np.int32)),
        inputs.get("correlation_length", xr.DataArray(1.0)).broadcast_like(power),
    ]
    outputs = xr.apply_ufunc(
        mean,
        *(array.transpose(..., "range") for array in arrays),
        input_core_dims=[["range"]] * len(arrays),
        output_core_dims=[[], [], []],
        dask="parallelized",
        output_dtypes=[np.float64, np.float64, np.int32],
    )
    return dict(zip(("background", "background_error", "background_bits"), outputs, strict=True))


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
    *blocks: Block,
    ranged: Mapping[str, bool],
    range: Block,  # noqa: A002 - the field's word
    sections: Sequence[slice],
    method: str,
    relative: bool,
    lag: int | None,
) -> tuple[Block, ...]:
    """Return the values of all sections, stacked along a last axis."""
    # Values of whole profiles broadcast along range.
    arrays = {
        name: block if along else np.asarray(block)[..., np.newaxis]
        for (name, along), block in zip(ranged.items(), blocks, strict=True)
    }
    solutions = [
        _solve_section(
            **{n: a[..., bins] if a.shape[-1] > 1 else a for n, a in arrays.items()},
            range=range[bins],
            method=method,
            relative=relative,
            lag=lag,
        )
        for bins in sections
    ]
    return tuple(np.stack(values, axis=-1) for values in zip(*solutions, strict=True))


def _solve_section(
    power: Block,
    variance: Block | None = None,
    quality: Block | None = None,
    correlation_length: Block | None = None,
    background: Block | None = None,
    background_error: Block | None = None,
    background_bits: Block | None = None,
    extinction: Block | None = None,
    exposure: Block | None = None,
    *,
    range: Block,  # noqa: A002 - the field's word
    method: str,
    relative: bool,
    lag: int | None,
) -> tuple[Block, ...]:
    carried = np.int32(0)
    if quality is not None:
        power = np.where((quality & EXCLUDED) != 0, np.nan, power)
        carried = np.bitwise_or.reduce(quality & CARRIED, axis=-1).astype(np.int32)
    weights = None
    if relative and variance is not None:
        with np.errstate(divide="ignore"):
            weights = 1.0 / variance
        variance = None
    whole = (
        correlation_length, background, background_error, background_bits, extinction, exposure,
    )  # fmt: skip
    length, level, error, doubt, prior, counted = (
        None if values is None else values[..., 0] for values in whole
    )
    fit = _homogeneous.fit_homogeneous_path(
        power,
        range,
        variance=variance,
        weights=weights,
        method=method,
        noise_correlation_length=length,
        background=level,
        background_standard_error=error,
        extinction=prior,
        exposure=counted,
        lag=lag,
    )
    values = tuple(getattr(fit, name.removeprefix("total_")) for name in _VALUES)
    bits = fit.quality | carried
    return (*values, fit.valid_bins, bits if doubt is None else bits | doubt)


def _distance(power: xr.DataArray) -> Array:
    """Return the range coordinate, in m and monotonic."""
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
    steps = np.diff(distance)
    if not (np.all(steps > 0) or np.all(steps < 0)):
        raise RetrievalInputError("is not finite and strictly monotonic", field="range")
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


def _check_dimensions(array: xr.DataArray, power: xr.DataArray, name: str) -> None:
    extra = set(array.dims) - set(power.dims)
    try:
        xr.align(power, array, join="exact", copy=False)
    except ValueError as error:
        raise RetrievalInputError(f"does not fit power: {error}", field=name) from error
    if extra:
        raise RetrievalInputError(
            f"has the dimensions {array.dims}, power has {power.dims}", field=name
        )

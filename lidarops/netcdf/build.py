"""Build the encoded CF dataset of a product from arrays and context, without any file or clock.

The result fixes everything in the file: order, types, fill values, attributes and extents. Data
that do not match the layout of the kind are refused.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import xarray as xr

from lidarops.errors import ProductError
from lidarops.netcdf import variables as rows
from lidarops.netcdf.context import Context, product_path
from lidarops.netcdf.coordinates import Coordinate, locate_product
from lidarops.netcdf.global_attributes import global_attributes
from lidarops.netcdf.input_checks import (
    CheckedInput,
    Values,
    check_flagged,
    check_flags,
    check_range,
    whole_numbers,
)
from lidarops.netcdf.provenance import prov_json
from lidarops.netcdf.variables import Layout, Row, attributes, layout_of
from lidarops.records import DetectionMode

__all__ = ["Context", "bitround", "build_dataset", "build_product", "product_path"]

_MANTISSA_BITS: Final = 23


def build_product(data: xr.Dataset, context: Context) -> xr.Dataset:
    """Return the encoded product of one scene, kind and channel: `build_dataset` by its kind."""
    return build_dataset(data, context, layout_of(context.kind))


def build_dataset(data: xr.Dataset, context: Context, layout: Layout) -> xr.Dataset:
    """Return the encoded product of one scene, kind and channel.

    Parameters
    ----------
    data : xr.Dataset
        Every variable of `layout`, in memory, with ``time`` and ``time_bnds`` (datetime64, UTC),
        ``zenith_angle`` and optionally ``azimuth`` (degree; scalar or over time). For ``signal``
        also ``range`` (m, bin centres) and optionally ``range_bnds``; for ``homogeneous`` also
        ``section``, ``section_range`` and ``section_bounds`` (m); for ``multiangle``, instead of
        the angles, ``altitude`` (m above the geoid), ``beam``, ``beam_zenith_angle`` and optionally
        ``beam_azimuth`` (degree). An attribute ``steps`` becomes ``lidarops_steps``. NaN is
        missing.
    context : Context
        Kind, channel, station, instrument, campaign, scene and provenance of the product.
    layout : Layout
        Layout of the kind of product.

    Returns
    -------
    xr.Dataset
        Encoded, as `xarray.open_dataset(..., decode_cf=False)` shows the file.

    Raises
    ------
    ProductError
        If a variable is missing, unknown, lazy, or has wrong dimensions or type; if a value is out
        of its valid range, carries a bit that the kind does not have, or is missing without a
        quality bit; if coordinates are not finite or not rising.
    """
    _refuse_mismatch(context)
    source = CheckedInput(data, layout)
    coordinates, extents = locate_product(source, layout, context)
    product = xr.Dataset(
        {
            **_place(coordinates, context.mode),
            **_measured(source, layout, coordinates, context.mode),
            **_about(layout, context, profiles=extents.vertical),
        },
        attrs=global_attributes(context, layout, extents) | _steps(data),
    )
    product.encoding["unlimited_dims"] = {"time"}
    return product


def _refuse_mismatch(context: Context) -> None:
    provenance = context.provenance
    recorded = (provenance.kind, provenance.channel, provenance.scene)
    if recorded != (context.kind, context.channel, context.scene):
        raise ProductError(
            f"is that of {' '.join(recorded)}, not of"
            f" {context.kind} {context.channel} {context.scene}",
            field="provenance",
        )


def _steps(data: xr.Dataset) -> dict[str, str]:
    """Return the attribute in which the retrieval states its steps; none where it states none."""
    return {"lidarops_steps": str(data.attrs["steps"])} if data.attrs.get("steps") else {}


def _place(coordinates: list[Coordinate], mode: DetectionMode) -> dict[str, xr.Variable]:
    variables = {}
    for coordinate in coordinates:
        row, dims = coordinate.row, coordinate.dims
        variables[row.name] = xr.Variable(dims, coordinate.values, attributes(row, mode=mode))
        if row.bounds and coordinate.bounds is not None:
            variables[row.bounds] = xr.Variable((*dims, rows.BOUNDS_DIM), coordinate.bounds)
    return variables


def _measured(
    source: CheckedInput, layout: Layout, coordinates: list[Coordinate], mode: DetectionMode
) -> dict[str, xr.Variable]:
    judged = layout.row(rows.QUALITY_FLAG)
    flags = whole_numbers(judged, source.take(judged.name, judged.dims))
    check_flags(judged, flags)
    variables = {}
    for row in layout.variables:
        if row.optional and row.name not in source:
            continue
        stored = rows.summarize_flags(flags) if row.summary else _stored(source, row, judged, flags)
        attrs = attributes(row, mode=mode, coordinates=_auxiliary_names(row, coordinates))
        variables[row.name] = xr.Variable(row.dims, stored, attrs)
    _refuse_without_ancillaries(layout, variables)
    return variables


def _refuse_without_ancillaries(layout: Layout, variables: dict[str, xr.Variable]) -> None:
    """Raise an error if a variable is present but one of its ancillary variables is not."""
    for row in layout.variables:
        missing = [name for name in row.ancillaries if name not in variables]
        if row.name in variables and missing:
            raise ProductError("is missing", field=missing[0], remedy=f"{row.name} needs it")


def _stored(source: CheckedInput, row: Row, judged: Row, flags: Values) -> Values:
    values = source.take(row.name, row.dims)
    check_range(row, values)
    if row.dtype.startswith("i"):
        return whole_numbers(row, values)
    stored = _rounded(row, values)
    # Bits refer to retrieved values; an optional derived value may be missing without a bit.
    if row.dims == judged.dims and not row.optional:
        check_flagged(row, stored, flags)
    stored[~np.isfinite(stored)] = rows.FILL_VALUE
    return stored


def _auxiliary_names(row: Row, coordinates: list[Coordinate]) -> tuple[str, ...]:
    """Return the names of the auxiliary coordinates of a variable."""
    # CDO 2.1 cannot read a position that changes along a beam, nor a variable of three dimensions
    # with a scalar position.
    excluded = tuple(position.name for position in rows.SOUNDED)
    excluded += ("latitude", "longitude") if len(row.dims) > 2 else ()
    return tuple(
        coordinate.row.name
        for coordinate in coordinates
        if coordinate.auxiliary
        and set(coordinate.dims) <= set(row.dims)
        and coordinate.row.name not in excluded
    )


def _rounded(row: Row, values: Values) -> Values:
    # A value too large for the type becomes infinite, and counts as missing.
    with np.errstate(over="ignore"):
        stored = values.astype(row.dtype)
    return stored if row.significant_bits is None else bitround(stored, row.significant_bits)


def bitround(values: Values, bits: int) -> Values:
    """Round to fewer bits of the mantissa, half to even, so that the values compress better.

    Parameters
    ----------
    values : ndarray of float32
    bits : int
        Explicit bits of the mantissa to keep; the relative error is at most 2^-(bits + 1).

    Returns
    -------
    ndarray of float32
        NaN stays NaN; a value beyond the largest float becomes infinite.
    """
    drop = _MANTISSA_BITS - bits
    if drop <= 0:
        return values.copy()
    whole = values.view(np.uint32)
    odd = (whole >> np.uint32(drop)) & np.uint32(1)
    rounded = whole + odd
    rounded += np.uint32((1 << (drop - 1)) - 1)
    rounded &= np.uint32(0xFFFFFFFF & ~((1 << drop) - 1))
    result: Values = rounded.view(np.float32)
    missing = np.isnan(values)
    result[missing] = np.nan
    return result


def _about(layout: Layout, context: Context, *, profiles: bool) -> dict[str, xr.Variable]:
    station = rows.station(profiles=profiles)
    texts = {
        station: context.station.name or context.station_key,
        rows.PROVENANCE: prov_json(context.provenance),
    }
    variables = {
        row.name: xr.Variable(
            row.dims, np.frombuffer(text.encode(), "S1"), attributes(row, mode=context.mode)
        )
        for row, text in texts.items()
    }
    if layout.rounded:
        row = rows.QUANTIZATION
        variables[row.name] = xr.Variable((), np.int32(0), attributes(row, mode=context.mode))
    return variables

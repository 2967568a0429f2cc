"""Encode a product after CF from arrays and context, without any file or clock.

The result fixes everything in the file: order, types, fill values, attributes and extents. Data
that do not match the layout of the kind are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
from lidarops.netcdf.skeleton import Skeleton
from lidarops.netcdf.variables import Layout, Row, attributes, layout_of
from lidarops.records import DetectionMode

__all__ = ["Context", "ProductEncoder", "bitround", "product_path"]

_MANTISSA_BITS: Final = 23
_TIME: Final = rows.TIME.name
_BEAMS: Final = ("time", "beam")


class ProductEncoder:
    """The encoding of one product: its profiles, some at a time, and the rest of its file.

    Parameters
    ----------
    frame : xr.Dataset
        What is known before the first profile, in memory: ``time`` and ``time_bnds`` (datetime64,
        UTC) of all profiles, ``zenith_angle`` and optionally ``azimuth`` (degree; scalar or over
        time), and the coordinates and variables of the layout without time, in its units. An
        attribute ``steps`` becomes ``lidarops_steps``; ``references`` adds to those of the kind.
        NaN is missing. Other variables of the layout are not used.
    context : Context
        Kind, channel, station, instrument, campaign, scene and provenance of the product.

    Raises
    ------
    ProductError
        If a variable is missing, unknown, lazy, or has wrong dimensions or type; if a value is out
        of its valid range; if coordinates are not finite or not rising.
    """

    def __init__(self, frame: xr.Dataset, context: Context) -> None:
        _refuse_mismatch(context)
        layout = layout_of(context.kind)
        source = CheckedInput(frame, layout)
        self._layout = layout
        self._context = context
        self._coordinates, self._extents = locate_product(source, layout, context)
        self._steps = _steps(frame)
        self._references = str(frame.attrs.get("references", ""))
        self._times = frame.variables[_TIME].values
        self._profiles = 0
        self._names: frozenset[str] = frozenset()
        self._fixed = {
            row.name: _stored(source, row)
            for row in layout.variables
            if not _over_time(row.dims) and not (row.optional and row.name not in source)
        }
        self._sizes = {
            dim: size
            for dims, values in self._known_shapes()
            for dim, size in zip(dims, values.shape, strict=True)
        }

    def _known_shapes(self) -> Iterator[tuple[tuple[str, ...], Values]]:
        for coordinate in self._coordinates:
            yield coordinate.dims, coordinate.values
        for name, values in self._fixed.items():
            yield self._layout.row(name).dims, values

    def encode(self, profiles: xr.Dataset) -> dict[str, Values]:
        """Return the next profiles as they are stored, with their coordinates.

        Parameters
        ----------
        profiles : xr.Dataset
            Every variable of the layout with time, in memory. Optional variables are in all
            profiles or in none. Variables without time are not used.

        Returns
        -------
        dict of str to ndarray, shape (n, ...)

        Raises
        ------
        ProductError
            If a variable is missing, unknown, lazy, or has wrong dimensions or type; if a value is
            out of its valid range, carries a bit that the kind does not have, or is missing
            without a quality bit; if there are more profiles than times, or others.
        """
        span = self._span(profiles)
        measured = self._measured(CheckedInput(profiles, self._layout))
        self._names = self._names or frozenset(measured)
        for name in sorted(self._names ^ measured.keys()):
            raise ProductError("is in some profiles, but not in others", field=name)
        self._profiles = span.stop
        return dict(self._located(span)) | measured

    def _span(self, profiles: xr.Dataset) -> slice:
        first = self._profiles
        span = slice(first, first + profiles.sizes.get(_TIME, 0))
        if span.stop > self._times.size:
            raise ProductError(
                f"has {self._times.size} values, but there are more profiles", field=_TIME
            )
        times = profiles.variables.get(_TIME)
        if times is not None and not np.array_equal(times.values, self._times[span]):
            raise ProductError(
                f"of profiles does not continue after the first {first}",
                field=_TIME,
                remedy="add all profiles in the order of time",
            )
        return span

    def _located(self, span: slice) -> Iterator[tuple[str, Values]]:
        for coordinate in self._coordinates:
            row = coordinate.row
            if _over_time(coordinate.dims):
                yield row.name, coordinate.profiles(span)
                if row.bounds and coordinate.bounds is not None:
                    yield row.bounds, coordinate.bounds[span]

    def _measured(self, source: CheckedInput) -> dict[str, Values]:
        judged = self._layout.row(rows.QUALITY_FLAG)
        flags = whole_numbers(judged, source.take(judged.name, judged.dims))
        check_flags(judged, flags)
        encoded: dict[str, Values] = {}
        for row in self._layout.variables:
            if not _over_time(row.dims) or (row.optional and row.name not in source):
                continue
            if row.summary:
                encoded[row.name] = rows.summarize_flags(flags, self._layout.flags)
                continue
            # Bits refer to retrieved values; an optional derived or an auxiliary value may be
            # missing without one.
            spared = row.optional or row.coverage is rows.Coverage.AUXILIARY
            judging = row.dims == judged.dims and not spared
            encoded[row.name] = _stored(source, row, flags if judging else None)
            self._refuse_other_sizes(row, encoded[row.name])
        return encoded

    def _refuse_other_sizes(self, row: Row, values: Values) -> None:
        for dim, size in zip(row.dims[1:], values.shape[1:], strict=True):
            if dim not in self._sizes:
                along = (other.name for other in self._layout.coordinates if other.dims == (dim,))
                raise ProductError("is missing", field=next(along, dim))
            if size != self._sizes[dim]:
                raise ProductError(
                    f"has {size} values along {dim}, not {self._sizes[dim]}", field=row.name
                )

    def skeleton(self, encoded: Mapping[str, Values]) -> Skeleton:
        """Return all of the file except the values of profiles.

        Parameters
        ----------
        encoded : mapping of str to ndarray
            The first profiles, from `encode`; which variables they have and of what type counts.

        Raises
        ------
        ProductError
            If an optional variable is present without its ancillary variables.
        """
        layout, context = self._layout, self._context
        attrs = global_attributes(context, layout, self._extents) | self._steps
        if self._references:
            attrs["references"] = f"{attrs['references']}\n{self._references}"
        variables = {
            **_place(self._coordinates, context.mode),
            **dict(self._declared(encoded)),
            **_about(layout, context, profiles=self._extents.vertical),
        }
        _refuse_without_ancillaries(layout, variables)
        return Skeleton(variables, attrs, _TIME)

    def _declared(self, encoded: Mapping[str, Values]) -> Iterator[tuple[str, xr.Variable]]:
        for row in self._layout.variables:
            if row.name in encoded:
                first = encoded[row.name]
                shape = (self._times.size, *first.shape[1:])
                values = np.broadcast_to(np.zeros((), first.dtype), shape)
            elif row.name in self._fixed:
                values = self._fixed[row.name]
            else:
                continue
            auxiliary = _auxiliary_names(row, self._coordinates)
            attrs = attributes(row, mode=self._context.mode, coordinates=auxiliary)
            yield row.name, xr.Variable(row.dims, values, attrs)


def _over_time(dims: tuple[str, ...]) -> bool:
    return dims[:1] == (_TIME,)


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


def _refuse_without_ancillaries(layout: Layout, variables: dict[str, xr.Variable]) -> None:
    """Raise an error if a variable is present but one of its ancillary variables is not."""
    for row in layout.variables:
        missing = [name for name in row.ancillaries if name not in variables]
        if row.name in variables and missing:
            raise ProductError("is missing", field=missing[0], remedy=f"{row.name} needs it")


def _stored(source: CheckedInput, row: Row, flags: Values | None = None) -> Values:
    """Return a variable as stored; with `flags`, a missing value must carry a bit."""
    values = source.take(row.name, row.dims)
    check_range(row, values)
    if row.dtype.startswith("i"):
        return whole_numbers(row, values)
    stored = _rounded(row, values)
    missing = ~np.isfinite(stored)
    if missing.any():
        if flags is not None:
            check_flagged(row, missing, flags)
        stored[missing] = rows.FILL_VALUE
    return stored


def _auxiliary_names(row: Row, coordinates: list[Coordinate]) -> tuple[str, ...]:
    """Return the names of the auxiliary coordinates of a variable."""
    # CDO 2.1 cannot read a position that changes along a beam, nor a variable of three dimensions
    # with a scalar position, nor one over beams beside another with a scalar position.
    excluded = tuple(position.name for position in rows.SOUNDED)
    excluded += ("latitude", "longitude") if len(row.dims) > 2 or row.dims == _BEAMS else ()
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
    return stored if row.bits is None else bitround(stored, row.bits)


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

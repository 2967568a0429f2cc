"""Write a product after CF some profiles at a time, so that memory does not grow with its scene.

Arrays and context fix everything in the file: order, types, fill values, attributes and extents.
Data that do not match the layout of the kind are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr

from lidarops.errors import ProductError
from lidarops.netcdf import variables as rows
from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.context import Context, global_attributes, prov_json
from lidarops.netcdf.coordinates import auxiliary_names, locate_product, on_altitude
from lidarops.netcdf.encoding import (
    Values,
    as_text,
    refuse_unknown,
    stored,
    taken,
    whole_numbers,
)
from lidarops.netcdf.stored_flags import FlagCounter, places
from lidarops.netcdf.variables import Row, attributes, layout_of
from lidarops.netcdf.write import RowFile, Skeleton, Written, create_file
from lidarops.records import Change, Grade, ProductRecord
from lidarops.system.files import sha256_of

_TIME: Final = rows.TIME.name


@contextmanager
def create_product(
    frame: xr.Dataset, context: Context, path: Path, former: str = ""
) -> Iterator[ProductWriter]:
    """Yield a writer of a product; at the end the file is complete, on disk and has its name.

    The bytes depend on the data only, not on how many profiles are added at a time. Several threads
    may write products at once.

    Parameters
    ----------
    frame : xr.Dataset
        What is known before the first profile, in memory: ``time`` and ``time_bnds`` (datetime64,
        UTC) of all profiles, ``zenith_angle`` and optionally ``azimuth`` (degree; scalar or over
        time), and the coordinates and variables of the layout without time, in its units. An
        attribute ``steps`` becomes ``lidarops_steps``; ``references`` adds to those of the kind.
        NaN is missing. Other variables of the layout are not used.
    context : Context
        Station, instrument and provenance of the product, and texts of its campaign.
    path : Path
        Missing folders are created. A former file is replaced at the end, and stays if anything
        fails.
    former : str
        SHA-256 of the former file. If it is so, both are compared, and it stays if it is the same.

    Raises
    ------
    ProductError
        If a variable is missing, unknown, lazy, or has wrong dimensions or type; if a value is out
        of its valid range; if coordinates are not finite or not rising; if profiles are missing at
        the end, or the file cannot be written. Other errors of the ``with`` block are raised as
        they are.
    """
    with ExitStack() as until_complete:
        writer = ProductWriter(frame, context, path, until_complete, former)
        yield writer
        if writer.file is None:
            raise ProductError("has no profiles", file=path)


class ProductWriter:
    """A product that is being written; see `create_product`."""

    def __init__(
        self,
        frame: xr.Dataset,
        context: Context,
        path: Path,
        until_complete: ExitStack,
        former: str = "",
    ) -> None:
        layout = layout_of(context.kind)
        refuse_unknown(frame, layout)
        self._layout = layout
        self._context = context
        self._path = path
        self._until_complete = until_complete
        self._former = former
        self._change: Change | None = None
        self._located = locate_product(frame, layout, context)
        self._frame_texts = frame.attrs
        self._times = frame.variables[_TIME].values
        self._profiles = 0
        self._names: frozenset[str] = frozenset()
        self._fixed = {
            row.name: stored(frame, row)
            for row in layout.variables
            if _TIME not in row.dims and not (row.optional and row.name not in frame)
        }
        self._sizes = {
            str(dim): size
            for variable in self._located.variables.values()
            for dim, size in variable.sizes.items()
        }
        for name, values in self._fixed.items():
            self._sizes |= dict(zip(layout.rows[name].dims, values.shape, strict=True))
        self._counts = FlagCounter(layout.flags.rejecting)
        self.file: RowFile | None = None
        """None until the first profiles, which decide on optional variables."""

    def add(self, profiles: xr.Dataset) -> None:
        """Write the next profiles.

        Parameters
        ----------
        profiles : xr.Dataset
            At least one, in memory, with every variable of the layout that has time. Optional
            variables are in all profiles or in none. Variables without time are not used.

        Raises
        ------
        ProductError
            If a variable is missing, unknown, lazy, or has wrong dimensions or type; if a value is
            out of its valid range, carries a bit that the kind does not have, or is missing
            without a quality bit; if there are more profiles than times, or others; if an optional
            variable comes without its ancillary variables; if they cannot be written.
        """
        encoded = self.encode(profiles)
        if self.file is None:
            self.file = self._until_complete.enter_context(
                create_file(self.skeleton(encoded), self._path, replaces=self._replaces)
            )
        self.file.add(encoded)
        for row in self._layout.judges:
            if row.name in encoded:
                self._counts.add(encoded[row.name])

    def encode(self, profiles: xr.Dataset) -> dict[str, Values]:
        """Return the next profiles as they are stored, with their coordinates; see `add`."""
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
        measured = self._measured(profiles)
        self._names = self._names or frozenset(measured)
        for name in sorted(self._names ^ measured.keys()):
            raise ProductError("is in some profiles, but not in others", field=name)
        self._profiles = span.stop
        moving = {name: values(span) for name, values in self._located.moving.items()}
        located = {
            name: variable.values[span]
            for name, variable in self._located.variables.items()
            if _TIME in variable.dims and name not in moving
        }
        return {**located, **moving, **measured}

    def _measured(self, profiles: xr.Dataset) -> dict[str, Values]:
        refuse_unknown(profiles, self._layout)
        flags = {
            row.name: _bits(row, profiles)
            for row in self._layout.judges
            if not row.optional or row.name in profiles
        }
        summaries = {rows.summary_of(name): name for name in flags}
        encoded: dict[str, Values] = {}
        for row in self._layout.variables:
            if row.name in summaries:
                bits = flags[summaries[row.name]]
                encoded[row.name] = rows.summarize_flags(bits, self._layout.flags)
                continue
            if _TIME not in row.dims or (row.optional and row.name not in profiles):
                continue
            # Bits refer to retrieved values; an optional derived or an auxiliary value may be
            # missing without one.
            judge = self._layout.rows[rows.judging(row.name, flags)]
            spared = row.optional or row.coverage is rows.Coverage.AUXILIARY
            judged = row.dims == judge.dims and not spared
            values = stored(profiles, row, flags[judge.name] if judged else None)
            for dim, size in zip(row.dims[1:], values.shape[1:], strict=True):
                if dim not in self._sizes:
                    along = (one.name for one in self._layout.coordinates if one.dims == (dim,))
                    raise ProductError("is missing", field=next(along, dim))
                if size != self._sizes[dim]:
                    words = f"has {size} values along {dim}, not {self._sizes[dim]}"
                    raise ProductError(words, field=row.name)
            encoded[row.name] = values
        return encoded

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
        located = self._located
        feature_type = "timeSeriesProfile" if located.vertical else ""
        attrs = global_attributes(self._context, self._layout, located.extents, feature_type)
        if self._frame_texts.get("steps"):
            attrs["lidarops_steps"] = str(self._frame_texts["steps"])
        if self._frame_texts.get("references"):
            attrs["references"] = f"{attrs['references']}\n{self._frame_texts['references']}"
        variables = on_altitude(dict(self._variables(encoded)))
        for row in self._layout.variables:
            missing = [name for name in row.ancillaries if name not in variables]
            if row.name in variables and missing:
                raise ProductError("is missing", field=missing[0], remedy=f"{row.name} needs it")
        return Skeleton(variables, attrs, _TIME)

    def _variables(self, encoded: Mapping[str, Values]) -> Iterator[tuple[str, xr.Variable]]:
        """Yield the variables in the order of the file."""
        mode = self._context.mode
        coordinates = self._located.variables
        yield from coordinates.items()
        for row in self._layout.variables:
            if row.name in encoded:
                first = encoded[row.name]
                shape = (self._times.size, *first.shape[1:])
                values = np.broadcast_to(np.zeros((), first.dtype), shape)
            elif row.name in self._fixed:
                values = self._fixed[row.name]
            else:
                continue
            attrs = attributes(row, mode=mode, coordinates=auxiliary_names(row, coordinates))
            yield row.name, xr.Variable(row.dims, values, attrs)
        # Of profiles it identifies the time series.
        role = "timeseries_id" if self._located.vertical else None
        station = replace(rows.STATION, cf_role=role)
        name = self._context.station.name or self._context.station_key
        yield station.name, as_text(station, name, mode)
        provenance = prov_json(self._context)
        yield rows.PROVENANCE.name, as_text(rows.PROVENANCE, provenance, mode)
        if any(row.bits for row in self._layout.variables):
            row = rows.QUANTIZATION
            yield row.name, xr.Variable((), np.int32(0), attributes(row, mode=mode))

    def _replaces(self, new: Path) -> bool:
        """Return whether the new file differs from the former one."""
        if not (self._former and self._path.is_file() and sha256_of(self._path) == self._former):
            return True
        self._change = compare_products(self._path, new)
        return self._change.grade is not Grade.NONE

    @property
    def record(self) -> ProductRecord:
        """What was written, after the ``with`` block, with counts of all its flags.

        Raises
        ------
        ProductError
            If it is not written.
        """
        context, change = self._context, self._change
        file = self.file.written if self.file else None
        if self.file and change is not None and change.grade is Grade.NONE:
            file = Written(self._former, self._path.stat().st_size)
        if file is None:
            raise ProductError("is not written", file=self._path)
        carried, verdicts = self._counts.carried, self._counts.verdicts
        return ProductRecord(
            context.path,
            context.kind,
            context.channel,
            file.sha256,
            file.size,
            values=verdicts.values,
            flagged={
                bit.word.upper(): carried[int(bit)]
                for bit in sorted(self._layout.flags.bits)
                if int(bit) in carried
            },
            unflagged=verdicts.good,
            usable=verdicts.usable,
            stamp=context.stamp,
            change=change,
        )


def _bits(row: Row, profiles: xr.Dataset) -> Values:
    """Return the flags of a row, refusing bits that it does not state."""
    flags = whole_numbers(row, taken(profiles, row.name, row.dims))
    known = sum(row.flags.bits) if row.flags else 0
    foreign = int(np.bitwise_or.reduce(flags & ~np.int32(known), axis=None))
    if foreign:
        raise ProductError(
            f"holds bits that this kind of product does not have: {places(foreign)}",
            field=row.name,
            remedy="add them to products/KIND/variables.py",
        )
    return flags

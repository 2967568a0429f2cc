"""Carry out the steps of a plan, and stream the profiles of a scene through them in chunks."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.records import Plan, PlannedStep
from lidarops.steps.channels import prepared_channels
from lidarops.steps.data import (
    CHUNK_BYTES,
    GEOMETRY,
    Chunk,
    Data,
    ProductStream,
    Source,
    WholeProduct,
)
from lidarops.steps.dependence import is_product
from lidarops.steps.registry import carry_out, product_step

IN_MEMORY: Final = 2_000_000
"""Bytes of counts up to which a scene is one chunk: below, chunks cost more than they save."""
READ_TOGETHER: Final = 8
"""Chunks of dask in a chunk, so that few profiles are read twice where it ends within one."""


def chunk_profiles(bins: int, requested: int | None) -> int:
    """Return the number of profiles that are processed together, of channels with `bins` bins."""
    return max(1, requested or CHUNK_BYTES // (4 * max(bins, 1)))


def channel_data(source: Source, steps: Sequence[PlannedStep], channel: str) -> dict[str, Data]:
    """Carry out the steps of a channel, up to those that make products.

    Parameters
    ----------
    source : Source
    steps : sequence of PlannedStep
        Of the plan, in its order.
    channel : str

    Returns
    -------
    defaultdict of str to Data
        What the steps gave by kind of product, with what the shared steps gave; that alone for an
        empty name.
    """
    shared: dict[str, Data] = {}
    for name in prepared_channels(steps, channel):
        data = shared[name] = Data(source, name, shared)
        for step in steps:
            if step.channel == name and not step.product:
                carry_out(step, data)
    products: defaultdict[str, Data] = defaultdict(shared[channel].of_product)
    for step in steps:
        if step.channel == channel and step.product:
            carry_out(step, products[step.product])
    return products


def streams_of(
    steps: Iterable[PlannedStep], data: Mapping[str, Data], channel: str
) -> dict[str, ProductStream]:
    """Return the products of a channel in the making, by kind, from its `channel_data`."""
    return {
        step.product: (making := product_step(step.product)).stream(
            making.typed(step), data[step.product]
        )
        for step in steps
        if step.channel == channel and is_product(step)
    }


def loaded(archive: xr.Dataset, channels: Iterable[str], rows: slice) -> xr.Dataset:
    """Return some profiles of channels, with their counts in memory."""
    of_channels = tuple(f"{channel}_" for channel in channels)
    names = [
        name for name in archive.variables if name in GEOMETRY or f"{name}_".startswith(of_channels)
    ]
    return archive[names].isel(time=rows).load()


def chunks(
    source: Source, channels: Sequence[str], streams: Iterable[ProductStream], profiles: int
) -> Iterator[Chunk]:
    """Yield the profiles of a scene in chunks that end where its products allow it.

    Parameters
    ----------
    source : Source
    channels : sequence of str
        Of the files, whose counts are loaded.
    streams : iterable of ProductStream
    profiles : int
        Number of profiles of a chunk, unless a product needs more together.
    """
    archive = source.archive
    streams = list(streams)
    reads = not streams or any(
        not isinstance(stream, WholeProduct) or stream.reads for stream in streams
    )
    for rows in _rows(archive.sizes["time"], _ends(streams), profiles if reads else None):
        counts = loaded(archive, channels, rows) if reads else archive.isel(time=rows)
        yield Chunk(counts, rows.start)


def _ends(streams: Iterable[ProductStream]) -> np.ndarray[Any, Any] | None:
    """Return the rows before which a chunk may end; None for any."""
    ends = [stream.ends() for stream in streams if isinstance(stream, WholeProduct)]
    limiting = [rows for rows in ends if rows is not None]
    if not limiting:
        return None
    common = limiting[0]
    for rows in limiting[1:]:
        common = np.intersect1d(common, rows)
    return common


def _rows(count: int, ends: np.ndarray[Any, Any] | None, profiles: int | None) -> Iterator[slice]:
    """Yield consecutive rows, about `profiles` together, cut before some of `ends` only."""
    size = profiles or count
    allowed = np.arange(count + 1) if ends is None else np.append(ends, count)
    first = 0
    while first < count:
        place = int(np.searchsorted(allowed, first + size, side="right")) - 1
        # More than the size where no cut is allowed within it.
        past = int(allowed[place]) if place >= 0 else 0
        if past <= first:
            past = int(allowed[np.searchsorted(allowed, first, side="right")])
        yield slice(first, past)
        first = past


def joint_data(plan: Plan) -> dict[str, Data]:
    """Return what the steps of a whole network give, by kind of product."""
    nothing = Source(xr.Dataset(), None, Ancillaries({}, {}, {}, ()), math.nan)
    products: dict[str, Data] = {}
    for step in plan.steps:
        if not step.instrument:
            carry_out(step, products.setdefault(step.product, Data(nothing, step.channel, {})))
    return products

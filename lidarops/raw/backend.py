"""The xarray engine ``licel``: ``xr.open_dataset(path, engine="licel")``.

The Dataset (`lidarops.raw.model`) is lazy: indexing a channel reads the bytes of the bins that
are asked for, and nothing else. It can be pickled: it holds the path, never an open file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from lidarops.errors import RawFormatError
from lidarops.raw.licel import Dataset, RawFile, channel_names, read_header, to_physical
from lidarops.raw.model import Columns, Position, build_raw_dataset

_FIRST_LINES = re.compile(rb"[^\r\n]{1,1022}\r\n[^\r\n]{0,1022}\d/\d{4} +\d{1,2}:\d\d:\d\d")


class LicelBackendEntrypoint(BackendEntrypoint):
    """Open one Licel raw file as an `xarray.Dataset` with time of length 1."""

    description: ClassVar[str] = "Open Licel raw lidar files"

    def open_dataset(  # type: ignore[override]
        self,
        filename_or_obj: str | os.PathLike[str],
        *,
        drop_variables: str | Iterable[str] | None = None,
        channels: Iterable[str] | None = None,
        mask_and_scale: bool = True,
        header_position: Position = "longitude_first",
    ) -> xr.Dataset:
        """Open a file.

        Parameters
        ----------
        filename_or_obj : path or str
            Of a local file.
        drop_variables : str or iterable of str, optional
            Variables to leave out.
        channels : iterable of str, optional
            Channels to open; all signal channels where not given.
        mask_and_scale : bool
            Whether to give physical values (float32, mV or MHz) or raw counts (int32).
        header_position : {"longitude_first", "latitude_first", "ignore"}
            Which coordinate the instrument writes first.

        Returns
        -------
        xarray.Dataset

        Raises
        ------
        RawFormatError
        """
        if not isinstance(filename_or_obj, str | os.PathLike):
            raise RawFormatError(
                f"cannot open a {type(filename_or_obj).__name__}", remedy="give a local path"
            )
        columns = Columns(channel_names(channels), header_position)
        header = read_header(filename_or_obj)
        columns.append(header)

        def signal(_: int, dataset: Dataset) -> Any:
            array = _Counts(
                path=header.path,
                size=header.size,
                offset=dataset.offset or 0,
                bins=dataset.bins,
                scale=dataset.scale if mask_and_scale else None,
            )
            return indexing.LazilyIndexedArray(_LazyCounts(array))

        opened = build_raw_dataset(columns, signal, scaled=mask_and_scale)
        unwanted = [drop_variables] if isinstance(drop_variables, str) else drop_variables or ()
        opened = opened.drop_vars(list(unwanted), errors="ignore")
        opened.encoding["engine"] = "licel"
        return opened

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return whether the file starts as a Licel header does."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        try:
            with RawFile(filename_or_obj) as file:
                return _FIRST_LINES.match(file.read(0, 2048)) is not None
        except RawFormatError:
            return False


@dataclass(frozen=True, slots=True)
class _Counts:
    """Where the counts of one dataset lie, and how to read a part of them."""

    path: str
    size: int
    offset: int
    bins: int
    scale: float | None

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(np.int32 if self.scale is None else np.float32)

    def read(self, wanted: range) -> NDArray[Any]:
        """Return the values of these bins, reading from the lowest to the highest of them."""
        out = np.empty(len(wanted), self.dtype)
        if not wanted:
            return out
        low, high = min(wanted), max(wanted) + 1
        with RawFile(self.path) as file:
            file.expect(self.size)
            if high - low == self.bins:
                counts = np.empty(self.bins, np.dtype("<i4"))
                file.read_counts(self.offset, [counts])
            else:
                counts = file.read_part(self.offset + 4 * low, high - low)
        chosen = counts[:: abs(wanted.step)][:: int(np.sign(wanted.step))]
        if self.scale is None:
            out[...] = chosen
        else:
            to_physical(chosen, self.scale, out)
        return out


class _LazyCounts(BackendArray):
    """One dataset of one file as an array (1, bins)."""

    def __init__(self, counts: _Counts) -> None:
        self.counts = counts
        self.shape = (1, counts.bins)
        self.dtype = counts.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        support = indexing.IndexingSupport.BASIC
        values = indexing.explicit_indexing_adapter(key, self.shape, support, self._read)
        return np.asarray(values)

    def _read(self, key: tuple[int | slice, int | slice]) -> NDArray[Any]:
        time, bins = key
        if isinstance(bins, slice):
            profile = self.counts.read(range(self.counts.bins)[bins])
            return profile[np.newaxis][time]
        wanted = range(self.counts.bins)[bins]
        return self.counts.read(range(wanted, wanted + 1))[time]

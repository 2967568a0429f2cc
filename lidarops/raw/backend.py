"""The xarray engine ``licel``: ``xr.open_dataset(path, engine="licel")``.

The Dataset (`lidarops.raw.model`) is lazy: indexing a channel reads the bytes of the selected
bins only. It can be pickled, because it holds the path and no open file.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.file import RawFile
from lidarops.raw.header import RawChannel, channel_names, to_physical
from lidarops.raw.licel_format import FORMAT, raw_header
from lidarops.raw.model import Columns, Position, build_raw_dataset


class LicelBackendEntrypoint(BackendEntrypoint):
    """xarray engine that opens one Licel raw file as a Dataset with one time."""

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
            A local file.
        drop_variables : str or iterable of str, optional
            Variables to leave out.
        channels : iterable of str, optional
            Channels to open; by default all signal channels.
        mask_and_scale : bool
            Whether to return physical values (float32, mV or MHz) or raw counts (int32).
        header_position : {"longitude_first", "latitude_first", "ignore"}
            Which coordinate the instrument writes first.

        Returns
        -------
        xarray.Dataset

        Raises
        ------
        RawFormatError
            If the file cannot be read, or an option does not fit it.
        """
        if not isinstance(filename_or_obj, str | os.PathLike):
            raise RawFormatError(
                f"cannot open a {type(filename_or_obj).__name__}", remedy="give a local path"
            )
        columns = Columns(channel_names(channels), header_position)
        header = raw_header(licel.read_header(filename_or_obj))
        columns.append(header)

        def signal(_: int, channel: RawChannel) -> Any:
            array = _Counts(
                path=header.path,
                size=header.size,
                offset=channel.place,
                bins=channel.bins,
                scale=channel.scale if mask_and_scale else None,
            )
            return indexing.LazilyIndexedArray(_LazyCounts(array))

        opened = build_raw_dataset(columns, signal, scaled=mask_and_scale)
        dropped = [drop_variables] if isinstance(drop_variables, str) else drop_variables or ()
        opened = opened.drop_vars(list(dropped), errors="ignore")
        opened.encoding["engine"] = "licel"
        return opened

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return whether the file starts like a Licel header."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        try:
            with RawFile(filename_or_obj) as file:
                return FORMAT.recognises(file.read(0, 2048))
        except RawFormatError:
            return False


@dataclass(frozen=True, slots=True)
class _Counts:
    """Location of the counts of one dataset, and how to read some of them."""

    path: str
    size: int
    offset: int
    bins: int
    scale: float | None

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(np.int32 if self.scale is None else np.float32)

    def read(self, selection: range) -> NDArray[Any]:
        """Return the values of the selected bins; reads from the lowest to the highest."""
        out = np.empty(len(selection), self.dtype)
        if not selection:
            return out
        low, high = min(selection), max(selection) + 1
        with RawFile(self.path) as file:
            file.expect(self.size)
            if high - low == self.bins:
                counts = np.empty(self.bins, np.dtype("<i4"))
                licel.read_datasets(file, self.offset, [counts])
            else:
                counts = licel.read_part(file, self.offset + 4 * low, high - low)
        selected = counts[:: abs(selection.step)][:: int(np.sign(selection.step))]
        if self.scale is None:
            out[...] = selected
        else:
            to_physical(selected, self.scale, out)
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
        index = range(self.counts.bins)[bins]
        return self.counts.read(range(index, index + 1))[time]

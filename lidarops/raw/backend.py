"""The xarray engine ``licel``: ``xr.open_dataset(path, engine="licel")``.

The Dataset (`lidarops.raw.archive`) is lazy: indexing a channel reads the bytes of the selected
bins only.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, ClassVar

import xarray as xr
from xarray.backends import BackendEntrypoint

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.archive import Position, RawFiles, StatedFile, build_raw_dataset
from lidarops.raw.formats import RawFile
from lidarops.raw.licel_format import FORMAT


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

        Raises
        ------
        RawFormatError
            If the file cannot be read, or an option does not fit it.
        """
        if not isinstance(filename_or_obj, str | os.PathLike):
            raise RawFormatError(
                f"cannot open a {type(filename_or_obj).__name__}", remedy="give a local path"
            )
        header = licel.read_header(filename_or_obj)
        file = StatedFile(header.path, header.size, 0, header, header)
        files = RawFiles([file], channels, header_position)

        opened = build_raw_dataset(files, scaled=mask_and_scale)
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

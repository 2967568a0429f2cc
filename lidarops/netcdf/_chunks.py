"""Cut the rows of variables into chunks, and shuffle and deflate them faster than HDF5 does.

The result is in the format of HDF5's filters `shuffle` and `deflate`, so any NetCDF reader can
read it.

The whole writing of a `signal` product of one real day, from values in memory to the digest of the
file, is about 3.4 times faster than with HDF5's own filters at level 4 of zlib (files are 4 to 7 %
larger), and about 2.4 times faster than at level 1 (files are 3 to 4 % smaller). Measured on one
channel of Pilar (8.5 MB of values) and one of Manaus (8.1 MB), as medians of five paired repeats;
CPU times have the same ratios.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

_LEVEL: Final = 2
"""Compression level of ISA-L, 0 to 3. Level 1 is hardly faster and compresses less; 3 is slow."""

_SMALL_LEVEL: Final = 4
"""Compression level of zlib for small chunks, as netCDF would deflate them."""
_SMALL: Final = 1 << 13
"""Bytes up to which zlib is faster than ISA-L, which takes longer to begin."""

Offset = tuple[int, ...]


class RowBlocks:
    """The rows of one variable, cut into the blocks that its chunks hold.

    Parameters
    ----------
    total : int
        Number of rows that will come.
    step : int
        Rows of a block; the last block may have fewer.
    """

    def __init__(self, total: int, step: int) -> None:
        self._total = total
        self._step = step
        self._first = 0
        self._held: list[NDArray[Any]] = []

    def take(self, rows: NDArray[Any]) -> Iterator[tuple[int, NDArray[Any]]]:
        """Take the next rows, and yield the blocks that are complete with them.

        Parameters
        ----------
        rows : ndarray, shape (n, ...)
            No more than are still to come. A copy is kept of rows whose block is incomplete.

        Yields
        ------
        (int, ndarray)
            Number of the first row, and the rows.
        """
        while len(rows):
            size = min(self._step, self._total - self._first)
            missing = size - sum(map(len, self._held))
            if len(rows) < missing:
                self._held.append(rows.copy())
                return
            pieces = [*self._held, rows[:missing]]
            rows = rows[missing:]
            yield self._first, pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
            self._held = []
            self._first += size


def deflate_chunks(
    values: NDArray[Any], chunk: tuple[int, ...], fill_value: Any
) -> Iterator[tuple[Offset, bytes]]:
    """Cut an array into chunks, and shuffle and deflate each.

    Equal values give equal bytes, with one version of ISA-L and zlib and one architecture of
    processor.

    Parameters
    ----------
    values : ndarray, shape (n_0, ..., n_k)
        In the byte order of the file, with any memory layout.
    chunk : tuple of int, length k + 1
        Elements of a chunk along each axis, each at least 1.
    fill_value : scalar
        Fills the part of a last chunk beyond the array, as HDF5 does.

    Yields
    ------
    offset : tuple of int
        Index of the chunk's first element.
    data : bytes
        A zlib stream.
    """
    corners = (range(0, size, step) for size, step in zip(values.shape, chunk, strict=True))
    for offset in itertools.product(*corners):
        part = values[tuple(slice(at, at + step) for at, step in zip(offset, chunk, strict=True))]
        if part.shape != chunk:
            whole = np.full(chunk, fill_value, dtype=values.dtype)
            whole[tuple(slice(size) for size in part.shape)] = part
            part = whole
        yield offset, _deflate(part)


def _deflate(part: NDArray[Any]) -> bytes:
    if part.nbytes <= _SMALL:
        return zlib.compress(b"".join(map(bytes, _planes(part))), _SMALL_LEVEL)
    compressor = isal_zlib.compressobj(_LEVEL)
    pieces: list[bytes] = []
    for plane in _planes(part):
        # Byte planes have different statistics and share no repeated strings.
        pieces += compressor.compress(plane), compressor.flush(isal_zlib.Z_FULL_FLUSH)
    return b"".join((*pieces, compressor.flush()))


def _planes(part: NDArray[Any]) -> Iterator[NDArray[np.uint8]]:
    """Yield the first bytes of all elements, then the second bytes: the order of HDF5's `shuffle`.

    Parameters
    ----------
    part : ndarray
        Elements have 1, 2, 4 or 8 bytes.

    Yields
    ------
    ndarray of uint8, shape (size,)
    """
    plain = np.ascontiguousarray(part).reshape(-1)
    words = plain.view(f"<u{plain.itemsize}")
    for shift in range(0, 8 * plain.itemsize, 8):
        yield (words >> words.dtype.type(shift)).astype(np.uint8)

"""Pixels of images, and their encoding as PNG."""

from __future__ import annotations

import struct
import zlib
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.panels import Palette

Floats = NDArray[np.float64]

BLANK: Final = 0
"""Pixel without data, transparent."""
REJECTED: Final = 1
"""Stripes over rejected blocks, of two light greys; the second is the next value."""
NEGATIVE: Final = 3
"""A usable block at or below zero, which a logarithmic scale cannot show: grey."""
_FIRST: Final = 4
"""Pixel of the low end of the colour scale."""
_COLOURS: Final = 252
"""Steps of the colour scale."""
_STRIPE: Final = 5
"""Width of a stripe, pixels."""
_ANCHORS: Final = {
    # viridis.
    Palette.SIGNAL: "440154 481567 482677 453781 404788 39568c 33638d 2d708e 287d8e 238a8d 1f968b"
    " 20a387 29af7f 3cbb75 55c667 73d055 95d840 b8de29 dce319 fde725",
    # cividis: its middle is grey, and it can be read with colour vision deficiency and in grey.
    Palette.SIGNED: "00224e 123570 3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838",
}


def steps(shares: Floats) -> NDArray[np.uint8]:
    """Return the pixels of shares of the colour scale, 0 to 1; blank for NaN."""
    inside = np.clip(np.nan_to_num(shares), 0.0, 1.0)
    level = _FIRST + np.rint(inside * (_COLOURS - 1)).astype(np.uint8)
    return np.where(np.isfinite(shares), level, BLANK).astype(np.uint8)


def ramp() -> NDArray[np.uint8]:
    """Return the colour scale as an image, shape (row, 1)."""
    return np.arange(_FIRST + _COLOURS - 1, _FIRST - 1, -1, dtype=np.uint8)[:, None]


def striped(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image whose rejected pixels are stripes, the first row on top."""
    height, width = image.shape
    stripes = (np.arange(height)[:, None] + np.arange(width)[None, :]) // _STRIPE % 2
    return np.where(image == REJECTED, REJECTED + stripes, image).astype(np.uint8)


def narrowed(image: NDArray[np.uint8], most: int) -> NDArray[np.uint8]:
    """Return an image of at most `most` columns: of those merged, the first pixel that has data."""
    merged = -(-image.shape[1] // most)
    parts = [image[:, start::merged] for start in range(merged)]
    narrow = parts[0].copy()
    for part in parts[1:]:
        left = narrow[:, : part.shape[1]]
        np.copyto(left, part, where=left == BLANK)
    return narrow


def png(pixels: NDArray[np.uint8], palette: Palette) -> bytes:
    """Return an indexed image as PNG.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (row, column)
        `BLANK`, `REJECTED`, `REJECTED` + 1, `NEGATIVE`, or of `steps`.
    palette : Palette
    """
    height, width = pixels.shape
    rows = np.zeros((height, width + 1), dtype=np.uint8)
    rows[:, 1:] = pixels
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        _chunk(kind, data)
        for kind, data in (
            (b"IHDR", header),
            (b"PLTE", _colours(palette)),
            (b"tRNS", b"\x00"),
            (b"IDAT", zlib.compress(rows.tobytes(), 6)),
            (b"IEND", b""),
        )
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    body = kind + data
    return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))


@cache
def _colours(palette: Palette) -> bytes:
    anchors = np.array([list(bytes.fromhex(word)) for word in _ANCHORS[palette].split()], float)
    places = np.linspace(0.0, len(anchors) - 1.0, _COLOURS)
    scale = [np.interp(places, np.arange(len(anchors)), anchors[:, c]) for c in range(3)]
    special = np.array(
        [[0, 0, 0], [206, 209, 213], [228, 230, 233], [128, 128, 128]], dtype=np.uint8
    )
    return np.concatenate([special, np.rint(np.stack(scale, -1)).astype(np.uint8)]).tobytes()

"""Physical values of raw files by the reader of one file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarops.raw import licel


def read_physical(
    paths: Sequence[str | os.PathLike[str]],
    channels: Iterable[str] | None = None,
    *,
    dtype: DTypeLike = np.float32,
) -> tuple[tuple[licel.Header, ...], dict[str, NDArray[Any]]]:
    """Return the headers and mV or MHz (file, bin) of files of one layout, by channel."""
    headers, values = [], {}
    for path in paths:
        header, counts = licel.read_counts(path, channels)
        scales = {dataset.name: dataset.scale for dataset in header.datasets}
        for name, own in counts.items():
            values.setdefault(name, []).append((own * scales[name]).astype(dtype))
        headers.append(header)
    return tuple(headers), {name: np.stack(rows) for name, rows in values.items()}

"""What is read of raw files, by the one function that reads counts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from lidarops.raw.formats import RawFormat


@contextmanager
def counts_read() -> Iterator[list[int]]:
    """Yield a list to which each channel that is read of a file adds its bytes of counts."""
    sizes: list[int] = []
    read = RawFormat.read_channel

    def counting(raw: RawFormat, file: Any, places: Any, stretches: Any, row: Any) -> None:
        sizes.append(len(places) * row.nbytes)
        read(raw, file, places, stretches, row)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RawFormat, "read_channel", counting)
        yield sizes

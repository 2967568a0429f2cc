"""Products that a disk has damaged."""

from __future__ import annotations

from pathlib import Path

import h5py


def damage_values(file: Path, variable: str) -> None:
    """Overwrite the first stored bytes of a variable, where deflate keeps its header."""
    with h5py.File(file, "r") as product:
        stored = product[variable].id
        chunked = product[variable].chunks is not None
        place = stored.get_chunk_info(0).byte_offset if chunked else stored.get_offset()
    with file.open("r+b") as stream:
        stream.seek(place)
        stream.write(b"\xff" * 8)

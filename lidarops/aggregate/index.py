"""The working catalogue of products: one Parquet file, one row a product.

It is derived from the products and can be written again at any time. What is found in it is
checked against the files when these are opened.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final
from uuid import UUID

import pandas as pd

from lidarops.aggregate._optional_packages import need
from lidarops.aggregate.facts import FOLDER, Facts, ProductSelection
from lidarops.aggregate.selection import select
from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.records import ProductKind
from lidarops.reports.run_record import write_atomically

INDEX: Final = "products.parquet"
FORMAT: Final = b"1"
_KEY: Final = b"lidarops_index"
_PREFIX_BYTES: Final = 16
_LEVEL: Final = 15
_ENCODINGS: Final = {
    # Neighbours begin alike: only what differs is stored.
    "path": "DELTA_BYTE_ARRAY",
    "start": "DELTA_BINARY_PACKED",
    "stop": "DELTA_BINARY_PACKED",
    "size": "DELTA_BINARY_PACKED",
    # No two are alike: a dictionary of them would only be in the way.
    "id": "PLAIN",
    "sha256_prefix": "PLAIN",
}

_Cell = Callable[[Facts], Any]
_COLUMNS: Final[Mapping[str, tuple[str, _Cell]]] = {
    "kind": ("dictionary", lambda each: each.kind.value),
    "campaign": ("dictionary", lambda each: each.campaign),
    "station": ("dictionary", lambda each: each.station),
    "instrument": ("dictionary", lambda each: each.instrument),
    "channel": ("dictionary", lambda each: each.channel),
    "mode": ("dictionary", lambda each: each.mode),
    "wavelength": ("float64", lambda each: each.wavelength),
    "start": ("time", lambda each: each.start),
    "stop": ("time", lambda each: each.stop),
    "latitude": ("float64", lambda each: each.latitude),
    "longitude": ("float64", lambda each: each.longitude),
    "altitude": ("float64", lambda each: each.altitude),
    "path": ("string", lambda each: each.path),
    "id": ("bytes", lambda each: UUID(each.id).bytes),
    "sha256_prefix": ("bytes", lambda each: bytes.fromhex(each.sha256)[:_PREFIX_BYTES]),
    "size": ("int64", lambda each: each.size),
    "profiles": ("int32", lambda each: each.profiles),
    "values": ("int64", lambda each: each.values),
    "usable": ("int64", lambda each: each.usable),
    "unflagged": ("int64", lambda each: each.unflagged),
    "grid": ("dictionary", lambda each: each.grid),
    "code_version": ("dictionary", lambda each: each.code_version),
}


@dataclass(frozen=True, slots=True)
class Found:
    """What an index knows of products that were asked for."""

    root: Path
    """Folder that the paths start from."""
    paths: tuple[str, ...]


def write_index(root: Path, products: Iterable[Facts]) -> str:
    """Write the index of products.

    Parameters
    ----------
    root : path
        Folder that the products' paths start from; the index goes to its folder ``aggregates``.
    products : iterable of Facts

    Returns
    -------
    str
        Path of the index relative to `root`.

    Raises
    ------
    LidarOpsError
        If pyarrow is not installed.
    OSError
        If the file cannot be written.
    """
    arrow, parquet = need("pyarrow"), need("pyarrow.parquet")
    rows = sorted(products, key=lambda each: each.path)
    types = _types(arrow)
    arrays = {
        name: arrow.array([cell(each) for each in rows], types[kind])
        for name, (kind, cell) in _COLUMNS.items()
    }
    for bit in Quality:
        counts = [each.flagged.get(str(bit.name), 0) for each in rows]
        arrays[_flag_column(bit)] = arrow.array(counts, arrow.int64())
    table = arrow.table(arrays).replace_schema_metadata({_KEY: FORMAT})
    stream = io.BytesIO()
    parquet.write_table(
        table,
        stream,
        compression="zstd",
        compression_level=_LEVEL,
        use_dictionary=[name for name in arrays if name not in _ENCODINGS],
        column_encoding=_ENCODINGS,
    )
    target = root / FOLDER / INDEX
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, stream.getvalue())
    return target.relative_to(root).as_posix()


def _types(arrow: Any) -> dict[str, Any]:
    return {
        "dictionary": arrow.dictionary(arrow.int32(), arrow.string()),
        "string": arrow.string(),
        "float64": arrow.float64(),
        "int32": arrow.int32(),
        "int64": arrow.int64(),
        "time": arrow.timestamp("ms", tz="UTC"),
        "bytes": arrow.binary(_PREFIX_BYTES),
    }


def _flag_column(bit: Quality) -> str:
    return f"flag_{str(bit.name).lower()}"


def find_products(
    index: str | os.PathLike[str],
    *,
    kind: ProductKind | str | None = None,
    channel: str | None = None,
    station: str | None = None,
    instrument: str | None = None,
    since: datetime | str | None = None,
    until: datetime | str | None = None,
) -> pd.DataFrame:
    """Find products in an index.

    Parameters
    ----------
    index : path or str
        ``aggregates/products.parquet`` of a campaign's output.
    kind, channel, station, instrument : str, optional
        Only products of these.
    since, until : datetime or ISO 8601 text, optional
        Only products that end after, or start before, this time; UTC where no zone is told.

    Returns
    -------
    pandas.DataFrame
        One row a product, by start, then path: ``path`` relative to ``attrs["root"]``, ``start``
        and ``stop``, place (degree, m), ``wavelength`` (m), ``id``, ``sha256_prefix`` (the first
        32 hexadecimal digits of the file's), ``size`` (bytes), counts of ``values``, of those
        ``usable`` (no bit rejects them) and ``unflagged``, and one count a quality bit.

    Raises
    ------
    ProductError
        If the file is no index.
    RetrievalInputError
        If the kind is unknown or a time is no ISO 8601.
    LidarOpsError
        If pyarrow is not installed.

    Examples
    --------
    >>> found = lidarops.find_products("demo/aggregates/products.parquet", kind="elastic")
    >>> found.query("usable > 0").path.tolist()  # doctest: +SKIP
    """
    wanted = select(kind, channel, station, instrument, since, until)
    path = Path(index)
    table = _read(path, wanted, None).to_pandas()
    found = table.sort_values(["start", "path"], ignore_index=True)
    found["id"] = [str(UUID(bytes=each)) for each in found["id"]]
    found["sha256_prefix"] = [each.hex() for each in found["sha256_prefix"]]
    found.attrs["root"] = str(_root(path))
    return found


def find_in_index(index: Path, wanted: ProductSelection) -> Found:
    """Return the paths of the products of an index that are wanted.

    Raises
    ------
    ProductError
        If the file is no index.
    LidarOpsError
        If pyarrow is not installed.
    """
    paths = _read(index, wanted, ["path"]).column("path").to_pylist()
    return Found(_root(index), tuple(sorted(paths)))


def _root(index: Path) -> Path:
    return index.resolve().parents[1]


def _read(index: Path, wanted: ProductSelection, columns: list[str] | None) -> Any:
    arrow, parquet = need("pyarrow"), need("pyarrow.parquet")
    try:
        metadata = parquet.read_schema(index).metadata or {}
        if metadata.get(_KEY) != FORMAT:
            raise ProductError(
                "is no index of this version of lidarops",
                file=index,
                remedy="write it again: lidarops aggregate",
            )
        return parquet.read_table(index, columns=columns, filters=_filters(wanted))
    except (OSError, arrow.ArrowInvalid) as error:
        raise ProductError(f"cannot be read as an index: {error}", file=index) from error


def _filters(wanted: ProductSelection) -> list[tuple[str, str, Any]] | None:
    names = ("channel", "station", "instrument")
    told = [(name, "==", getattr(wanted, name)) for name in names if getattr(wanted, name)]
    if wanted.kind is not None:
        told.append(("kind", "==", wanted.kind.value))
    if wanted.since is not None:
        told.append(("stop", ">", wanted.since))
    if wanted.until is not None:
        told.append(("start", "<", wanted.until))
    return told or None

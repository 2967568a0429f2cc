"""The index of products: a Parquet file with one row per product.

It is derived from the products and can be written again at any time. `open_products` opens the
files that a query gives, and takes from them what they state.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from uuid import UUID

from lidarops.aggregate import need
from lidarops.aggregate.facts import EVERYTHING, FOLDER, Facts, ProductSelection, parse_selection
from lidarops.errors import NO_FILE, LidarOpsError, ProductError
from lidarops.kinds import flags_of, kinds
from lidarops.records import Verdicts
from lidarops.system.code_version import module_version
from lidarops.system.files import last_change, sha256_of, write_atomically

if TYPE_CHECKING:
    import pandas as pd

INDEX: Final = "products.parquet"
FORMAT: Final = b"3"
"""Raised with every change of the columns."""
_KEY: Final = b"lidarops_index"
_READ_BY: Final = b"lidarops_facts"
"""Key of the version of the code that read the facts."""
_PREFIX_BYTES: Final = 16
_FLAG: Final = "flag_"
"""Beginning of the columns of counts of quality bits."""
_LEVEL: Final = 15
_ENCODINGS: Final = {
    # Neighbouring paths have equal beginnings.
    "path": "DELTA_BYTE_ARRAY",
    "start": "DELTA_BINARY_PACKED",
    "stop": "DELTA_BINARY_PACKED",
    "size": "DELTA_BINARY_PACKED",
    # All values differ, so a dictionary would not help.
    "id": "PLAIN",
    "sha256_prefix": "PLAIN",
}

_COLUMNS: Final = (
    ("dictionary", "kind campaign station instrument channel mode recorder"),
    ("float64", "wavelength"),
    ("time", "start stop"),
    ("float64", "latitude longitude altitude"),
    ("string", "path"),
    ("bytes", "id sha256_prefix"),
    ("int64", "size"),
    ("int32", "profiles"),
    ("int64", "values good care reject"),
    ("dictionary", "grid code_version"),
)
"""Type and names of columns, in their order."""


def write_index(root: Path, products: Iterable[Facts], as_of: float | None = None) -> str:
    """Write the index of products.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; the index is written to its ``aggregates``.
    products : iterable of Facts
    as_of : float, optional
        Time before which the products were as in `products`, s since 1970; by default now.

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
    rows = sorted(products, key=lambda facts: facts.path)
    types = _types(arrow)
    cells = [_cells(facts) for facts in rows]
    arrays = {
        name: arrow.array([row[name] for row in cells], types[kind])
        for kind, names in _COLUMNS
        for name in names.split()
    }
    known = [str(bit.name) for kind in kinds() for bit in flags_of(kind)]
    # Those of older products last.
    for name in dict.fromkeys([*known, *(name for facts in rows for name in facts.flagged)]):
        counts = [facts.flagged.get(name, 0) for facts in rows]
        arrays[f"{_FLAG}{name.lower()}"] = arrow.array(counts, arrow.int64())
    stated = {_KEY: FORMAT, _READ_BY: _facts_version()}
    table = arrow.table(arrays).replace_schema_metadata(stated)
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
    write_atomically(target, stream.getvalue(), as_of)
    return target.relative_to(root).as_posix()


def _cells(facts: Facts) -> dict[str, Any]:
    """Return the values of the columns of a product, by name."""
    stated = {item.name: getattr(facts, item.name) for item in fields(facts)}
    return {
        **stated,
        "values": facts.verdicts.values,
        **facts.verdicts._asdict(),
        "id": UUID(facts.id).bytes,
        "sha256_prefix": bytes.fromhex(facts.sha256)[:_PREFIX_BYTES],
    }


def _facts_version() -> bytes:
    """Return the version of the code that reads facts, with the kinds whose bits have columns."""
    return " ".join((module_version(Facts.__module__), *kinds())).encode()


class KnownFacts:
    """Facts of the products of a folder as its index states them.

    Parameters
    ----------
    root : path
        Nothing is known where it has no index, or one that other code wrote.
    hashed : bool
        Whether `Facts.sha256` is needed as a whole; else it may be what the index states of it.
    """

    def __init__(self, root: Path, *, hashed: bool = True) -> None:
        index = root / FOLDER / INDEX
        self._root, self._hashed = root, hashed
        self._written = 0.0
        self._rows: dict[str, dict[str, Any]] = {}
        self._given = 0
        with suppress(*NO_FILE, LidarOpsError):
            written = index.stat().st_mtime
            table = _read(index, EVERYTHING, None)
            if table.schema.metadata.get(_READ_BY) == _facts_version():
                self._written = written
                # A package that adds a kind may have gone.
                rows = (row for row in table.to_pylist() if row["kind"] in kinds())
                self._rows = {row["path"]: row for row in rows}

    def of(self, path: str) -> Facts | None:
        """Return the facts of a product that has not changed since; None where it may have."""
        row = self._rows.get(path)
        file = self._root / path
        # A file may vanish meanwhile.
        with suppress(OSError):
            if row is None or file.lstat().st_size != row["size"]:
                return None
            stated = row["sha256_prefix"].hex()
            settled = last_change(file) < self._written
            sha256 = stated if settled and not self._hashed else sha256_of(file)
            if sha256.startswith(stated):
                self._given += 1
                return _facts(row, sha256)
        return None

    def are(self, products: Sequence[Facts]) -> bool:
        """Return whether products are those of the index, and all came from it."""
        return 0 < len(self._rows) == self._given == len(products)


def _facts(row: dict[str, Any], sha256: str) -> Facts:
    """Return the facts that `_cells` turned into a row."""
    stated = {item.name: row[item.name] for item in fields(Facts) if item.name in row}
    counts = {name: n for name, n in row.items() if name.startswith(_FLAG) and n}
    return Facts(
        **stated | {"id": str(UUID(bytes=row["id"]))},
        sha256=sha256,
        verdicts=Verdicts(row["good"], row["care"], row["reject"]),
        flagged={name.removeprefix(_FLAG).upper(): count for name, count in counts.items()},
    )


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


def find_products(
    index: str | os.PathLike[str],
    *,
    kind: str | None = None,
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
        Select products.
    since, until : datetime or ISO 8601 text, optional
        Only products that end after, or start before, this time; UTC without a time zone.

    Returns
    -------
    pandas.DataFrame
        One row per product, sorted by start, then path: ``path`` relative to ``attrs["root"]``,
        ``start`` and ``stop``, place (degree, m), ``wavelength`` (m), ``id``, ``sha256_prefix``
        (first 32 hexadecimal digits of the sha256 of the file), ``size`` (bytes), numbers of
        ``values``, of ``good`` ones, of those to be used with ``care`` and of ones to ``reject``,
        and a count per quality bit.

    Raises
    ------
    ProductError
        If the file is not an index.
    RetrievalInputError
        If the kind is unknown or a time is not ISO 8601.
    LidarOpsError
        If pyarrow is not installed.

    Examples
    --------
    >>> found = lidarops.find_products("demo/aggregates/products.parquet", kind="elastic")
    >>> found.query("good + care > 0").path.tolist()  # doctest: +SKIP
    """
    selection = parse_selection(kind, channel, station, instrument, since, until)
    path = Path(index)
    table = _read(path, selection, None).to_pandas()
    found = table.sort_values(["start", "path"], ignore_index=True)
    found["id"] = [str(UUID(bytes=uuid)) for uuid in found["id"]]
    found["sha256_prefix"] = [prefix.hex() for prefix in found["sha256_prefix"]]
    found.attrs["root"] = str(_root(path))
    return found


def find_in_index(index: Path, selection: ProductSelection) -> tuple[Path, list[str]]:
    """Return the paths of selected products in an index, and the folder they are relative to.

    Raises
    ------
    ProductError
        If the file is not an index.
    LidarOpsError
        If pyarrow is not installed.
    """
    return _root(index), sorted(_sizes(index, selection))


def without_unselected(root: Path, paths: Iterable[str], selection: ProductSelection) -> list[str]:
    """Leave out the files of a folder that its index knows and a selection does not admit.

    A file that is not in the index, has another size, or changed after the index was written may
    be selected. So may all where there is no index that can be read.

    Parameters
    ----------
    root : path
    paths : iterable of str
        Relative to `root`.
    selection : ProductSelection

    Returns
    -------
    list of str
    """
    index = root / FOLDER / INDEX
    try:
        written = index.stat().st_mtime_ns
        sizes = _sizes(index, EVERYTHING)
        selected = _sizes(index, selection)
    except (*NO_FILE, LidarOpsError):
        return list(paths)

    def is_known(path: str) -> bool:
        state = (root / path).lstat()
        return sizes.get(path) == state.st_size and state.st_mtime_ns < written

    return [path for path in paths if path in selected or not is_known(path)]


def _sizes(index: Path, selection: ProductSelection) -> dict[str, int]:
    """Return the sizes of selected products by path."""
    table = _read(index, selection, ["path", "size"])
    return dict(zip(*(table.column(name).to_pylist() for name in ("path", "size")), strict=True))


def _root(index: Path) -> Path:
    return index.resolve().parents[1]


def _read(index: Path, selection: ProductSelection, columns: list[str] | None) -> Any:
    arrow, parquet = need("pyarrow"), need("pyarrow.parquet")
    try:
        metadata = parquet.read_schema(index).metadata or {}
        if metadata.get(_KEY) != FORMAT:
            raise ProductError(
                "is not an index of this version of lidarops",
                file=index,
                remedy="write it again: lidarops aggregate",
            )
        return parquet.read_table(index, columns=columns, filters=_filters(selection))
    except (OSError, arrow.ArrowInvalid) as error:
        raise ProductError(f"cannot be read as an index: {error}", file=index) from error


def _filters(selection: ProductSelection) -> list[tuple[str, str, Any]] | None:
    filters: list[tuple[str, str, Any]] = [
        (name, "==", value) for name, value in selection.names.items()
    ]
    if selection.since is not None:
        filters.append(("stop", ">", selection.since))
    if selection.until is not None:
        filters.append(("start", "<", selection.until))
    return filters or None

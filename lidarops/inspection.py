"""What a raw file or a product holds, as tables for the terminal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import xarray as xr
from rich.table import Table
from rich.text import Text

from lidarops.errors import LidarOpsError, ProductError, RawFormatError
from lidarops.products.provenance import read_provenance
from lidarops.raw import licel

_NETCDF_MAGIC = (b"CDF\x01", b"CDF\x02", b"CDF\x05", b"\x89HDF")


def tables(file: Path) -> list[Table]:
    """Describe a raw Licel file or a NetCDF product.

    Raises
    ------
    LidarOpsError
        If the file cannot be read, or is neither.
    """
    try:
        with file.open("rb") as stream:
            magic = stream.read(4)
    except OSError as error:
        raise LidarOpsError(f"cannot be read: {error.strerror}", file=file) from error
    return _product(file) if magic in _NETCDF_MAGIC else _raw(file)


def provenance(file: Path) -> str:
    """Return the PROV-JSON text of a product.

    Raises
    ------
    ProductError
        If the file is not a product of lidarops.
    """
    return json.dumps(read_provenance(file), indent=2)


def _raw(file: Path) -> list[Table]:
    try:
        header = licel.read_header(file)
    except RawFormatError as error:
        error.remedy = error.remedy or "lidarops inspect reads Licel files and NetCDF products"
        raise
    latitude, longitude = header.position("longitude_first")
    facts = {
        "site": header.site,
        "start": header.start.isoformat(),
        "stop": header.stop.isoformat(),
        "latitude, longitude": f"{latitude}, {longitude} (degree, longitude first in the header)",
        "altitude": f"{header.altitude} m",
        "zenith angle": f"{header.zenith_angle} degree",
        "notes": "; ".join(header.notes) or "none",
    }
    about = _table(file.name, "field", "value")
    for key, value in facts.items():
        _row(about, key, value)
    channels = _table("Channels", "name", "wavelength", "bins", "bin width", "shots", "device")
    for data in header.datasets:
        _row(
            channels,
            data.name,
            f"{data.wavelength * 1e9:g} nm",
            data.bins,
            f"{data.bin_width:g} m",
            data.shots,
            data.device,
        )
    return [about, channels]


def _product(file: Path) -> list[Table]:
    try:
        dataset = xr.open_dataset(file)
    except (OSError, ValueError, RuntimeError) as error:
        raise ProductError(f"cannot be opened: {error}", file=file) from error
    with dataset:
        about = _table(file.name, "attribute", "value")
        for key in ("title", "id", "time_coverage_start", "time_coverage_end", "history"):
            _row(about, key, dataset.attrs.get(key, "absent"))
        held = _table("Variables", "name", "dimensions", "units", "minimum", "maximum")
        for name, variable in dataset.data_vars.items():
            low, high = _extent(variable)
            shape = ", ".join(f"{dim} {size}" for dim, size in variable.sizes.items())
            _row(held, name, shape or "scalar", variable.attrs.get("units", ""), low, high)
        return [about, held]


def _extent(variable: xr.DataArray) -> tuple[str, str]:
    if variable.dtype.kind not in "fiu" or variable.size == 0:
        return "", ""
    return f"{float(variable.min()):.4g}", f"{float(variable.max()):.4g}"


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _row(table: Table, *cells: Any) -> None:
    # Text, because a header may hold what rich would take for markup.
    table.add_row(*(Text(str(cell)) for cell in cells))

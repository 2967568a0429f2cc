"""Regenerate the golden texts: ``make golden``. Read the changes before committing them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from golden.cdl import dump
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, PLACED, context

from lidarops.netcdf.write import write_product

FOLDER = Path(__file__).parent
BEAMS: dict[str, dict[str, Any]] = {
    "vertical": {"zenith": 0.0},
    "slanting": {"zenith": 80.0, "azimuth": 90.0},
}


def plain(data: xr.Dataset) -> xr.Dataset:
    """Return results with numbers that no generator of random numbers has made."""
    found = data.copy(deep=True)
    for name, variable in data.data_vars.items():
        if variable.dtype.kind == "f" and variable.ndim:
            steps = 1e-4 * (1.0 + np.arange(variable.size) / variable.size)
            found[name] = variable.copy(data=steps.reshape(variable.shape)).where(
                variable.notnull()
            )
    return found


def texts(folder: Path) -> Iterator[tuple[str, str]]:
    """Give name and text of the golden product of each kind and beam."""
    for kind in MAKERS:
        for beam, angles in ({"several_beams": {}} if kind in PLACED else BEAMS).items():
            path = folder / f"{kind}_{beam}.nc"
            write_product(build_product(plain(MAKERS[kind](**angles)), context(kind)), path)
            yield f"{path.stem}.cdl", dump(path)


def main() -> None:
    """Replace the texts in this folder."""
    for old in FOLDER.glob("*.cdl"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        for name, text in texts(Path(folder)):
            (FOLDER / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

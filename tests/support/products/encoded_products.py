"""Products as encoded datasets, to look at without a file."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import xarray as xr

from lidarops.netcdf.context import Context
from lidarops.netcdf.product_file import ProductWriter


def build_product(data: xr.Dataset, context: Context) -> xr.Dataset:
    """Return a product as `xarray.open_dataset(..., decode_cf=False)` shows its file."""
    writer = ProductWriter(data, context, Path(), ExitStack())
    encoded = writer.encode(data)
    skeleton = writer.skeleton(encoded)
    product = xr.Dataset(
        {
            name: variable.copy(deep=False, data=encoded.get(name, variable.values))
            for name, variable in skeleton.variables.items()
        },
        attrs=dict(skeleton.attributes),
    )
    product.encoding["unlimited_dims"] = {skeleton.unlimited}
    return product

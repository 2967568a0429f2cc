"""Products as encoded datasets, to look at without a file."""

from __future__ import annotations

import xarray as xr

from lidarops.netcdf.build import Context, ProductEncoder


def build_product(data: xr.Dataset, context: Context) -> xr.Dataset:
    """Return a product as `xarray.open_dataset(..., decode_cf=False)` shows its file."""
    encoder = ProductEncoder(data, context)
    encoded = encoder.encode(data)
    skeleton = encoder.skeleton(encoded)
    product = xr.Dataset(
        {
            name: variable.copy(deep=False, data=encoded.get(name, variable.values))
            for name, variable in skeleton.variables.items()
        },
        attrs=dict(skeleton.attributes),
    )
    product.encoding["unlimited_dims"] = {skeleton.unlimited}
    return product

"""The layout of every kind of product, and the dataset that is built with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import xarray as xr

from lidarops.netcdf.build import build_dataset
from lidarops.netcdf.context import Context
from lidarops.netcdf.variables import Layout
from lidarops.products.elastic.variables import ELASTIC
from lidarops.products.homogeneous.variables import HOMOGENEOUS
from lidarops.products.multiangle.variables import MULTIANGLE
from lidarops.products.signal.variables import SIGNAL
from lidarops.products.visibility.variables import VISIBILITY
from lidarops.records import ProductKind

_OWN = {
    ProductKind.SIGNAL: SIGNAL,
    ProductKind.HOMOGENEOUS: HOMOGENEOUS,
    ProductKind.ELASTIC: ELASTIC,
    ProductKind.MULTIANGLE: MULTIANGLE,
    ProductKind.VISIBILITY: VISIBILITY,
}

LAYOUTS: Final[Mapping[ProductKind, Layout]] = {
    # The step that makes a product has the name of its kind and serves no other kind.
    kind: replace(layout, unused_steps=layout.unused_steps | (set(ProductKind) - {kind}))
    for kind, layout in _OWN.items()
}
"""Layout of each kind of product."""


def build_product(data: xr.Dataset, context: Context) -> xr.Dataset:
    """Return the encoded product of one scene, kind and channel.

    Parameters
    ----------
    data : xr.Dataset
        Every variable of the kind, in memory; see `lidarops.netcdf.build.build_dataset`.
    context : Context
        Kind, channel, station, instrument, campaign, scene and provenance of the product.

    Returns
    -------
    xr.Dataset
        Encoded, as `xarray.open_dataset(..., decode_cf=False)` shows the file.

    Raises
    ------
    ProductError
        Where `data` does not match the layout of the kind.
    """
    return build_dataset(data, context, LAYOUTS[context.kind])

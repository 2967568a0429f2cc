"""What a product of scans may hold besides its profiles."""

from __future__ import annotations

import numpy as np
import pytest
from made_products import STATION, context, multiangle

from lidarops.errors import ProductError
from lidarops.products.build import build
from lidarops.records import ProductKind


def with_layers(profiles: int = 5):
    tops = STATION.altitude + 60.0 * np.array([[0.0, 2.0], [1.0, 4.0]])
    dims, shape = ("time", "layer"), (profiles, 2)
    return multiangle(profiles).assign(
        layer_optical_depth=(dims, np.full(shape, 0.1)),
        layer_optical_depth_standard_error=(dims, np.full(shape, 0.01)),
        layer_optical_depth_gradient_error=(dims, np.full(shape, 0.005)),
        layer_altitude=("layer", tops.mean(axis=1)),
        layer_bnds=(("layer", "nv"), tops),
    )


def test_layers_have_their_errors():
    product = build(with_layers(), context(ProductKind.MULTIANGLE))
    layer = product["layer_optical_depth"]
    assert layer.dims == ("time", "layer")
    np.testing.assert_allclose(layer, 0.1, rtol=1e-3)
    told = set(layer.attrs["ancillary_variables"].split())
    assert {f"layer_optical_depth_{kind}_error" for kind in ("standard", "gradient")} == told
    assert product["layer_optical_depth_gradient_error"].attrs["error_kind"] == "systematic"


def test_layers_come_with_their_errors_or_not_at_all():
    plain = build(multiangle(), context(ProductKind.MULTIANGLE))
    assert not [name for name in plain.variables if str(name).startswith("layer")]
    assert "monotone_optical_depth" in plain
    bad = with_layers()
    bad = bad.assign(layer_optical_depth_standard_error=-bad["layer_optical_depth"])
    with pytest.raises(ProductError, match="valid range"):
        build(bad, context(ProductKind.MULTIANGLE))

"""Optional variables of the ``multiangle`` product."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from support.products.encoded_products import build_product
from support.products.made_products import context, multiangle

from lidarops.errors import ProductError
from lidarops.products.multiangle.retrieval import blocked_in_words


def test_layers_have_their_errors():
    product = build_product(multiangle(), context("multiangle"))
    layer = product["layer_vertical_optical_depth"]
    assert layer.dims == ("time", "layer")
    np.testing.assert_allclose(layer[1:], 0.1, rtol=1e-3)
    ancillaries = set(layer.attrs["ancillary_variables"].split())
    assert {
        f"layer_vertical_optical_depth_{kind}_error" for kind in ("standard", "gradient")
    } == ancillaries
    assert (
        product["layer_vertical_optical_depth_gradient_error"].attrs["error_kind"] == "systematic"
    )


def test_layers_need_their_errors_and_altitudes():
    plain = build_product(multiangle(layers=False), context("multiangle"))
    assert not [name for name in plain.variables if str(name).startswith("layer")]
    whole = multiangle()
    named = (
        "layer_vertical_optical_depth_standard_error",
        "layer_vertical_optical_depth_gradient_error",
    )
    for name in (*named, "layer_altitude", "layer_bnds"):
        with pytest.raises(ProductError) as caught:
            build_product(whole.drop_vars(name), context("multiangle"))
        assert caught.value.field == name
    bad = whole.assign(
        layer_vertical_optical_depth_standard_error=-whole["layer_vertical_optical_depth"]
    )
    with pytest.raises(ProductError, match="valid range"):
        build_product(bad, context("multiangle"))


def test_each_optional_row_may_be_left_out():
    optional = (
        "monotone_vertical_optical_depth",
        "reduced_chi2",
        "regularisation",
        "prior_vertical_optical_depth",
    )
    for name in optional:
        product = build_product(multiangle().drop_vars(name), context("multiangle"))
        assert name not in product
        assert name in build_product(multiangle(), context("multiangle"))


def test_blocked_low_beams_are_one_note():
    elevation = np.array([3.0, 5.0, 5.0, 60.0])
    product = xr.Dataset(
        {"beam_obstruction": (("time", "beam"), [[200.0, np.nan, np.nan, np.nan]] * 2)},
        coords={
            "beam_zenith_angle": ("beam", 90.0 - elevation),
            "beam_azimuth": ("beam", [87.0, 87.0, 127.0, 87.0]),
        },
    )
    assert blocked_in_words(product.isel(beam=[1, 2, 3])) == []
    product["beam_obstruction"][1, 2:] = 900.0
    # The steepest one is behind a cloud.
    assert blocked_in_words(product) == [
        (
            "blocked beams: elevation 3 (azimuth 87), 5 (azimuth 127) degree, from the range in"
            " beam_obstruction of the product"
        )
    ]

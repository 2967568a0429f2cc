"""The size and the time of the figures of long products."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.products.drawn import figures, images, labelled, views
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops.figures import browser
from lidarops.figures.raster import COLUMNS

LONG: dict[str, dict[str, Any]] = {
    "signal": {"profiles": 1440, "bins": 800},
    "homogeneous": {"profiles": 10_000, "sections": 6},
    "elastic": {"profiles": 720, "bins": 800},
    "raman": {"profiles": 720, "bins": 250},
    "multiangle": {
        "profiles": 300,
        "levels": 150,
        "zenith": np.linspace(0.0, 80.0, 16),
        "azimuth": 90.0,
    },
    "visibility": {"profiles": 2000, "crossings": 20, "zenith": np.full(8, 85.0)},
}
VIEWS = [(kind, name) for kind in MAKERS for name in views(kind)]
MOST_BYTES = 300_000
"""Size of a figure."""
MOST_SECONDS = 0.1
"""CPU time of a figure."""


@pytest.fixture(scope="module")
def products() -> dict[str, xr.Dataset]:
    """A long product of each kind, with noise, which compresses worst, in its images."""
    return {
        kind: xr.decode_cf(build_product(MAKERS[kind](**LONG[kind]), context(kind)))
        for kind in MAKERS
    }


@pytest.mark.parametrize(("kind", "name"), VIEWS)
def test_a_figure_of_a_long_product_is_small_and_soon_drawn(products, kind, name):
    view, product = views(kind)[name], products[kind]
    content = view.read(product, COLUMNS)
    assert content is not None
    sizes, seconds = [], []
    # CPU time, the least of five: another process may take the caches of the processor.
    for _ in range(5):
        begin = time.process_time()
        sizes = [len(browser.inline(figure)) for figure in view.draw([content])]
        seconds.append((time.process_time() - begin) / len(sizes))
    assert max(sizes) <= MOST_BYTES
    assert min(seconds) <= MOST_SECONDS


_EQUAL = partial(np.array_equal, equal_nan=True)
SHOWN = [
    ("signal", "signal", "range-corrected signal", "signal"),
    ("elastic", "elastic-aerosol-backscatter", "aerosol backscatter", "aerosol_backscatter"),
    ("elastic", "profile", "backscatter", "aerosol_backscatter"),
    ("raman", "raman-aerosol-extinction", "aerosol extinction", "aerosol_extinction"),
    *(
        ("raman", "profile", name.replace("_", " "), name)
        for name in ("aerosol_extinction", "aerosol_backscatter", "lidar_ratio")
    ),
    ("multiangle", "multiangle-total-extinction", "total extinction", "total_extinction"),
    ("multiangle", "profile", "total extinction", "total_extinction"),
    ("multiangle", "profile", "vertical optical depth", "vertical_optical_depth"),
]


@pytest.mark.parametrize(("kind", "name", "label", "variable"), SHOWN)
def test_a_panel_shows_the_variable_that_it_names(products, kind, name, label, variable):
    """Another variable of the same dimensions changes nothing of it."""
    product = products[kind].isel(time=slice(0, 20)).load()

    def drawn(changed: str) -> list[Any]:
        scaled = product.assign({changed: product[changed].copy(data=product[changed] * 1.3)})
        (panel,) = (
            panel
            for figure in figures(kind, name, [scaled])
            for panel in figure.panels
            if (panel.bar or panel.x).label.startswith(label)
        )
        return [layer.codes for layer in images(panel)] or [
            layer.x for layer in labelled(panel, "retrieved")
        ]

    unchanged = drawn("station_altitude")
    assert unchanged
    assert not all(map(_EQUAL, drawn(variable), unchanged))
    for other in {row[-1] for row in SHOWN} & set(product) - {variable}:
        assert all(map(_EQUAL, drawn(other), unchanged)), other

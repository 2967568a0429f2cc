"""Files of every kind and pointing, for tests with tools of other people."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops.netcdf.write import write_product

BEAMS = {
    "vertical": {"zenith": 0.0},
    "horizontal": {"zenith": 90.0, "azimuth": 200.0},
    "scan": {"zenith": [0.0, 30.0, 60.0, 80.0, 90.0], "azimuth": [0.0, 1.0, 2.0, 3.0, 4.0]},
}
LEVEL = ("homogeneous", "visibility")
"""Kinds of level beams."""
CASES = [
    pytest.param((kind, beam), id=f"{kind}-{beam}")
    for kind in MAKERS
    for beam in ("horizontal" if kind in LEVEL else "vertical", "scan")
]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """Return a function that gives the file of a kind and pointing, written once."""
    folder = tmp_path_factory.mktemp("products")

    def path(kind: str, beam: str) -> Path:
        file = folder / f"{kind}_{beam}.nc"
        if not file.exists():
            write_product(build_product(MAKERS[kind](**BEAMS[beam]), context(kind)), file)
        return file

    return path


@pytest.fixture(scope="session", params=CASES)
def product(request: pytest.FixtureRequest, made: Callable[[str, str], Path]) -> Path:
    """The file of each kind and pointing."""
    return made(*request.param)

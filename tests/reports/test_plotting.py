"""The figures that `lidarops plot` draws of one file."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import xarray as xr
from support.archives import raw_archives
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.figures.panels import Curve
from lidarops.netcdf.write import write_product
from lidarops.reports.plotting import draw_file


@pytest.mark.parametrize("kind", list(MAKERS))
def test_products_of_every_kind_are_drawn(kind: str, tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(MAKERS[kind](), context(kind)), path)
    shown = CliRunner().invoke(app, ["plot", str(path), "--out", str(tmp_path / "figures")])
    assert shown.exit_code == 0, shown.output
    figures = sorted((tmp_path / "figures").iterdir())
    assert len(figures) == len(draw_file(path))
    for figure in figures:
        assert ET.parse(figure).getroot().tag.endswith("svg")
        assert figure.name in shown.output


def test_a_raw_file_is_drawn_with_the_means_of_its_bins(tmp_path: Path):
    path = raw_archives.write(tmp_path / "h0", raw_archives.content(bins=4000))
    photon, analog = draw_file(path)
    with xr.open_dataset(path, engine="licel") as opened:
        for name, figure in (("photon_532o", photon), ("analog_532o", analog)):
            (curve,) = figure.panels[0].layers
            assert isinstance(curve, Curve)
            assert curve.label == name
            assert curve.x.size <= 800
            signal = opened[name].values[0].astype(float).reshape(curve.x.size, -1)
            ranges = opened["range"].values.reshape(curve.x.size, -1)
            np.testing.assert_allclose(curve.y, signal.mean(axis=1), rtol=1e-6)
            np.testing.assert_allclose(curve.x, 1e-3 * ranges.mean(axis=1), rtol=1e-6)


def test_other_files_are_refused(tmp_path: Path):
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "other.nc")
    (tmp_path / "notes.txt").write_text("words " * 40)
    for name, words, code in (
        ("other.nc", "no product of lidarops", 1),
        ("notes.txt", "no known raw format", 1),
        ("absent", "cannot be read", 2),
    ):
        shown = CliRunner().invoke(app, ["plot", str(tmp_path / name)])
        assert shown.exit_code == code, shown.output
        assert words in shown.output

"""The figures that `lidarops plot` draws of one file."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import xarray as xr
from PIL import Image as Pictures
from support.archives import raw_archives
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.figures.panels import Band, Curve, Image
from lidarops.netcdf.write import write_product
from lidarops.reports.plotting import Selection, draw_file


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(MAKERS))
def test_products_of_every_kind_are_drawn(kind: str, tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(MAKERS[kind](), context(kind)), path)
    target = tmp_path / "figures" / "quicklook.png"
    shown = CliRunner().invoke(app, ["plot", str(path), "--out", str(target)])
    assert shown.exit_code == 0, shown.output
    figures = sorted(target.parent.iterdir())
    assert len(figures) == len(draw_file(path))
    for figure in figures:
        with Pictures.open(figure) as picture:
            assert picture.width == 1440
        assert figure.name in shown.output


@pytest.fixture
def elastic(tmp_path: Path) -> Path:
    path = tmp_path / "elastic.nc"
    write_product(build_product(MAKERS["elastic"](), context("elastic")), path)
    return path


def plotted(path: Path, *options: str) -> Path:
    target = path.with_name("figure.svg")
    shown = CliRunner().invoke(app, ["plot", str(path), "-o", str(target), *options])
    assert shown.exit_code == 0, shown.output
    return target


def test_a_variable_is_drawn_as_an_image_or_against_time(elastic: Path):
    with xr.open_dataset(elastic) as product:
        names = {"aerosol_extinction": 2, "reference_top": 1, "aerosol_backscatter": 2}
        for name, dims in names.items():
            assert product[name].ndim == dims
            (figure,) = draw_file(elastic, Selection(name))
            main = figure.panels[0].layers
            assert isinstance(main[0], Image) is (dims == 2)
            assert ET.parse(plotted(elastic, "--variable", name)).getroot().tag.endswith("svg")


def test_a_variable_of_an_unknown_kind_is_drawn_too(elastic: Path):
    with xr.open_dataset(elastic, decode_timedelta=False) as opened:
        product = opened.load().assign_attrs(lidarops_kind="wind")
    product.to_netcdf(elastic.with_name("wind.nc"))
    for name, layer in (("aerosol_backscatter", Image), ("reference_top", Band)):
        (figure,) = draw_file(elastic.with_name("wind.nc"), Selection(name))
        assert isinstance(figure.panels[0].layers[0], layer)


def test_times_ranges_and_altitudes_are_chosen(elastic: Path):
    with xr.open_dataset(elastic) as product:
        times = product["time"].values
        ranges = product["range"].values
    spans = {"time": (times[1], times[2]), "range": (float(ranges[5]), float(ranges[19]))}
    chosen = Selection("aerosol_backscatter", spans)
    (figure,) = draw_file(elastic, chosen)
    image = figure.panels[0].layers[0]
    assert isinstance(image, Image)
    assert image.codes.shape[0] == 2
    assert image.edges.size - 1 <= 15
    span = f"{times[1]}/{times[2]}"
    plotted(elastic, "--time", span, "--range", "0.05/0.2", "--variable", "aerosol_backscatter")


@pytest.mark.parametrize(
    "options",
    [
        ("--variable", "nothing"),
        ("--time", "yesterday"),
        ("--time", "1999-01-01/1999-01-02"),
        ("--range", "1"),
        ("-o", "figure.gif"),
    ],
)
def test_choices_that_mean_nothing_are_wrong_use(elastic: Path, options: tuple[str, ...]):
    shown = CliRunner().invoke(app, ["plot", str(elastic), *options])
    assert shown.exit_code == 2, shown.output


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

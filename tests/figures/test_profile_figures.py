"""Profiles of products, drawn from files as the engine writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.products import fabricated as fab
from support.products.drawn import figures, labelled
from support.products.encoded_products import build_product
from support.products.fabricated import START, Archive
from support.products.made_products import MAKERS, context, elastic

from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.netcdf.write import write_product
from lidarops.products.elastic.figures import FIGURES
from lidarops.reports import gallery
from lidarops.retrieve.elastic.flags import ElasticQuality

MEGA = 1e6
PROFILE = FIGURES.views[-1]
CAUSES = ("noise", "background", "reference", "lidar_ratio", "molecular", "dead_time", "baseline")


def stored(path: Path, data: xr.Dataset, kind: str = "elastic") -> xr.Dataset:
    """Build and write a product, and read it back as a report does."""
    write_product(build_product(data, context(kind)), path)
    with xr.open_dataset(path, decode_timedelta=False) as opened:
        return opened.load()


@pytest.fixture
def made() -> xr.Dataset:
    """Return eight profiles to 300 m; the first has a cloud at 40 m, the last no reference."""
    return elastic(profiles=8)


def drawn(product: xr.Dataset, kind: str = "elastic"):
    (figure,) = figures(kind, "profile", [product])
    return figure


def test_the_profile_with_most_unflagged_values_is_drawn_to_its_last_usable_one(made, tmp_path):
    made["quality_flag"][1:4, 10:20] |= np.int32(Quality.PILE_UP)
    made["quality_flag"][5:7, 10:12] |= np.int32(Quality.PILE_UP)
    product = stored(tmp_path / "flags.nc", made)
    figure = drawn(product)
    assert str(product["time"].values[4])[11:19] in figure.caption
    flag = product["quality_flag"].values[4]
    values = MEGA * product["aerosol_backscatter"].values[4]
    good = ((flag & flags_of("elastic").rejecting) == 0) & np.isfinite(values)
    (line,) = labelled(figure.panels[0], "retrieved")
    last = min(np.flatnonzero(good)[-1] + 1, (product["range"].values < 1.15 * 250.0).sum())
    assert line.x.size == last
    np.testing.assert_allclose(line.x[good[:last]], values[:last][good[:last]])
    assert np.isnan(line.x[~good[:last]]).all()
    (band,) = labelled(figure.panels[0], "standard error")
    error = MEGA * product["aerosol_backscatter_standard_error"].values[4]
    np.testing.assert_allclose(((band.high - band.low) / 2)[good[:last]], error[:last][good[:last]])


def test_elastic_shows_air_reference_window_and_error_budget(made, tmp_path):
    product = stored(tmp_path / "elastic.nc", made)
    left, right = drawn(product).panels
    (air,) = labelled(left, "molecular backscatter")
    np.testing.assert_allclose(air.x, MEGA * product["molecular_backscatter"].values[: air.x.size])
    (window,) = labelled(left, "reference window")
    np.testing.assert_allclose(window.along, [0.2, 0.25])
    assert [layer.label for layer in right.layers] == [
        *(cause.replace("_", " ") for cause in CAUSES),
        "total",
    ]
    content = PROFILE.read(product, None)
    for cause, curve in zip(CAUSES, right.layers, strict=False):
        errors = MEGA * np.abs(content[f"aerosol_backscatter_error_{cause}"].values)
        known = np.isfinite(curve.x)
        np.testing.assert_allclose(curve.x[known], errors[known])
    assert "Mm⁻¹ sr⁻¹" in right.x.label


def test_values_to_use_with_care_and_not_to_use_are_marked(made, tmp_path):
    made["quality_flag"][:, 10:13] |= np.int32(Quality.PILE_UP)
    made["quality_flag"][:, 5] |= np.int32(Quality.SATURATED)
    panel = drawn(stored(tmp_path / "care.nc", made)).panels[0]
    (marks,) = labelled(panel, "use with care")
    assert {*made["range"].values[10:13] / 1e3} <= {*marks.y.round(9)}
    (crosses,) = labelled(panel, "do not use")
    assert made["range"].values[5] / 1e3 in crosses.y.round(9)


def test_flagged_values_are_counted_before_some_are_left_out(tmp_path):
    made = elastic(profiles=2, bins=700)
    made["quality_flag"][:] = 0
    for name in made.data_vars:
        if made[name].dims == ("time", "range"):
            made[name][:] = made[name].fillna(1e-6)
    made["reference_top"][:] = 1e5
    made["quality_flag"][:, 100:140] |= np.int32(Quality.PILE_UP)
    figure = drawn(stored(tmp_path / "long.nc", made))
    assert "40 of 700 values flagged" in figure.words
    (marks,) = labelled(figure.panels[0], "use with care")
    assert marks.label == "use with care: 40 values"
    (line,) = labelled(figure.panels[0], "retrieved")
    assert line.x.size <= 300


@pytest.mark.filterwarnings("error")
def test_only_values_up_to_just_beyond_the_window_choose_the_profile(made, tmp_path):
    made["quality_flag"][:] |= np.int32(Quality.SATURATED)
    beyond = np.flatnonzero(made["range"].values > 1.15 * 250.0)
    made["quality_flag"][:6, beyond] = 0
    product = stored(tmp_path / "beyond.nc", made)
    assert PROFILE.read(product, None) is None
    made["quality_flag"][6, 5:8] = 0
    product = stored(tmp_path / "one.nc", made)
    figure = drawn(product)
    assert str(product["time"].values[6])[11:19] in figure.caption
    (line,) = labelled(figure.panels[0], "retrieved")
    assert np.isfinite(line.x).sum() == 3


def test_none_without_a_usable_value(made, tmp_path):
    made["quality_flag"][:] |= np.int32(ElasticQuality.NO_REFERENCE)
    assert PROFILE.read(stored(tmp_path / "lost.nc", made), None) is None


def test_a_scan_shows_the_error_of_its_channel_and_the_bound_of_the_gradient(tmp_path):
    product = stored(tmp_path / "scan.nc", MAKERS["multiangle"](), "multiangle")
    names = ("vertical_optical_depth", "total_extinction")
    for name in names:
        product[f"{name}_dead_time_error"] = 3.0 * product[f"{name}_standard_error"]
    for panel, name, scale in zip(
        drawn(product, "multiangle").panels, names, (1, 1e3), strict=True
    ):
        (band,) = labelled(panel, "standard error, with the dead time error")
        (wide,) = labelled(panel, "largest gradient error")
        (line,) = labelled(panel, "retrieved")
        known = np.isfinite(line.x)
        time = np.flatnonzero(
            (scale * product[name].values[:, : line.x.size][:, known] == line.x[known]).all(axis=1)
        )[0]
        error = scale * product[f"{name}_standard_error"].values[time, : line.x.size] * np.sqrt(10)
        more = scale * product[f"{name}_gradient_error"].values[time, : line.x.size]
        np.testing.assert_allclose(((band.high - band.low) / 2)[known], error[known], rtol=1e-6)
        expected = (error + np.nan_to_num(more))[known]
        np.testing.assert_allclose(((wide.high - wide.low) / 2)[known], expected, rtol=1e-6)


def test_values_whose_errors_would_hide_all_others_do_not_set_the_axis(made, tmp_path):
    clear = drawn(stored(tmp_path / "clear.nc", made)).panels[0].x
    made["aerosol_backscatter_standard_error"][:, -14:-12] = 1.0
    axis = drawn(stored(tmp_path / "noisy.nc", made)).panels[0].x
    assert axis.high - axis.low < 1.2 * (clear.high - clear.low)


@pytest.mark.parametrize(
    "name", ["aerosol_backscatter", "aerosol_backscatter_error_noise", "quality_flag"]
)
def test_a_missing_variable_is_named(made, tmp_path, name):
    product = stored(tmp_path / "elastic.nc", made)
    with pytest.raises(ProductError) as caught:
        PROFILE.read(product.drop_vars(name), None)
    assert caught.value.field == name


IMAGES = ("Aerosol backscatter against time and range",)


class TestGallery:
    def run(self, archive: Archive, products: dict[str, xr.Dataset]) -> gallery.Gallery:
        made = []
        for name, data in products.items():
            path = archive.root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            whole = stored(path, data)
            kept = path.read_bytes()
            made.append(archive.write(name, whole, "elastic"))
            path.write_bytes(kept)
        (archive.root / "bad.nc").write_bytes(kept[:2000])
        scene = fab.outcome("horizontal_20240301T000000", START, products=tuple(made))
        return gallery.fill(fab.run_record(archive.root, [scene]))

    def test_a_run_shows_images_and_a_profile(self, archive, made):
        filled = self.run(archive, {"elastic.nc": made})
        assert not filled.problems
        assert [picture.caption.partition(":")[0] for picture in filled.pictures] == [
            *IMAGES,
            "Profile at 2026-03-01 10",
        ]
        for picture in filled.pictures:
            assert picture.caption.endswith(": 532 nm, photon counting (photon_532o), Lidar One")
            assert picture.figure.words

    def test_a_damaged_product_is_listed_and_the_others_are_drawn(self, archive, made):
        filled = self.run(archive, {"bad.nc": made, "good.nc": made.isel(time=slice(0, 6))})
        assert list(filled.problems) == ["bad.nc"]
        assert len(filled.pictures) == len(IMAGES) + 1

    def test_a_run_without_references_has_no_profile(self, archive, made):
        made["quality_flag"][:] |= np.int32(ElasticQuality.NO_REFERENCE)
        filled = self.run(archive, {"none.nc": made})
        assert [picture.caption.partition(":")[0] for picture in filled.pictures] == [*IMAGES]
        assert not filled.problems

"""Figures of elastic products, drawn from files as the engine writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.products import fabricated as fab
from support.products.drawn import figures, labelled
from support.products.encoded_products import build_product
from support.products.fabricated import START, Archive
from support.products.made_products import context, elastic

from lidarops.errors import ProductError
from lidarops.figures.raster import read_raster
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.netcdf.write import write_product
from lidarops.products.elastic.figures import CAUSES, clearest_profile
from lidarops.records import RunRecord
from lidarops.reports import gallery
from lidarops.retrieve.elastic.flags import ElasticQuality

MEGA = 1e6
QUANTITY = "attenuated_backscatter"


def stored(path: Path, data: xr.Dataset) -> xr.Dataset:
    """Build and write a product, and read it back as a report does."""
    write_product(build_product(data, context("elastic")), path)
    with xr.open_dataset(path, decode_timedelta=False) as opened:
        return opened.load()


@pytest.fixture
def made() -> xr.Dataset:
    """Return eight profiles to 300 m; the first has a cloud at 40 m, the last no reference."""
    return elastic(profiles=8)


@pytest.fixture
def product(made: xr.Dataset, tmp_path: Path) -> xr.Dataset:
    return stored(tmp_path / "elastic.nc", made)


class TestRaster:
    def test_means_are_over_usable_bins(self, product):
        raster = read_raster(product, quantity=QUANTITY, kind="elastic", profiles=4)
        rejected = (product["quality_flag"] & flags_of("elastic").rejecting) != 0
        values = product[QUANTITY].where(~rejected).to_numpy()
        assert raster.total.shape[0] == 2
        for column, members in enumerate((slice(0, 4), slice(4, 8))):
            total = np.nansum(values[members], axis=0)
            np.testing.assert_allclose(raster.total[column], total, rtol=1e-5)
        assert raster.units == "m-1 sr-1"
        assert raster.background_units == "MHz"

    def test_the_lowest_cloud_of_a_column_is_kept(self, made, tmp_path):
        made["cloud_base_range"][:] = [90.0, np.nan, 40.0, 60.0, *[np.nan] * 4]
        product = stored(tmp_path / "clouds.nc", made)
        raster = read_raster(product, quantity=QUANTITY, kind="elastic", profiles=4)
        np.testing.assert_array_equal(raster.clouds, [40.0, np.nan])
        none = read_raster(
            product.drop_vars("cloud_base_range"), quantity=QUANTITY, kind="elastic", profiles=4
        )
        assert np.isnan(none.clouds).all()

    @pytest.mark.parametrize("name", [QUANTITY, f"{QUANTITY}_standard_error", "quality_flag"])
    def test_a_missing_variable_is_named(self, product, name):
        with pytest.raises(ProductError) as caught:
            read_raster(product.drop_vars(name), quantity=QUANTITY, kind="elastic")
        assert caught.value.field == name


class TestClearestProfile:
    def test_has_the_most_unflagged_bins_below_its_reference(self, made, tmp_path):
        made["quality_flag"][1:4, 10:20] |= np.int32(Quality.PILE_UP)
        made["quality_flag"][5:7, 10:12] |= np.int32(Quality.PILE_UP)
        product = stored(tmp_path / "flags.nc", made)
        profile = clearest_profile(product)
        assert profile is not None
        assert profile.time == product["time"].to_numpy()[4]
        assert profile.reference == (200.0, 250.0)
        assert profile.lidar_ratio == (50.0, 50.0)
        assert profile.range[-1] <= 1.15 * 250.0 < profile.range[-1] + 7.5
        shown = slice(0, profile.range.size)
        flag = product["quality_flag"].to_numpy()[4, shown]
        good = (flag & flags_of("elastic").rejecting) == 0
        assert np.isnan(profile.backscatter[~good]).all()
        values = product["aerosol_backscatter"].to_numpy()[4, shown]
        np.testing.assert_allclose(profile.backscatter[good], values[good])
        for cause in CAUSES:
            errors = product[f"aerosol_backscatter_error_{cause}"].to_numpy()[4, shown]
            np.testing.assert_allclose(profile.budget[cause][good], np.abs(errors[good]))

    def test_bins_to_use_with_care_are_marked(self, made, tmp_path):
        made["quality_flag"][1:, 10:20] |= np.int32(Quality.PILE_UP)
        profile = clearest_profile(stored(tmp_path / "care.nc", made))
        assert profile is not None
        assert profile.with_care[10:20].all()
        assert not profile.with_care[20:].any()

    @pytest.mark.parametrize("lost", ["reference", "flags"])
    def test_none_where_no_profile_is_clear(self, made, tmp_path, lost):
        if lost == "reference":
            made["reference_bottom"][:] = np.nan
            made["reference_top"][:] = np.nan
        else:
            made["quality_flag"][:] |= np.int32(Quality.BACKGROUND_UNCERTAIN)
        assert clearest_profile(stored(tmp_path / "lost.nc", made)) is None

    @pytest.mark.parametrize(
        "name", ["aerosol_backscatter", "aerosol_backscatter_error_noise", "lidar_ratio"]
    )
    def test_a_missing_variable_is_named(self, product, name):
        with pytest.raises(ProductError) as caught:
            clearest_profile(product.drop_vars(name))
        assert caught.value.field == name


class TestErrorBudget:
    def test_curves_hold_the_profile_in_inverse_megametres(self, product):
        profile = clearest_profile(product)
        (figure,) = figures("elastic", "profile", [product])
        left, right = figure.panels
        (value,) = labelled(left, "particles")
        np.testing.assert_allclose(value.x, MEGA * profile.backscatter)
        np.testing.assert_allclose(value.y, profile.range / 1e3)
        (air,) = labelled(left, "molecules")
        np.testing.assert_allclose(air.x, MEGA * profile.molecular)
        (total,) = labelled(right, "total")
        np.testing.assert_allclose(total.x, MEGA * profile.standard_error)
        names = (
            "noise",
            "background",
            "reference",
            "lidar ratio",
            "molecules",
            "dead time",
            "baseline",
        )
        for cause, label in zip(CAUSES, names, strict=True):
            (curve,) = labelled(right, label)
            np.testing.assert_allclose(curve.x, MEGA * profile.budget[cause])
        for panel in (left, right):
            window = panel.layers[0]
            assert (window.low[0], window.high[0]) == (0.2, 0.25)
            assert "Mm⁻¹ sr⁻¹" in panel.x.label
        assert "reference window 0.2 to 0.25 km" in figure.words

    def test_bins_to_use_with_care_are_marked(self, made, tmp_path):
        made["quality_flag"][:, 10:20] |= np.int32(Quality.PILE_UP)
        (figure,) = figures("elastic", "profile", [stored(tmp_path / "care.nc", made)])
        (marks,) = labelled(figure.panels[0], "use with care")
        assert marks.y.size == 1


IMAGES = tuple(
    f"elastic-{name}"
    for name in ("aerosol-backscatter", "aerosol-extinction", "attenuated-backscatter")
)


def _run(archive: Archive, *paths_and_data) -> RunRecord:
    products = []
    for name, data in paths_and_data:
        path = archive.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = stored(path, data)
        kept = path.read_bytes()
        products.append(archive.write(name, whole, "elastic"))
        path.write_bytes(kept)
    scene = fab.outcome("horizontal_20240301T000000", START, products=tuple(products))
    return fab.run_record(archive.root, [scene])


class TestGallery:
    def test_a_run_shows_images_and_a_profile(self, archive, made, tmp_path):
        record = _run(archive, ("e/elastic.nc", made))
        drawn = gallery.fill(record)
        assert not drawn.problems
        assert [picture.view for picture in drawn.pictures] == [*IMAGES, "profile"]
        for picture in drawn.pictures:
            assert picture.caption.endswith(": 532 nm, photon counting, Lidar One")
            assert picture.figure.words
        assert drawn.flags

    def test_a_damaged_product_is_listed_and_the_others_are_drawn(self, archive, made, tmp_path):
        record = _run(archive, ("e/bad.nc", made), ("e/good.nc", made.isel(time=slice(0, 6))))
        bad = archive.root / "e/bad.nc"
        bad.write_bytes(bad.read_bytes()[:2000])
        drawn = gallery.fill(record)
        assert [problem.path for problem in drawn.problems] == ["e/bad.nc"]
        assert len(drawn.pictures) == len(IMAGES) + 1

    def test_a_run_without_references_has_no_profile(self, archive, made, tmp_path):
        made["quality_flag"][:] |= np.int32(ElasticQuality.NO_REFERENCE)
        made["reference_bottom"][:] = np.nan
        made["reference_top"][:] = np.nan
        drawn = gallery.fill(_run(archive, ("e/none.nc", made)))
        assert [picture.view for picture in drawn.pictures] == [*IMAGES]
        assert not drawn.problems

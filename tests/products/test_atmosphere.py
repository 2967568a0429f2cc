"""Products state their air, and their errors follow from its source and age."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives import sounding_texts

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.netcdf.read import read_origin
from lidarops.netcdf.variables import judging
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.run.archive import Options, reprocess
from lidarops.run.reproduction import reproduce_product
from lidarops.scene.air import GROWTH, SLOPE, SOURCE_ERROR
from lidarops.simulate.campaign import simulate_campaign

MIDDLE = datetime(2024, 9, 20, 21, 30, tzinfo=UTC)
BITS = {"elastic": ElasticQuality.STANDARD_AIR, "raman": RamanQuality.STANDARD_AIR}
SOURCE = "atmospheric_molecular_calculation_source"


@pytest.fixture(scope="module")
def folder(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An hour of the simulated night, with soundings at the station."""
    folder = tmp_path_factory.mktemp("night")
    tree = yaml.safe_load((repository / "catalogs/raman.yaml").read_text())
    tree |= {"archive": "raw", "output": "out"}
    tree["simulation"] |= {"duration": 3600}
    for instrument in tree["instruments"].values():
        for kind in BITS:
            # Below the top of the soundings.
            instrument["products"][kind].setdefault("reference", {})["highest"] = 10_000
    (folder / "campaign.yaml").write_text(yaml.safe_dump(tree))
    simulate_campaign(load_campaign(folder / "campaign.yaml"))
    for hours in (-2, 6):
        text = sounding_texts.wyoming_csv(MIDDLE + timedelta(hours=hours))
        place = f",{sounding_texts.LONGITUDE},{sounding_texts.LATITUDE},"
        (folder / f"s{hours}.csv").write_text(text.replace(place, ",11.1,47.8,"))
    return folder


def products(folder: Path, **source: Any) -> tuple[Campaign, dict[str, xr.Dataset]]:
    """Return campaign and products by kind, with a source of the air if one is given."""
    tree = yaml.safe_load((folder / "campaign.yaml").read_text())
    tree["atmosphere"] = {"valley": [source]} if source else {}
    (folder / "campaign.yaml").write_text(yaml.safe_dump(tree))
    campaign = load_campaign(folder / "campaign.yaml")
    record = reprocess(campaign, options=Options(force=True))
    assert record is not None
    (scene,) = record.scenes
    assert scene.error == ""
    paths = {one.kind: campaign.products_root / one.path for one in scene.products}
    return campaign, {kind: xr.load_dataset(paths[kind]) for kind in BITS}


def grid(product: xr.Dataset) -> dict[str, Any]:
    """Return what products that are joined along time have in common."""
    return {str(name): (one.dims, one.dtype) for name, one in product.variables.items()}


def test_nights_without_source_are_told_and_flagged(folder: Path) -> None:
    _, without = products(folder)
    _, made = products(folder, files="s*.csv", greatest_age="1h")
    # Their places are those of `ElasticQuality.STANDARD_AIR` and `RamanQuality.STANDARD_AIR`.
    for kind, bit in BITS.items():
        product = made[kind]
        assert (product[SOURCE].item(), without[kind][SOURCE].item()) == (0, 0)
        assert product["molecular_density_relative_error"].item() == pytest.approx(0.03)
        assert np.isnan(product["molecular_profile_age"].item())
        assert without[kind]["molecular_density_relative_error"].item() == pytest.approx(0.01)
        flags = [name for name in product if str(name).endswith("quality_flag")]
        for name in flags:
            assert np.all(product[name] & np.int32(bit))
            assert not np.any(without[kind][name] & np.int32(bit))
        for name in ("aerosol_backscatter", "aerosol_extinction"):
            judge = judging(name, [str(each) for each in product])
            assert product[judge].attrs["flag_meanings"].endswith("standard_air")


def test_errors_follow_from_source_and_age(folder: Path) -> None:
    _, without = products(folder)
    campaign, near = products(folder, files="s*.csv")
    error = np.sqrt(SOURCE_ERROR**2 + GROWTH**2 * (2.0 * 6.0 / 8.0 + 1.0 / 4.0))
    for kind, product in near.items():
        assert product[SOURCE].item() == 1
        assert product["molecular_profile_age"].item() == 7200.0
        # Nights with and without a source are one series.
        assert grid(product) == grid(without[kind])
        above = product["altitude"] > sounding_texts.HEIGHTS[-1] + 100.0
        for name in (name for name in product if str(name).endswith("quality_flag")):
            flagged = (product[name] & np.int32(BITS[kind])) != 0
            assert bool(flagged.sel(altitude=above).all())
            assert not bool(
                flagged.sel(altitude=product["altitude"] < sounding_texts.HEIGHTS[-1]).any()
            )
        assert product["molecular_profile_distance"].item() == pytest.approx(7470.0, abs=50.0)
        stated = product["molecular_density_relative_error"].item()
        assert stated == pytest.approx(error, rel=5e-3)
        assert "s-2.csv of 2024-09-20T19:30Z (0.75)" in str(product.attrs)
        path = next(campaign.products_root.rglob(f"*_{kind}_*.nc"))
        entities = read_origin(path)[0]["entity"]
        paths = [entity.get("lidarops:path") for entity in entities.values()]
        # Both files hold the same air, but other times.
        assert {"s-2.csv", "s6.csv"} <= set(paths)
        # By default 1 % of density, or 1.6e-5 m-1 of the derivative of its logarithm.
        name, expected = {
            "elastic": ("aerosol_backscatter_error_molecular", error / 0.01),
            "raman": ("aerosol_extinction_error_molecular", SLOPE * error / 1.6e-5),
        }[kind]
        ratio = product[name] / without[kind][name]
        assert float(ratio.median()) == pytest.approx(expected, rel=0.1)
        result = reproduce_product(path, archive=campaign.archive, ancillary=folder)
        assert result.identical, result.differences
        lost = (folder / "s6.csv").rename(folder / "s6.lost")
        (difference,) = reproduce_product(path, archive=campaign.archive).differences
        lost.rename(folder / "s6.csv")
        assert difference.name == "s6.csv"
        assert "--ancillary" in difference.problem

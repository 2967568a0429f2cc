"""Small archives on which other chains ran into trouble: products by `init` alone."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
import xarray as xr
from typer.testing import CliRunner

from lidarops.campaign.model import load_campaign
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.records import Status

ARCHIVES = {
    "public/licel": (8, {"signal": 41, "elastic": 13}),
    # 30 files hold no light of the laser.
    "cases/laser_off": (50, {"signal": 2, "elastic": 1}),
    "cases/pre_trigger": (60, {"signal": 8}),
    # The slanted files are in both of its folders.
    "cases/scan_without_line": (15, {"signal": 2, "multiangle": 2}),
    "cases/session_folders": (60, {"signal": 4, "elastic": 1}),
    "cases/telescope_off": (4, {"signal": 34, "elastic": 9}),
}
"""Folder -> files whose profiles are in products, and products by kind."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ARCHIVES)
def test_each_profile_is_in_products_or_its_file_refused(
    name: str, data_root: Path, tmp_path: Path
) -> None:
    if not (data_root / name).is_dir():
        pytest.skip(f"no archive {name}")
    file = str(tmp_path / "campaign.yaml")
    for words in (["init", str(data_root / name), file], ["plan", file], ["reprocess", file]):
        shown = CliRunner().invoke(app, words)
        assert shown.exception is None or isinstance(shown.exception, SystemExit), words
    campaign = load_campaign(Path(file))
    store = Store(campaign.catalog_url, campaign.name)
    granules = list(store.granules())
    store.close()
    for granule in granules:
        assert granule.status is Status.GOOD or granule.reason
    kinds: Counter[str] = Counter()
    profiles = set()
    for path in campaign.products_root.rglob("*.nc"):
        _, instrument, kind, *_ = path.relative_to(campaign.products_root).parts
        kinds[kind] += 1
        if kind == "signal":
            with xr.open_dataset(path) as product:
                profiles |= {(instrument, time) for time in product["time"].values}
    assert (len(profiles), kinds) == ARCHIVES[name]

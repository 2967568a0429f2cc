"""What the archive says of itself reaches the products, and `reproduce` finds the archive."""

from __future__ import annotations

from pathlib import Path

import xarray as xr
from support.archives import raw_archives
from support.archives.small_archive import BINS, Archive

from lidarops.run.archive import reprocess
from lidarops.run.reproduction import reproduce_product


def test_a_product_states_the_notes_on_its_files(tmp_path: Path) -> None:
    archive = Archive(tmp_path, days=1)
    foreign = raw_archives.content(650.0, bins=BINS, position=(-31.4, -64.2), zenith_angle=0.0)
    raw_archives.write(archive.folder / "raw/poor/h-foreign", foreign)
    facts = archive.tree["instruments"]["rich"]["facts"]
    facts[0]["zenith_angle"] = 3.0
    campaign = archive.write()
    assert reprocess(campaign) is not None
    notes = {}
    for path in sorted(campaign.products_root.rglob("*_signal_photon_532o_*.nc")):
        with xr.open_dataset(path) as product:
            notes[path] = product.attrs["lidarops_input_notes"]
    poor, rich = notes.values()
    assert "the header states the position -31.4 N -64.2 E" in poor
    assert poor.endswith(": 1 of 4 files")
    overridden = "zenith_angle 3 degree of the campaign overrides 0 of the header: 3 of 3 files"
    assert rich == overridden
    assert all(reproduce_product(path).identical for path in notes)
    archive.tree["instruments"]["poor"]["header_position"] = "ignore"
    assert reprocess(archive.write()) is not None
    first = next(iter(notes))
    with xr.open_dataset(first) as product:
        ignored = product.attrs["lidarops_input_notes"]
    assert ignored == "header_position: ignore overrides -64.2, -31.4 of the header: 1 of 4 files"
    # A product without notes does not carry the attribute.
    (archive.folder / "raw/poor/h-foreign").unlink()
    assert reprocess(archive.write()) is not None
    with xr.open_dataset(first) as product:
        assert "lidarops_input_notes" not in product.attrs


def test_a_product_is_reproduced_where_the_archive_lies_elsewhere(tmp_path: Path) -> None:
    archive = Archive(tmp_path / "campaigns/coast", days=1)
    archive.tree |= {"archive": str(tmp_path / "disk/raw"), "output": str(tmp_path / "results")}
    (tmp_path / "disk").mkdir()
    (archive.folder / "raw").rename(tmp_path / "disk/raw")
    # A file of another campaign, of the same name, in a folder above the products.
    raw_archives.write(tmp_path / "campaigns/overlap.csv", b"range [m],overlap\n0,1\n")
    (tmp_path / "other").mkdir()
    raw_archives.write(tmp_path / "other/overlap.csv", b"range [m],overlap\n0,1\n")
    campaign = archive.write()
    assert reprocess(campaign) is not None
    products = sorted(campaign.products_root.rglob("*.nc"))
    assert {path.parts[-3] for path in products} >= {"signal", "elastic"}
    for path in products:
        assert reproduce_product(path).identical

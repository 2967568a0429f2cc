"""A kind of product that a package outside of lidarops adds, through every command."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives.csv_archives import convert
from support.archives.small_campaign import FAST, TREE
from support.products.compliance import findings, permitted
from support.products.made_products import METADATA
from typer.testing import CliRunner

import lidarops
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.kinds import kinds
from lidarops.raw import licel
from lidarops.run.archive import assess, reprocess
from lidarops.simulate.campaign import simulate_campaign
from lidarops.system import code_version as versions
from lidarops.system.code_version import Sources

KIND = "integrated"
WINDOWS = [[1500, 3000], [3900, 6000], [9000, 9500]]
"""m: inside, cut by the last bin at 4500 m, and beyond it."""
BACKGROUND = [4050, 4500]
PRODUCTS = {
    "signal": {"channels": ["photon_532o"]},
    KIND: {
        "channels": ["photon_532o", "glued_532o"],
        "windows": WINDOWS,
        "background_range": BACKGROUND,
    },
}


def tree() -> dict[str, Any]:
    """One lidar, after the change of its facts: 12 files and their dark files."""
    settings = copy.deepcopy(TREE) | {"archive": "raw", "output": "out"}
    for part in (settings, settings["simulation"]):
        del part["instruments"]["hill-lidar"]
    settings["instruments"]["coast-lidar"]["products"] = copy.deepcopy(PRODUCTS)
    settings["simulation"] |= {"start": "2024-12-31T23:58:00Z", "duration": 720}
    settings["metadata"] = METADATA.model_dump() | {"references": "Someone (2024)."}
    return settings


def campaign_in(folder: Path, settings: dict[str, Any]) -> Campaign:
    folder.mkdir(exist_ok=True)
    file = folder / "campaign.yaml"
    file.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return load_campaign(file)


def run(*words: object, exit_code: int = 0) -> str:
    result = CliRunner().invoke(lidarops.cli.app, [str(word) for word in words])
    assert result.exit_code == exit_code, result.output
    return result.output


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """The campaign, catalogued and processed by command."""
    made = campaign_in(tmp_path_factory.mktemp("outside") / "licel", tree())
    simulate_campaign(made)
    run("catalog", file_of(made))
    run("reprocess", file_of(made))
    return made


@pytest.fixture
def copied(campaign: Campaign, tmp_path: Path) -> Campaign:
    """A copy of the processed campaign, which a test may change."""
    shutil.copytree(campaign.folder, tmp_path / "copy")
    return load_campaign(tmp_path / "copy" / "campaign.yaml")


def file_of(campaign: Campaign) -> Path:
    return campaign.folder / "campaign.yaml"


def products(campaign: Campaign, pattern: str = KIND) -> list[Path]:
    return sorted(Path(campaign.products_root).rglob(f"*_{pattern}_*.nc"))


def stale(campaign: Campaign) -> dict[str, str]:
    """Return the stale kinds of product, with the reason."""
    return {product.kind: product.reason for day in assess(campaign) for product in day.stale}


# Values ---------------------------------------------------------------------------------------


def expected(raw: Path, window: list[int]) -> tuple[float, float, float]:
    """Integral of (P - B) r^2 dr of a photon record in MHz m3, its error, and number of bins."""
    header, counts = licel.read_counts(raw)
    (channel,) = (c for c in header.channels if c.name == "photon_532o")
    width = channel.bin_width
    # Licel counts 150 m for a microsecond.
    microseconds = channel.shots * width / 150.0
    rate = counts["photon_532o"] / microseconds
    live = 1.0 - rate * FAST * 1e6
    power, variance = rate / live, rate / microseconds / live**4
    centres = (np.arange(power.size) + 0.5) * width

    def inside(limits: list[int]) -> np.ndarray:
        return (centres >= limits[0]) & (centres < limits[1])

    tail, bins = inside(BACKGROUND), inside(window)
    background, noise = power[tail].mean(), variance[tail].mean() / tail.sum()
    weights = centres[bins] ** 2 * width
    error = np.sqrt((variance[bins] * weights**2).sum() + noise * weights.sum() ** 2)
    return float(((power[bins] - background) * weights).sum()), float(error), int(bins.sum())


def test_values_equal_an_independent_integration(campaign: Campaign) -> None:
    raw = sorted(Path(campaign.archive).glob("coast/h*"))
    for number, window in enumerate(WINDOWS[:2]):
        values = []
        for path in products(campaign, f"{KIND}_photon_532o"):
            with xr.open_dataset(path) as product:
                one = product.isel(window=number)
                assert one.window_bounds.values.tolist() == window
                values += zip(
                    one.integral.values,
                    one.integral_standard_error.values,
                    [int(one.bins)] * one.sizes["time"],
                    strict=True,
                )
        integral, error, bins = np.array(values).T
        truth, noise, inside = np.array([expected(file, window) for file in raw]).T
        assert len(raw) == 12
        np.testing.assert_allclose(integral, truth, rtol=1e-5)
        np.testing.assert_allclose(error, noise, rtol=0.1)
        assert bins.tolist() == inside.tolist()
        assert (truth > 5 * noise).all() == (number == 0)


def test_a_window_beyond_the_last_bin_is_left_out_with_its_number(campaign: Campaign) -> None:
    document = json.loads(run("plan", file_of(campaign), "--json"))
    for scene in document["scenes"]:
        (omission,) = (
            entry
            for entry in scene["left_out"]
            if entry["rule"] == "window_inside" and entry["channel"] == "photon_532o"
        )
        assert omission["reason"] == "window 9000-9500 m holds no bin; the last ends at 4500 m"
        assert omission["number"] == 9000
    assert "integrated" in run("plan", file_of(campaign))


def test_its_own_bit_is_stated_and_shared_bits_keep_their_meaning(campaign: Campaign) -> None:
    for path in products(campaign):
        with xr.open_dataset(path) as product:
            flags = product.quality_flag
            words = dict(zip(flags.flag_meanings.split(), flags.flag_masks, strict=True))
            cut = flags.values & words["window_cut"] != 0
            assert cut.tolist() == [[False, True]] * product.sizes["time"]
            assert (product.usable.values[cut] == 1).all()
            assert flags.lidarops_flag_layout == "integrated 1"
    rows = json.loads(run("inspect", path, "--json"))["quality"]
    (row,) = (row for row in rows if row["name"] == "window_cut")
    assert (row["severity"], row["share"]) == ("care", 0.5)


@pytest.mark.slow
def test_products_comply_with_the_conventions(campaign: Campaign, tmp_path: Path) -> None:
    for channel in ("photon", "glued"):
        path = products(campaign, f"{KIND}_{channel}_532o")[0]
        copy_of = tmp_path / path.name
        shutil.copy(path, copy_of)
        with xr.open_dataset(path) as product:
            assert findings(copy_of) == (set(), permitted(KIND, product))


# Commands -------------------------------------------------------------------------------------


def test_reports_and_pages_show_it(copied: Campaign) -> None:
    (page,) = Path(copied.output).glob("report/*/index.html")
    shutil.rmtree(page.parent / "figures", ignore_errors=True)
    run("report", page.parent)
    text = page.read_text(encoding="utf-8")
    title = "Integral of the range-corrected signal over the window against time"
    assert f"{title}: 532 nm, photon counting (photon_" in text
    run("site", copied.output)
    site = Path(copied.output) / "site"
    (day,) = site.rglob("2025-01-01.html")
    assert "Integrated signals" in day.read_text(encoding="utf-8")
    pages = [page for page in (site / "product").rglob("*.html") if KIND in page.name]
    assert len(pages) == len(products(copied))
    assert all("window_cut" in page.read_text(encoding="utf-8") for page in pages)


def test_products_are_verified_and_reproduced(campaign: Campaign) -> None:
    run("verify", file_of(campaign))
    for product in products(campaign):
        assert "identical in every byte" in run("reproduce", product)


@pytest.mark.slow
def test_products_are_indexed_joined_and_averaged(copied: Campaign) -> None:
    run("aggregate", copied.output, "--means", "day", "--stac", "--store")
    folder = Path(copied.output) / "aggregates"
    index = folder / "products.parquet"
    assert len(lidarops.find_products(index, kind=KIND)) == len(products(copied))
    joined = lidarops.open_products(index, kind=KIND, channel="photon_532o")
    assert (joined.sizes["time"], joined.sizes["window"]) == (12, 2)
    (mean,) = folder.rglob(f"*_{KIND}_photon_*_day_2025.nc")
    with xr.open_dataset(mean) as means:
        last = joined.sel(time=slice("2025-01-01", None)).integral.astype(float)
        np.testing.assert_allclose(means.integral[-1], last.mean("time"), rtol=1e-5)
    store = Path(copied.output) / "stores" / KIND
    xr.testing.assert_identical(lidarops.open_products(store, channel="photon_532o"), joined)


def test_the_schema_describes_its_settings() -> None:
    properties = json.loads(run("schema"))["$defs"]["IntegratedSettings"]["properties"]
    assert properties["windows"]["unit"] == "m"


def test_a_mistake_in_its_settings_is_reported_with_its_line(tmp_path: Path) -> None:
    settings = tree()
    settings["instruments"]["coast-lidar"]["products"][KIND]["windows"] = [[3000, 600]]
    with pytest.raises(CampaignError, match=r"line \d+: .*\[3000, 600\] must end farther"):
        campaign_in(tmp_path / "wrong", settings)


def test_it_is_made_alone_and_by_two_workers(copied: Campaign) -> None:
    before = {path: path.read_bytes() for path in products(copied)}
    for path in before:
        path.unlink()
    run("reprocess", file_of(copied), "--product", KIND, "--workers", "2")
    assert {path: path.read_bytes() for path in products(copied)} == before


def test_any_number_of_profiles_at_a_time_gives_the_same_bytes(copied: Campaign) -> None:
    before = {path: path.read_bytes() for path in products(copied)}
    # Larger than memory decides: every profile is a chunk of its own.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidarops.scene.profiles.IN_MEMORY", 0)
        run("reprocess", file_of(copied), "--force", "--profiles-per-chunk", "1")
    assert {path: path.read_bytes() for path in products(copied)} == before


# What makes it stale --------------------------------------------------------------------------


def test_a_changed_setting_makes_it_stale_and_no_other(copied: Campaign) -> None:
    assert not stale(copied)
    settings = tree()
    settings["instruments"]["coast-lidar"]["products"][KIND]["windows"][0] = [1500, 2900]
    changed = campaign_in(copied.folder, settings)
    assert set(stale(changed)) == {KIND}
    record = reprocess(changed)
    assert record is not None
    assert {made.kind for scene in record.scenes for made in scene.products} == {KIND}


def test_changed_bytes_of_a_file_in_its_settings_make_it_stale(copied: Campaign) -> None:
    file = copied.folder / "overlap.csv"
    file.write_text("range,overlap\n0,0.2\n600,1.0\n")
    settings = tree()
    settings["instruments"]["coast-lidar"]["products"][KIND]["overlap_profile"] = file.name
    changed = campaign_in(copied.folder, settings)
    reprocess(changed)
    assert not stale(changed)
    file.write_text("range,overlap\n0,0.1\n600,1.0\n")
    assert stale(changed) == {KIND: "changed: overlap overlap.csv"}


@pytest.fixture
def changed_sources(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Path]:
    """A copy of the package that the run takes for the installed one."""
    package = tmp_path / "lidar_extras"
    shutil.copytree(repository / "tests/plugin/lidar_extras", package)
    roots = {"lidarops": (repository / "lidarops",), "lidar_extras": (package,)}
    monkeypatch.setattr(versions, "_installed", lambda: Sources(roots))
    versions.code_version.cache_clear()
    yield package
    versions.code_version.cache_clear()


def test_a_changed_source_makes_it_stale_and_no_other(
    campaign: Campaign, changed_sources: Path
) -> None:
    assert not stale(campaign)
    with (changed_sources / "integrated" / "integral.py").open("a") as file:
        file.write("\n_UNHEARD_OF = 1\n")
    versions.code_version.cache_clear()
    reasons = stale(campaign)
    assert set(reasons) == {KIND}
    assert reasons[KIND].startswith("the code changed")


# With another package, and without --------------------------------------------------------------


def test_products_of_csv_files_equal_those_of_licel_files(
    campaign: Campaign, tmp_path: Path
) -> None:
    text = campaign_in(tmp_path / "text", tree())
    convert(Path(campaign.archive), Path(text.archive))
    assert reprocess(text) is not None
    pairs = list(zip(products(campaign), products(text), strict=True))
    assert len(pairs) == 4
    for before, after in pairs:
        with (
            xr.open_dataset(before, decode_cf=False) as old,
            xr.open_dataset(after, decode_cf=False) as new,
        ):
            assert before.name == after.name
            for name in set(old.variables) - {"provenance"}:
                assert old[name].values.tobytes() == new[name].values.tobytes(), name


WITHOUT = """
import importlib.metadata, json, sys
points = importlib.metadata.entry_points
importlib.metadata.entry_points = lambda **chosen: [
    point for point in points(**chosen) if not point.value.startswith("lidar_extras.integrated")
]
from typer.testing import CliRunner
from lidarops.cli import app
results = [CliRunner().invoke(app, words) for words in json.loads(sys.argv[1])]
print(json.dumps([[result.exit_code, result.output, repr(result.exception)] for result in results]))
"""


def without_the_package(*commands: list[Any]) -> list[tuple[int, str, str]]:
    """Return exit codes, outputs and exceptions of commands where the kind is not installed."""
    words = json.dumps([[str(word) for word in command] for command in commands])
    output = subprocess.run(
        [sys.executable, "-c", WITHOUT, words], check=True, capture_output=True, text=True
    ).stdout
    return [tuple(result) for result in json.loads(output.splitlines()[-1])]


@pytest.mark.slow
def test_products_of_an_uninstalled_package_are_shown(copied: Campaign) -> None:
    run("aggregate", copied.output)
    file, output = file_of(copied), Path(copied.output)
    (report,) = output.glob("report/*/")
    settings = tree()
    del settings["instruments"]["coast-lidar"]["products"][KIND]
    campaign_in(copied.folder, settings)
    product = products(copied)[0]
    requesting = copied.folder / "requesting.yaml"
    requesting.write_text(yaml.safe_dump(tree()))
    index = output / "aggregates" / "products.parquet"
    assert set(lidarops.find_products(index).kind) == {KIND, "signal"}
    results = without_the_package(
        ["verify", file],
        ["runs", file],
        ["reprocess", file],
        ["report", report],
        ["site", output],
        ["inspect", product, "--json"],
        ["aggregate", output],
        ["reproduce", product],
        ["plan", requesting],
    )
    assert [result[0] for result in results] == [0, 0, 0, 0, 0, 0, 1, 1, 2]
    *_, inspected, aggregated, reproduced, planned = (result[1] for result in results)
    assert "window_cut" in inspected
    assert "unknown kind: integrated" in " ".join(re.split(r"[\s│]+", aggregated))
    assert "no kind of product 'integrated'" in reproduced
    assert "install the package that adds it" in reproduced
    assert "products.integrated: unknown key; keys here are" in planned
    assert not any("Traceback" in result[1] for result in results)
    pages = [page for page in (output / "site/product").rglob("*.html") if KIND in page.name]
    assert len(pages) == len(products(copied))
    assert KIND in (report / "index.html").read_text(encoding="utf-8")


def test_nothing_of_lidarops_names_the_package(repository: Path) -> None:
    name = re.compile(r"lidar_extras|([\"'`])(integrated|csv)\1|integrated *[=:]")
    texts = [
        path
        for folder in ("lidarops", "flows", "docs")
        for path in sorted((repository / folder).rglob("*"))
        if path.suffix in {".py", ".md", ".html", ".svg", ".css"}
        # Pages that are built show the keys of all kinds that are installed.
        if "_build" not in path.parts
    ]
    assert len(texts) > 250
    assert not [path for path in texts if name.search(path.read_text(encoding="utf-8"))]
    assert kinds()[KIND].package == "lidar_extras.integrated"

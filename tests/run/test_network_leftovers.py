"""Leftovers of networks: lidars used only by a network, and networks that lost lidars."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.archives import raw_archives
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.cli import app
from lidarops.run.archive import bring_up_to_date, remove_orphans, reprocess

PLACES = {
    "west": (47.25, 11.3, 70.0),
    "east": (47.25, 11.353, 310.0),
    "north": (47.2811, 11.3265, 190.0),
}
GONE = "the campaign no longer requests it"

pytestmark = pytest.mark.usefixtures("quickly")


def _tree() -> dict[str, Any]:
    return {
        "name": "net",
        "title": "Net",
        "archive": "raw",
        "output": "out",
        "stations": {
            name: {"name": name, "latitude": place[0], "longitude": place[1], "altitude": 600}
            for name, place in PLACES.items()
        },
        "instruments": {
            f"{name}-lidar": {
                "station": name,
                "files": f"{name}/h*",
                "facts": [{"full_overlap_range": 150, "zenith_angle": 90, "azimuth": azimuth}],
            }
            for name, (_, _, azimuth) in PLACES.items()
        },
        "networks": {
            "valley": {
                "instruments": [f"{name}-lidar" for name in PLACES],
                "visibility": {"channel": "photon_532o"},
            }
        },
    }


class Net:
    """Campaign of three lidars with level beams that meet, and without products of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "net.yaml"
        self.tree = _tree()
        for instrument in self.tree["instruments"].values():
            instrument["header_position"] = "ignore"
        for seed, name in enumerate(PLACES):
            self.raw(f"{name}/h0", seed)

    def raw(self, name: str, seed: int) -> None:
        raw_archives.write(
            self.folder / "raw" / name, raw_archives.content(600, bins=2000, seed=seed)
        )

    def write(self) -> Campaign:
        self.file.write_text(yaml.safe_dump(self.tree))
        return load_campaign(self.file)

    def lose(self, *stations: str) -> None:
        """Remove files, as if a disk were not mounted."""
        for name in stations:
            (self.folder / "raw" / name).rename(self.folder / name)

    def find(self, *stations: str) -> None:
        for name in stations:
            (self.folder / name).rename(self.folder / "raw" / name)

    @property
    def products(self) -> list[str]:
        return [str(path) for path in (self.folder / "out/products").rglob("*.nc")]

    def command(self, *options: str) -> tuple[int, dict[str, Any]]:
        result = CliRunner().invoke(app, ["reprocess", str(self.file), "--json", *options])
        return result.exit_code, json.loads(result.stdout)


@pytest.fixture
def net(tmp_path: Path) -> Net:
    made = Net(tmp_path)
    made.write()
    return made


# Empty scenes --------------------------------------------------------------------------------


def test_lidars_used_only_by_a_network_are_no_failure(net: Net) -> None:
    for made in (1, 0):
        result = bring_up_to_date(net.write())
        assert (result.record is not None) == bool(made)
        assert not result.empty_scenes
        assert not result.has_failures
    code, summary = net.command()
    assert (code, summary["empty_scenes"]) == (0, {})
    # Wide, so that the reason is not folded.
    wide = {"COLUMNS": "200"}
    command = ["plan", str(net.file), "--all", "--station", "west"]
    shown = CliRunner().invoke(app, command, env=wide).stdout
    assert "used only by network valley" in shown


def test_a_plan_of_other_products_has_no_steps(net: Net) -> None:
    net.tree["instruments"]["west-lidar"]["products"] = {"signal": {}}
    net.write()
    for kind, some in (("visibility", True), ("signal", False)):
        line = ["plan", str(net.file), "--json", "--product", kind, "--instrument", "valley"]
        (scene,) = json.loads(CliRunner().invoke(app, line).stdout)["scenes"]
        assert bool(scene["steps"]) is some
        assert (len(scene["stale"]), scene["fresh"]) == (int(some), 0)


def test_a_lidar_without_its_network_is_reported(net: Net) -> None:
    net.lose("east", "north")
    empty_scenes = bring_up_to_date(net.write()).empty_scenes
    assert list(empty_scenes) == ["west-lidar_20260301T000000"]
    assert "no other instrument has files" in empty_scenes["west-lidar_20260301T000000"]


def test_an_empty_network_is_reported_once(net: Net) -> None:
    net.lose("east")
    assert list(bring_up_to_date(net.write()).empty_scenes) == ["valley_20260301T000000"]


@pytest.mark.parametrize("why", ["requested", "alone"])
def test_an_empty_lidar_is_reported_beside_a_network(net: Net, why: str) -> None:
    lidar = net.tree["instruments"]["west-lidar"]
    if why == "requested":
        lidar["products"] = {"signal": {"channels": ["photon_355o"]}}
    else:
        net.tree["instruments"]["other"] = {**lidar, "files": "other/h*"}
        net.raw("other/h0", 9)
    (name,) = bring_up_to_date(net.write()).empty_scenes
    assert name == ("west-lidar" if why == "requested" else "other") + "_20260301T000000"


# Orphans -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        (["east"], "east-lidar: no granule in the window"),
        (["east", "north"], "no raw file of east-lidar and north-lidar is left"),
    ],
)
def test_a_product_whose_network_lost_members_is_kept(net: Net, lost: list[str], said: str) -> None:
    assert reprocess(net.write())
    (path,) = net.products
    net.lose(*lost)
    code, summary = net.command("--remove-orphans")
    (reason,) = summary["kept_products"].values()
    assert said in reason
    assert (code, summary["orphans"], summary["removed"], net.products) == (1, {}, 0, [path])
    assert "could not be made again" in CliRunner().invoke(app, ["reprocess", str(net.file)]).stdout
    net.find(*lost)
    again = bring_up_to_date(net.write())
    assert (again.record, again.orphans, again.has_failures) == (None, (), False)


def test_a_product_whose_network_lost_all_is_an_orphan(net: Net) -> None:
    net.tree["instruments"]["other"] = {
        **net.tree["instruments"]["west-lidar"], "files": "other/h*", "products": {"signal": {}},
    }  # fmt: skip
    net.raw("other/h0", 9)
    assert reprocess(net.write())
    net.lose(*PLACES)
    net.tree["vanished_share"] = 1
    net.write()
    _, summary = net.command("--remove-orphans")
    assert list(summary["orphans"].values()) == ["no raw file of its scene is left"]
    assert (summary["kept_products"], summary["removed"]) == ({}, 1)
    assert len(net.products) == 2


def _no_longer_meeting(net: Net) -> None:
    net.tree["networks"]["valley"]["visibility"]["smallest_angle"] = 85


def _another_channel(net: Net) -> None:
    net.tree["networks"]["valley"]["visibility"]["channel"] = "analog_532o"


def _no_network(net: Net) -> None:
    del net.tree["networks"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_no_longer_meeting, "no beam has two crossings with other beams"),
        (_another_channel, GONE),
        (_no_network, GONE),
    ],
)
def test_a_product_that_the_campaign_made_impossible_is_removed(
    net: Net, change: Any, said: str
) -> None:
    assert reprocess(net.write())
    (path,) = net.products
    change(net)
    net.write()
    _, summary = net.command("--remove-orphans")
    (reason,) = summary["orphans"].values()
    assert said in reason
    assert (summary["kept_products"], summary["removed"]) == ({}, 1)
    assert path not in net.products


def test_a_kept_product_that_is_removed_by_hand_is_forgotten(net: Net) -> None:
    assert reprocess(net.write())
    net.lose("east")
    result = bring_up_to_date(net.write())
    Path(net.products[0]).unlink()
    assert remove_orphans(net.write(), result) == 0
    assert not bring_up_to_date(net.write()).orphans

"""Bytes and truth do not depend on workers, batches or order."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.errors import CampaignError
from lidarops.simulate import campaign as module
from lidarops.simulate.campaign import simulate_campaign
from lidarops.simulate.files import Simulator


def _contents(root):
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(Path(root).rglob("*"))
        if path.is_file()
    }


def _scenery(tree):
    """Add random effects: drifting lasers and random damage."""
    for instrument in tree["simulation"]["instruments"].values():
        instrument["laser"] = {"per_hour": -0.05, "jitter": 0.05}
        instrument["random_damage"] = {"fraction": 0.3, "kinds": ["garbage", "duplicate", "glitch"]}


@pytest.mark.usefixtures("server")
def test_two_processes_write_what_one_writes(small, monkeypatch):
    alone = small(_scenery, archive="alone")
    first = simulate_campaign(alone)
    expected = _contents(first.archive)
    monkeypatch.setattr(module, "_BATCH", 3)
    steps = []
    second = simulate_campaign(small(_scenery, archive="shared"), workers=2, progress=steps.append)
    assert _contents(second.archive) == expected
    assert second.truth.identical(first.truth)
    assert second.paths == first.paths
    assert sum(steps) == len(first.paths)

    # Errors in a worker are raised like errors in this process.
    def unwritable(tree):
        tree["stations"]["coast"]["altitude"] = 8000
        tree["instruments"]["coast-lidar"]["station"] = "coast"
        tree["stations"]["coast"]["name"] = "\u6e2f"
        tree["simulation"]["instruments"]["coast-lidar"]["acquisition"]["dialect"] = "pilar"

    with pytest.raises(ValueError, match="Latin-1"):
        simulate_campaign(small(unwritable, archive="bad"), workers=2)


def test_any_order_gives_the_same_files(small):
    campaign = small(_scenery)
    simulate_campaign(campaign)
    written = _contents(campaign.archive)
    for site in module._sites(campaign):
        simulator = Simulator(site)
        for planned in reversed(list(site.planned_files())):
            content, truth = simulator.simulate(planned)
            assert content == written[truth.values["path"]]
            # The same once more, from the same simulator.
            assert simulator.simulate(planned)[0] == content


def test_the_number_of_files_is_told_before_the_first(small):
    told = []
    paths = simulate_campaign(small(_scenery), progress=told.append, expect=told.append).paths
    assert told[0] == sum(told[1:]) == len(paths)
    with pytest.raises(CampaignError, match="no simulation"):
        simulate_campaign(small(lambda tree: tree.pop("simulation")))


@pytest.mark.usefixtures("server")
def test_the_command_line_writes_the_same_with_workers(small, tmp_path):
    campaign = small(_scenery, archive="called")
    expected = _contents(simulate_campaign(campaign).archive)
    file = tmp_path / "small.yaml"
    file.write_text(yaml.safe_dump(campaign.model_dump(mode="json", exclude_defaults=True)))
    for workers in ("1", "2"):
        folder = tmp_path / f"by-{workers}"
        arguments = ["simulate", str(file), "--archive", str(folder), "--workers", workers]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        assert f"{len(expected)} raw files" in result.output
        contents = _contents(folder)
        assert contents.pop("truth.nc")
        assert contents == expected

"""Products are the same bits for any number of profiles together, and need no planning."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from support.archives import mixed_campaign
from support.archives.scene_jobs import scene_jobs

from lidarops.campaign.model import load_campaign
from lidarops.scene.job import Job
from lidarops.scene.processing import process_scene
from lidarops.simulate.campaign import simulate_campaign

PROFILES = 21
LIDARS = ("clear-night", "vertical", "scanner", "west-lidar", "east-lidar", "north-lidar")
GLUED = ["photon_532o", "glued_532o"]

RUN = """
import pickle, sys
from lidarops.scene.processing import process_scene
with open(sys.argv[1], "rb") as stream:
    jobs = pickle.load(stream)
for job in jobs:
    outcome = process_scene(job)
    assert outcome.products, outcome.error
print(*(name for name in sys.modules if f"{name}.".startswith(("lidarops.run.", "distributed."))))
"""


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> list[Job]:
    """Jobs of a level, a vertical and a scanning lidar, and of a network."""
    folder = tmp_path_factory.mktemp("chunks")
    tree = mixed_campaign.tree(profiles=PROFILES, bins=2000)
    for settings in (tree["instruments"], tree["simulation"]["instruments"]):
        for name in settings.keys() - set(LIDARS):
            del settings[name]
    products = {name: tree["instruments"][name].get("products", {}) for name in LIDARS}
    products["clear-night"]["signal"] = {"channels": ["photon_532o", "analog_532o"]}
    products["vertical"] |= {
        "elastic": {"channels": GLUED, "average": "10min"},
        "signal": {"channels": GLUED},
    }
    products["scanner"]["signal"] = {"channels": GLUED}
    for name in LIDARS[:3]:
        tree["instruments"][name]["products"] = products[name]
    path = folder / "mixed.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    simulate_campaign(campaign)
    return scene_jobs(campaign)


def digests(jobs: list[Job]) -> dict[str, str]:
    """Process scenes, and return the sha256 of their products by path."""
    return {product.path: product.sha256 for job in jobs for product in process_scene(job).products}


@pytest.mark.slow
def test_any_number_of_profiles_together_gives_the_same_bits(
    jobs: list[Job], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = digests(jobs)
    kinds = {(Path(path).name.split("_")[2], "glued" in path) for path in whole}
    assert len(whole) >= 9, kinds
    for kind in ("signal", "homogeneous", "elastic", "multiangle", "visibility"):
        assert any(kind in path for path in whole), kind
    # Small scenes are one chunk otherwise.
    monkeypatch.setattr("lidarops.scene.profiles.IN_MEMORY", 0)
    for profiles in (1, 5):
        assert digests([replace(job, profiles_per_chunk=profiles) for job in jobs]) == whole


@pytest.mark.slow
def test_a_scene_loads_no_planning_and_no_scheduler(jobs: list[Job], tmp_path: Path) -> None:
    """A job holds all decisions, so that none is made again where it is carried out.

    `distributed` takes 0.3 s to load.
    """
    path = tmp_path / "jobs"
    path.write_bytes(pickle.dumps([job for job in jobs if job.plan.steps]))
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []

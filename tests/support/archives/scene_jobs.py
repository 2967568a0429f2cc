"""Scenes and jobs of a campaign, for tests that carry out a step of a run by themselves."""

from __future__ import annotations

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.records import Scene
from lidarops.run.archive import update_catalog
from lidarops.run.scenes import cut_scenes
from lidarops.scene.job import Job
from lidarops.scene.plan import plan_scene


def catalogued_scenes(campaign: Campaign) -> tuple[Scene, ...]:
    """Bring the catalog up to date and return its scenes."""
    update_catalog(campaign)
    with Store(campaign.catalog_url, campaign.name) as store:
        return cut_scenes(campaign, store.granules()).scenes


def scene_jobs(campaign: Campaign) -> list[Job]:
    """Bring the catalog up to date and return a job for every product of every scene."""
    return [
        Job(campaign, scene, plan_scene(scene, campaign)) for scene in catalogued_scenes(campaign)
    ]

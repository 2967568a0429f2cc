"""Estimates of memory: what makes a scene need more."""

from __future__ import annotations

from typing import Any

import pytest
from support import factories

from lidarops.records import Plan, Scene
from lidarops.run.scenes import cut_scenes
from lidarops.scene.job import scene_memory
from lidarops.scene.plan import plan_scene

LEVEL = {"homogeneous": {"channels": ["photon_532o"], "sections": [[750, 4500]]}}
SIGNAL = {"signal": {"channels": ["photon_532o"]}}


def planned(
    count: int = 10,
    *,
    products: dict[str, Any] | None = None,
    dead_time: float | str = 4e-9,
    **changes: Any,
) -> tuple[Scene, Plan]:
    granules = [factories.granule(5.0 * k, **changes) for k in range(count)]
    facts = [{"full_overlap_range": 300.0, "channels": {"photon_532o": {"dead_time": dead_time}}}]
    requests = LEVEL if products is None else products
    campaign = factories.campaign(products=requests, facts=facts)
    scene = cut_scenes(campaign, granules).scenes[0]
    return scene, plan_scene(scene, campaign)


@pytest.mark.parametrize("count", [20, 300])
def test_an_estimate_of_the_dead_time_holds_profiles(count: int):
    given, estimated = (
        planned(count=count, products=SIGNAL, dead_time=dead_time)
        for dead_time in (4e-9, "estimate")
    )
    held = scene_memory(*estimated).held - scene_memory(*given).held
    # Power, variance, quality and rates of the profiles of a group, and the counts of all groups.
    of_a_group, of_all = min(count, 32) * (8 + 8 + 4 + 8), min(count, 256) * 4
    assert held > factories.PHOTON.bins * (of_a_group + of_all)


@pytest.mark.parametrize(("lowest", "more"), [(20.0, False), (19.5, True)])
def test_beams_that_may_be_blocked_are_held(lowest: float, more: bool):
    def planned_scan(channel: str) -> tuple[Scene, Plan]:
        granules = [
            factories.granule(float(k), zenith_angle=angle)
            for k, angle in enumerate([90.0 - lowest, 50.0, 30.0] * 10)
        ]
        scan = {"channels": [channel], "background": "tail_mean"}
        campaign = factories.campaign(products={"multiangle": scan})
        scene = cut_scenes(campaign, granules).scenes[0]
        return scene, plan_scene(scene, campaign)

    analog, photon = (planned_scan(channel) for channel in ("analog_532o", "photon_532o"))
    assert (scene_memory(*analog).held > scene_memory(*photon).held) is more

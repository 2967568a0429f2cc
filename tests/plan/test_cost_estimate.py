"""Estimates of CPU time: what makes a scene cost more, and sums of a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import factories

from lidarops.plan import cost_estimate
from lidarops.plan.cost_estimate import RunTime, scene_cpu_time
from lidarops.plan.scene_plan import plan_scene
from lidarops.plan.scenes import cut_scenes
from lidarops.records import ChannelLayout, Plan, Role, Scene
from lidarops.reports import gallery
from lidarops.steps.memory import scene_memory

LEVEL = {"homogeneous": {"channels": ["photon_532o"], "sections": [[750, 4500]]}}
SIGNAL = {"signal": {"channels": ["photon_532o"]}}
ANALOG = {"signal": {"channels": ["analog_532o"]}}


def planned(
    count: int = 10,
    *,
    products: dict[str, Any] | None = None,
    dark: int = 0,
    dead_time: float | str = 4e-9,
    **changes: Any,
) -> tuple[Scene, Plan]:
    granules = [factories.granule(5.0 * k, **changes) for k in range(count)]
    granules += [
        factories.granule(-30.0 - k, path=f"dark/{k}", role=Role.DARK) for k in range(dark)
    ]
    facts = [{"full_overlap_range": 300.0, "channels": {"photon_532o": {"dead_time": dead_time}}}]
    requests = LEVEL if products is None else products
    campaign = factories.campaign(products=requests, facts=facts)
    scene = cut_scenes(campaign, granules).scenes[0]
    return scene, plan_scene(scene, campaign)


def time_of(**changes: Any) -> float:
    return scene_cpu_time(*planned(**changes))


def test_digests_are_computed_where_unknown_or_all_is_read():
    scene, plan = planned(sha256="0" * 64)
    assert scene_cpu_time(scene, plan) < time_of()
    assert scene_cpu_time(scene, plan, whole=True) == time_of()


@pytest.mark.parametrize(("products", "same"), [(LEVEL, True), (SIGNAL, False)])
def test_bins_beyond_all_sections_cost_nothing(products: dict[str, Any], same: bool):
    longer = (replace(factories.PHOTON, bins=8000),)
    assert (time_of(products=products, layout=longer) == time_of(products=products)) is same


def test_dark_files_cost_more_where_they_are_subtracted():
    analog, photon = (
        time_of(products=products, dark=3) - time_of(products=products)
        for products in (ANALOG, SIGNAL)
    )
    assert analog > photon + 0.01


def test_an_estimate_of_the_dead_time_costs_time_and_memory():
    given, estimated = (
        planned(count=20, products=SIGNAL, dead_time=dead_time) for dead_time in (4e-9, "estimate")
    )
    assert scene_cpu_time(*estimated) > scene_cpu_time(*given)
    held = scene_memory(*estimated).held - scene_memory(*given).held
    # Power, variance, quality and counts of the profiles of a group.
    assert held > 20 * factories.PHOTON.bins * (8 + 8 + 4 + 8)


@pytest.mark.parametrize(("lowest", "dearer"), [(20.0, False), (19.5, True)])
def test_beams_that_may_be_blocked_cost_time_and_memory(lowest: float, dearer: bool):
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
    assert (scene_cpu_time(*analog) > scene_cpu_time(*photon)) is dearer
    assert (scene_memory(*analog).held > scene_memory(*photon).held) is dearer


def test_a_glued_channel_reads_both_parts():
    glued, photon, analog = (
        time_of(count=200, products={"elastic": {"channels": [f"{part}_532o"]}}, zenith_angle=0.0)
        for part in ("glued", "photon", "analog")
    )
    assert glued - photon == pytest.approx(1.2e-7 * 200 * factories.PHOTON.bins)
    assert analog == photon


def test_a_scene_without_product_costs_nothing():
    assert time_of(products={}) == 0


@given(st.integers(1, 60), st.integers(1, 60), st.sampled_from([1000, 2000, 4000]))
def test_more_profiles_and_bins_never_cost_less(few, more, bins):
    layout = tuple(replace(channel, bins=bins) for channel in (factories.PHOTON, factories.ANALOG))
    wider: tuple[ChannelLayout, ...] = tuple(replace(channel, bins=2 * bins) for channel in layout)
    products = {"signal": {}, **LEVEL}
    one = time_of(count=few, products=products, layout=layout)
    assert time_of(count=few + more, products=products, layout=layout) > one
    assert time_of(count=few, products=products, layout=wider) > one


def test_a_run_starts_once_and_draws_a_channel_once():
    run = RunTime()
    assert set(run.parts.values()) == {0.0}
    first = run.add(*planned(count=3))
    of_one = run.parts
    run.add(*planned(count=3))
    run.add(*planned(products={}))
    assert run.count == 2
    assert run.parts == {**of_one, "scenes": 2 * first, "all": of_one["all"] + first}
    run.add(*planned(count=3, products=SIGNAL))
    assert run.parts["report"] > of_one["report"]
    assert run.parts["start"] == of_one["start"] > 0


def test_figures_are_limited_as_those_of_reports():
    assert cost_estimate.MOST_FIGURES == gallery.FIGURES

"""What a plan states: a product depends on what stands before it, and on no other product."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from support import factories
from support.archives.network_plans import campaign as network_campaign
from support.archives.network_plans import granules as network_granules

from lidarops.records import Plan, PlannedStep, Role, entry_as_dict
from lidarops.run.scenes import cut_scenes
from lidarops.scene import dependence
from lidarops.scene.job import Job, recorded_settings
from lidarops.scene.plan import plan_scene
from lidarops.scene.retrieval import settings_model

CHANNELS = ["photon_532o", "analog_532o", "glued_532o"]
REQUESTS: dict[str, dict[str, Any]] = {
    "signal": {"channels": CHANNELS},
    "homogeneous": {"channels": CHANNELS[:2], "sections": [[750, 4500]], "visibility": {}},
    "elastic": {"channels": CHANNELS},
    "multiangle": {"channels": CHANNELS, "layers": [[600, 1200]]},
}
FACTS = {"channels": {"photon_532o": {"dead_time": 4e-9}, "analog_532o": {"lag": 3}}}
DARK = [factories.granule(-30.0 - k, path=f"dark/{k}", role=Role.DARK) for k in range(2)]
LEVEL = [factories.granule(0), *DARK]
UP = [factories.granule(0, zenith_angle=0.0), *DARK]
SCAN = [
    *(factories.granule(k, zenith_angle=15.0 * k, azimuth=90.0) for k in range(6)),
    *DARK,
]
SCENES = {"level": LEVEL, "up": UP, "scan": SCAN}


def planned(scene: str, kinds: Any = REQUESTS) -> Plan:
    products = {kind: REQUESTS[kind] for kind in kinds}
    campaign = factories.campaign(products=products, facts=[FACTS])
    return plan_scene(cut_scenes(campaign, SCENES[scene]).scenes[0], campaign)


def network() -> Plan:
    campaign = network_campaign()
    (scene,) = (s for s in cut_scenes(campaign, network_granules()).scenes if s.members)
    return plan_scene(scene, campaign)


PLANS = {**{name: planned(name) for name in SCENES}, "network": network()}


def test_settings_of_one_kind_concern_no_other_product_of_the_network() -> None:
    (scene,) = (s for s in cut_scenes(network_campaign(), network_granules()).scenes if s.members)
    changed = network_campaign({"average": "30min"})
    before, after = (
        [
            recorded_settings(job, scene, job.plan, (kind, "photon_532o"))
            for kind in ("visibility", "of_another_package")
        ]
        for campaign in (network_campaign(), changed)
        for job in [Job(campaign, scene, PLANS["network"])]
    )
    assert before[0] != after[0]
    assert before[1] == after[1]


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_the_places_of_needed_steps_are_those_that_the_plan_names(plan: Plan) -> None:
    for step, places in zip(plan.steps, dependence.needed_places(plan.steps), strict=True):
        taken = [plan.steps[place] for place in places]
        names = {
            other.name if other.channel == step.channel else f"{other.channel}/{other.name}"
            for other in taken
        }
        assert names <= set(step.needs)
        left_out = {omission.name for omission in plan.left_out}
        assert {need.rpartition("/")[2] for need in set(step.needs) - names} <= left_out
        assert all(other.product in ("", step.product) for other in taken)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(SCENES)), st.sets(st.sampled_from(sorted(REQUESTS)), min_size=1))
def test_the_plan_of_a_product_does_not_depend_on_other_products(scene, kinds):
    plan = planned(scene, kinds)
    products = plan.product_keys
    of_all = PLANS[scene].product_keys
    assert set(products) == {product for product in of_all if product[0] in kinds}
    for product in products:
        alone = dependence.plan_closure(plan, [product])
        assert alone == dependence.plan_closure(PLANS[scene], [product])
        assert alone == dependence.plan_closure(alone, [product])


def test_the_scenes_give_products_of_all_kinds():
    """Otherwise the tests of this module say little."""
    kinds = {kind for plan in PLANS.values() for kind, _ in plan.product_keys}
    assert kinds == {*REQUESTS, "visibility"}
    assert ("elastic", "glued_532o") in PLANS["up"].product_keys


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_steps_need_entries_of_the_plan_only(plan):
    entries = {(entry.channel, entry.name) for entry in (*plan.steps, *plan.left_out)}
    for step in plan.steps:
        assert len(set(step.needs)) == len(step.needs)
        for need in step.needs:
            channel, _, name = need.rpartition("/")
            assert (channel or step.channel, name) in entries, f"{step.name} needs {need}"


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_a_step_runs_after_those_that_it_needs(plan):
    places = [(step.channel, step.instrument, step.name) for step in plan.steps]
    for number, step in enumerate(plan.steps):
        for need in step.needs:
            channel, _, name = need.rpartition("/")
            # A glued channel is prepared after its parts, whatever their order in the plan.
            if not channel:
                place = (step.channel, step.instrument, name)
                assert place not in places or places.index(place) < number


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_settings_survive_json(plan):
    for fields, step in zip(
        json.loads(json.dumps(plan.as_dict()))["steps"], plan.steps, strict=True
    ):
        again = PlannedStep(**fields)
        assert entry_as_dict(again) == entry_as_dict(step)
        model = TypeAdapter(settings_model(step))
        typed = model.validate_python(dict(again.settings))
        assert typed == model.validate_python(dict(step.settings))
        assert model.dump_python(typed, mode="json", exclude_none=True) == dict(step.settings)

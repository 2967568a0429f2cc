"""Steps that plans leave out: every rule by name, and no good value lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
import xarray as xr
from support import factories
from support.archives import mixed_campaign, raw_archives
from support.archives.scene_jobs import catalogued_scenes
from support.cases import each
from support.counts_read import counts_read
from support.oracles.angle_scenes import on_altitudes

from lidarops.catalog.database import GRANULE
from lidarops.catalog.store import Store
from lidarops.raw.formats import RawFile
from lidarops.records import Plan, PlannedStep, ProductRecord, Role, RunRecord
from lidarops.retrieve.multiangle import _block, slant_paths
from lidarops.run.archive import Options, bring_up_to_date, reprocess
from lidarops.run.scenes import cut_scenes
from lidarops.scene import dependence
from lidarops.scene.job import Job
from lidarops.scene.plan import plan_scene
from lidarops.scene.processing import process_scene
from lidarops.scene.retrieval import idle_window, read_windows
from lidarops.simulate.campaign import simulate_campaign

SECTIONS = {"channels": ["photon_532o"], "sections": [[750, 4500], [1500, 7500]]}
HOMOGENEOUS = {"homogeneous": SECTIONS}


def planned(*granules: Any, all_steps: bool = False, **changes: Any) -> Plan:
    campaign = factories.campaign(**changes).model_copy(update={"all_steps": all_steps})
    return plan_scene(cut_scenes(campaign, granules or (factories.granule(0),)).scenes[0], campaign)


def decided(plan: Plan, rule: str) -> tuple[list[str], list[str]]:
    """Return the steps that a rule runs, and the reasons of those that it leaves out."""
    steps = [step.name for step in plan.steps if step.rule == rule]
    return steps, [omission.reason for omission in plan.left_out if omission.rule == rule]


# Decisions ------------------------------------------------------------------------------------


def with_facts(**facts: Any) -> dict[str, Any]:
    return {"facts": [facts]}


def with_products(**products: Any) -> dict[str, Any]:
    return {"products": products}


LEVEL = factories.granule(0)
UP = factories.granule(0, zenith_angle=0.0)
DARK = factories.granule(-30, path="dark/d", role=Role.DARK)
SCAN = [factories.granule(k, zenith_angle=15.0 * k) for k in range(6)]
ANALOG = with_products(signal={"channels": ["analog_532o"]})
ELASTIC = with_products(elastic={"channels": ["photon_532o"]})
TAIL = with_products(elastic={"channels": ["photon_532o"], "background": "tail_mean"})
GLUED = with_products(elastic={"channels": ["glued_532o"]})
LATE = {**GLUED, **with_facts(channels={"analog_532o": {"range_offset": -45}})}
MULTI = with_products(multiangle={"channels": ["photon_532o"]})
CALM = with_products(multiangle={"channels": ["photon_532o"], "largest_gradient": 0.0})
FEW = with_products(signal={"channels": ["photon_532o"], "background_range": [14_990, 15_050]})
OF_ANALOG = with_products(homogeneous={**SECTIONS, "channels": ["analog_532o"]})
OFFSET = with_facts(channels={"photon_532o": {"range_offset": 5}})
SEEN = with_products(homogeneous={**SECTIONS, "visibility": {}})


def scans(*beams: tuple[float, float | None]) -> list[Any]:
    """Return granules of beams, by zenith angle and azimuth."""
    return [
        factories.granule(k, path=f"coast/h{k}", zenith_angle=zenith, azimuth=azimuth)
        for k, (zenith, azimuth) in enumerate(beams)
    ]


def multi(**settings: Any) -> dict[str, Any]:
    return with_products(multiangle={"channels": ["photon_532o"], **settings})


ONE_SIDE = scans(*((15.0 * k, 90.0) for k in range(6)))
BOTH_SIDES = scans(*((15.0 * k, side) for k in range(6) for side in (90.0, 270.0)))
TWO_BEAMS = scans((0.0, 90.0), (60.0, 90.0))
BEYOND = with_products(homogeneous={"channels": ["photon_532o"], "sections": [[14_000, 16_000]]})


@each(
    ("rule", "with_need", "without_need"),
    [
        ("range_window", ([LEVEL], {}), ([LEVEL], OF_ANALOG)),
        ("overlap", ([LEVEL], {}), ([LEVEL], with_facts())),
        ("range_offset", ([LEVEL], OFFSET), ([LEVEL], {})),
        ("dark_files", ([LEVEL, DARK], ANALOG), ([LEVEL], ANALOG)),
        ("dead_time", ([LEVEL], {}), ([LEVEL], with_facts())),
        ("lag", ([UP], GLUED), ([UP], LATE)),
        ("signal", ([LEVEL], ANALOG), ([LEVEL], FEW)),
        ("known_shape", ([UP], ELASTIC), ([UP], TAIL)),
        ("elastic", ([UP], ELASTIC), ([LEVEL], ELASTIC)),
        ("gradient", (SCAN, MULTI), (SCAN, CALM)),
        ("multiangle", (SCAN, MULTI), ([UP], MULTI)),
        ("along_path", ([LEVEL], SEEN), ([LEVEL], {})),
        ("gradient_regressor", (BOTH_SIDES, MULTI), (ONE_SIDE, MULTI)),
        ("gradient_regressor", (BOTH_SIDES, MULTI), (SCAN, MULTI)),
        ("gradient_regressor", (BOTH_SIDES, MULTI), (BOTH_SIDES, multi(method="mld"))),
        ("vertical", (ONE_SIDE, MULTI), (ONE_SIDE, multi(method="kano_hamilton"))),
        ("vertical", (ONE_SIDE, MULTI), (ONE_SIDE, multi(method="mld"))),
        ("vertical", (ONE_SIDE, MULTI), (ONE_SIDE, multi(method="mld_prior"))),
        ("vertical", (ONE_SIDE, MULTI), (TWO_BEAMS, MULTI)),
        ("correlation", (ONE_SIDE, MULTI), (TWO_BEAMS, multi(method="joint"))),
        ("correlation", (ONE_SIDE, MULTI), (ONE_SIDE, multi(method="mld"))),
        ("layers", (ONE_SIDE, multi(layers=[[600, 1200]])), (ONE_SIDE, MULTI)),
    ],
)  # fmt: skip
def test_a_scene_that_needs_a_step_and_one_that_does_not(rule, with_need, without_need):
    granules, changes = with_need
    steps, _ = decided(planned(*granules, **changes), rule)
    assert steps
    granules, changes = without_need
    plan = planned(*granules, **changes)
    steps, reasons = decided(plan, rule)
    assert reasons
    assert all(reasons)
    channels = {omission.channel for omission in plan.left_out if omission.rule == rule}
    assert not [step for step in plan.steps if step.rule == rule and step.channel in channels]


@pytest.mark.parametrize(
    ("name", "changes"),
    [("read", with_products(signal={"channels": []})), ("homogeneous", ANALOG)],
)
def test_what_is_not_requested_is_left_out(name, changes):
    assert name in {step.name for step in planned(LEVEL).steps}
    plan = planned(LEVEL, **changes)
    omissions = [omission for omission in plan.left_out if omission.name == name]
    assert {omission.rule for omission in omissions} == {"request"}
    assert all(omission.reason for omission in omissions)
    left_out = {(omission.name, omission.channel) for omission in omissions}
    assert not left_out & {(step.name, step.channel) for step in plan.steps}


@each(
    ("rule", "with_need", "without_need"),
    [
        ("noise", ([LEVEL], {}), ([LEVEL], with_products())),
        ("glue", ([UP], GLUED), ([UP], ELASTIC)),
        ("background", ([LEVEL], ANALOG), ([LEVEL], {})),
        ("average", ([UP], ELASTIC), ([LEVEL], ELASTIC)),
        ("molecular", ([UP], ELASTIC), ([LEVEL], {})),
        ("reference", ([UP], ELASTIC), ([LEVEL], ELASTIC)),
    ],
)
def test_a_rule_whose_question_does_not_arise_decides_nothing(rule, with_need, without_need):
    assert decided(planned(*with_need[0], **with_need[1]), rule)[0]
    assert decided(planned(*without_need[0], **without_need[1]), rule) == ([], [])


@pytest.mark.parametrize(
    ("rule", "changes"),
    [
        ("section_inside", BEYOND),
        ("channel_present", with_products(signal={"channels": ["photon_999x"]})),
        ("facts_fit", with_facts(channels={"photon_999x": {}})),
    ],
)
def test_impossible_requests_are_left_out_by_name(rule, changes):
    assert decided(planned(LEVEL, **changes), rule)[1]
    assert decided(planned(LEVEL), rule) == ([], [])


@each(
    ("granules", "rule", "number"),
    [
        (ONE_SIDE, "gradient_regressor", 360.0),
        (BOTH_SIDES, "gradient_regressor", 180.0),
        (scans((0.0, 0.0), (30.0, 0.0), (30.0, 120.0), (30.0, 240.0)), "gradient_regressor", 120.0),
        # The azimuths of a beam near the zenith are one direction, negative angles the other side.
        (scans((0.0, 0.0), (0.0, 200.0), (50.0, 10.0)), "correlation", 0.0),
        (scans((60.0, 90.0), (-60.0, 90.0), (0.0, 90.0)), "gradient_regressor", 180.0),
        (ONE_SIDE, "correlation", 4.0),
        (ONE_SIDE, "vertical", 100.0),
    ],
)
def test_numbers_of_scans(granules, rule, number):
    plan = planned(*granules, **MULTI)
    (decision,) = (step for step in (*plan.steps, *plan.left_out) if step.rule == rule)
    assert decision.number == pytest.approx(number)


JITTER = scans(
    *((zenith + off, 90.0) for zenith in (10.0, 30.0, 50.0) for off in (-0.2, -0.07, 0.07, 0.2))
)
NEARLY_OPPOSITE = scans((0.0, 0.0), (30.0, 0.0), (60.0, 0.0), (30.0, 180.1), (60.0, 180.1))
FLAT = scans((0.0, 90.0), (30.0, 90.0), (60.0, 90.0), (88.0, 270.0))


@pytest.mark.parametrize(
    ("granules", "count"), [(JITTER, 3), (NEARLY_OPPOSITE, 5), (FLAT, 3), (BOTH_SIDES, 11)]
)
def test_the_beams_of_a_plan_are_those_of_the_retrieval(granules, count):
    plan = planned(*granules, **MULTI)
    decisions = {decision.rule: decision for decision in (*plan.steps, *plan.left_out)}
    beams, surrounded = retrieved(granules, highest=6000.0, step=60.0)
    assert beams == decisions["correlation"].number + 2 == count
    assert surrounded == (decisions["gradient_regressor"] in plan.steps)


def retrieved(granules: list[Any], *, highest: float, step: float) -> tuple[int, bool]:
    """Return the number of beams of the retrieval, and whether it can estimate a gradient."""
    times = np.datetime64("2026-03-01", "ns") + np.arange(len(granules)) * np.timedelta64(60, "s")
    distance = 7.5 * (np.arange(4000) + 0.5)
    power = np.tile(1e6 / distance**2, (len(granules), 1))
    flat = (("time", "range"), np.zeros(power.shape, dtype=np.int32))
    profiles = xr.Dataset(
        {
            "power": (("time", "range"), power),
            "variance": flat,
            "quality": flat,
            "noise_correlation_length": ("time", np.ones(len(power))),
        },
        coords={"range": distance},
    )
    on_levels = on_altitudes(
        profiles,
        zenith_angle=np.array([granule.zenith_angle for granule in granules]),
        azimuth=np.array([granule.azimuth for granule in granules]),
        time_bnds=np.stack([times, times + np.timedelta64(60, "s")], axis=-1),
        shots=np.ones(len(granules)),
        altitude_grid=np.arange(step, highest + 1e-6, step) + 20.0,
        station_altitude=20.0,
        background_range=(27_000.0, 30_000.0),
    )
    scan = slant_paths.make_scan(
        on_levels["beam_zenith_angle"].to_numpy(),
        on_levels["altitude"].to_numpy() - 20.0,
        on_levels["beam_azimuth"].to_numpy(),
    )
    signal = on_levels["signal"].to_numpy()
    return on_levels.sizes["beam"], _block.make_beam_block(
        signal, np.ones(signal.shape), scan
    ).sides


def test_cycles_of_one_beam_are_warned_of_with_their_first_file():
    def step_of(granules):
        (step,) = (step for step in planned(*granules, **MULTI).steps if step.name == "multiangle")
        return step

    beams = [10.0 * k for k in range(8)]
    cycle = scans(*((angle, 90.0) for angle in beams))
    assert step_of(cycle).warning == ""
    assert "cycles" not in step_of(cycle).reason
    lone = [
        factories.granule(60 * k, path=f"coast/lone{k}", zenith_angle=0.0, azimuth=90.0)
        for k in (1, 2)
    ]
    # A level beam is of no cycle.
    level = factories.granule(180, path="coast/level", zenith_angle=90.0, azimuth=90.0)
    step = step_of([*cycle, *lone, level])
    assert step.reason.count("8 directions, in 3 cycles of at most 8") == 1
    assert step.warning.startswith("cycles of one beam only: 2 of 3. All their values are rejected")
    assert "leave their files out of `files` (first: coast/lone1)" in step.warning


@each(
    ("method", "retrieved"),
    [("auto", True), ("joint", True), ("two_angle", False), ("mld", False), ("mld_prior", False)],
)
def test_a_gradient_is_said_to_be_retrieved_by_methods_that_fit_it(method, retrieved):
    plan = planned(*BOTH_SIDES, **multi(method=method))
    (gradient,) = (step for step in plan.steps if step.name == "gradient")
    assert "part of the error" in gradient.reason
    assert ("retrieved" in gradient.reason) == retrieved
    assert ("gradient_regressor" in {step.name for step in plan.steps}) == retrieved


def test_invalid_angles_are_left_to_the_retrieval():
    plan = planned(*scans((-30.0, None), (0.0, None), (30.0, None)), **MULTI)
    assert decided(plan, "correlation") == (
        [],
        ["no beam direction is redundant: residuals show no correlation along altitude"],
    )


# Headers --------------------------------------------------------------------------------------


@each(
    ("angles", "kept"),
    [
        ([90.0], 2),
        ([89.0], 1),
        ([88.0], 0),
        ([None], 0),
        ([0.0, 90.0], 2),
        ([0.0, None], 0),
    ],
)
def test_sections_are_retrieved_along_nearly_level_beams(angles, kept):
    # At 89 degree a beam climbs 65 m over 3750 m, 105 m over 6000 m; the limit is 100 m.
    granules = [factories.granule(k, zenith_angle=angle) for k, angle in enumerate(angles)]
    plan = planned(*granules, products=HOMOGENEOUS)
    steps = [step for step in plan.steps if step.name == "homogeneous"]
    assert sum(len(step.settings["sections"]) for step in steps) == kept
    assert len(decided(plan, "section_level")[1]) == 2 - kept
    whole = planned(*granules, products=HOMOGENEOUS, all_steps=True)
    (step,) = (step for step in whole.steps if step.name == "homogeneous")
    assert len(step.settings["sections"]) == 2
    assert any("all_steps is set" in omission.reason for omission in whole.left_out)


def test_the_window_holds_the_farthest_section_and_the_bins_for_its_noise():
    # 7500 m, a tenth more for the variance, and two bins for rounding.
    plan = planned(products=HOMOGENEOUS)
    (window,) = (step for step in plan.steps if step.name == "range_window")
    assert window.settings == {"bins": [[0, 1102]]}
    assert window.number == 1102
    assert window.rule == "range_window"
    moved = with_facts(channels={"photon_532o": {"range_offset": -75.0}})
    (window,) = (
        s for s in planned(products=HOMOGENEOUS, **moved).steps if s.name == "range_window"
    )
    assert window.settings == {"bins": [[0, 1112]]}


@each(
    ("products", "why"),
    [
        (HOMOGENEOUS, ""),
        ({**HOMOGENEOUS, "signal": {"channels": ["analog_532o"]}}, ""),
        ({**HOMOGENEOUS, "signal": {}}, "signal needs all bins"),
        ({**HOMOGENEOUS, **ELASTIC["products"]}, "elastic needs all bins"),
        ({**HOMOGENEOUS, **GLUED["products"]}, "glued_532o needs all bins"),
        ({**HOMOGENEOUS, **ELASTIC["products"], "signal": {}}, "elastic and signal need all bins"),
    ],
)
def test_a_window_without_effect_states_why(products, why):
    # The beam climbs 90 m along the section, below the limit, and reaches aerosol-free air.
    steep = factories.granule(0, zenith_angle=0.0)
    products = {**products, "homogeneous": {**SECTIONS, "sections": [[750, 840]]}}
    plan = planned(steep, products=products)
    (window,) = (step for step in plan.steps if step.name == "range_window")
    assert idle_window(window, plan.steps) == why
    assert ("photon_532o" in read_windows(plan.steps)) == (not why)
    assert not any(idle_window(step, plan.steps) for step in plan.steps if step is not window)
    # The product of sections states the same, whatever other products there are.
    alone = dependence.plan_closure(plan, [("homogeneous", "photon_532o")])
    assert window in alone.steps
    assert not idle_window(window, alone.steps)


def test_a_window_does_not_depend_on_other_lidars():
    window = PlannedStep(
        "range_window",
        "photon_532o",
        {"bins": [[0, 9]]},
        "near bins",
        "east",
        product="homogeneous",
    )
    signal = PlannedStep("signal", "photon_532o", {}, "requested", "west", product="signal")
    assert not idle_window(window, [window, signal])
    assert read_windows([window, signal]) == {"photon_532o": ((0, 9),)}


# Files ----------------------------------------------------------------------------------------


def archive(folder: Path, **changes: Any):
    for k in range(4):
        raw_archives.write(folder / "raw" / "coast" / f"h{k}", raw_archives.content(k, bins=1000))
    return factories.campaign(**changes).model_copy(
        update={"archive": str(folder / "raw"), "output": str(folder / "out")}
    )


def _channels(campaign):
    return catalogued_scenes(campaign)[0].layout


def test_a_known_file_is_not_read_again(tmp_path):
    campaign = archive(tmp_path)
    read, scenes = [], []
    for settings, force in (({}, False), ({}, True), ({"all_steps": True}, True)):
        with counts_read() as sizes:
            run = reprocess(campaign.model_copy(update=settings), options=Options(force=force))
        read.append(sum(sizes))
        scenes += run.scenes
    unknown, known, complete = scenes
    assert unknown.inputs == known.inputs == complete.inputs
    # All counts of a file are read if its content is not known yet, or always.
    every, of_channel = 4 * 1000 * 4 * len(_channels(campaign)), 4 * 1000 * 4
    assert read[0] - read[1] == every
    assert read[2] == every + of_channel


@pytest.mark.parametrize("far", [1500, 3000, 4500, 6700])
@pytest.mark.parametrize("offset", [-60.0, 0.0, 40.0])
def test_the_window_changes_no_bit_of_a_section(tmp_path, far, offset):
    facts = {"zenith_angle": 90, "channels": {"photon_532o": {"range_offset": offset}}}
    products = {"homogeneous": {"channels": ["photon_532o"], "sections": [[700, far]]}}
    campaign = archive(tmp_path, facts=[facts], products=products)
    scene = catalogued_scenes(campaign)[0]
    plan = plan_scene(scene, campaign)
    values, read = [], []
    for dropped in ([], ["range_window"]):
        steps = tuple(step for step in plan.steps if step.name not in dropped)
        with counts_read() as sizes:
            outcome = process_scene(Job(campaign, scene, replace(plan, steps=steps)))
        values.append(xr.load_dataset(campaign.products_root / outcome.products[0].path))
        read.append(sum(sizes))
    assert read[0] < read[1]
    for name in (
        "total_extinction",
        "total_extinction_standard_error",
        "reduced_chi2",
        "quality_flag",
    ):
        windowed, whole = (product[name].to_numpy() for product in values)
        np.testing.assert_array_equal(windowed, whole)
    assert np.isfinite(values[0]["total_extinction"]).any()


@pytest.mark.parametrize("bytes_at_once", [0, 10**9])
def test_products_are_the_same_bits_read_at_once_and_in_chunks(
    tmp_path, monkeypatch, bytes_at_once
):
    campaign = archive(tmp_path)
    scene = catalogued_scenes(campaign)[0]
    job = Job(campaign, scene, plan_scene(scene, campaign))
    usual = [product.sha256 for product in process_scene(job).products]
    monkeypatch.setattr("lidarops.scene.profiles.IN_MEMORY", bytes_at_once)
    assert [product.sha256 for product in process_scene(job).products] == usual


def test_a_file_with_a_changed_time_is_read_again(tmp_path, monkeypatch):
    campaign = archive(tmp_path)
    first = reprocess(campaign).scenes[0]
    scene = catalogued_scenes(campaign)[0]
    stale = replace(scene, granules=tuple(replace(g, mtime_ns=1) for g in scene.granules))
    with counts_read() as sizes:
        outcome = process_scene(Job(campaign, stale, plan_scene(stale, campaign)))
    assert outcome.inputs == first.inputs
    assert sum(sizes) > 4 * 1000 * 4 * len(_channels(campaign))
    seen: list[str] = []
    read = RawFile.read_header
    monkeypatch.setattr(
        RawFile,
        "read_header",
        lambda file, parse: seen.append(Path(file.path).name) or read(file, parse),
    )
    process_scene(Job(campaign, stale, plan_scene(stale, campaign)))
    assert set(seen) == {"h0", "h1", "h2", "h3"}


def test_headers_of_unchanged_files_are_not_read_again(tmp_path, monkeypatch):
    campaign = archive(tmp_path)
    first = reprocess(campaign).scenes[0]
    seen: list[str] = []
    read = RawFile.read_header
    monkeypatch.setattr(
        RawFile,
        "read_header",
        lambda file, parse: seen.append(Path(file.path).name) or read(file, parse),
    )

    def again(**changes: Any) -> list[str]:
        seen.clear()
        # Elsewhere: a file whose values do not change stays as it is.
        output = str(tmp_path / f"again-{len(made)}")
        known = {"catalog": campaign.catalog_url, "output": output}
        changed = campaign.model_copy(update=known | changes)
        made.append(reprocess(changed, options=Options(force=True)).scenes[0].products)
        return seen

    made: list[tuple[ProductRecord, ...]] = []
    assert again() == ["h0"]
    assert [product.sha256 for product in made[0]] == [p.sha256 for p in first.products]
    assert set(again(all_steps=True)) == {"h0", "h1", "h2", "h3"}
    with Store(campaign.catalog_url, campaign.name) as store, store.transaction() as connection:
        connection.execute(sa.update(GRANULE).values(header_digest=None))
    assert set(again()) == {"h0", "h1", "h2", "h3"}


def test_reasons_of_an_empty_scene_begin_with_requested_products(tmp_path):
    campaign = archive(tmp_path, facts=[{"zenith_angle": 0.0}])
    (reason,) = bring_up_to_date(campaign).empty_scenes.values()
    assert reason.startswith("nothing to do: homogeneous of photon_532o: section 750-4500 m")
    assert "no product of the campaign uses" not in reason


# All together ---------------------------------------------------------------------------------


def _opened(record: RunRecord) -> dict[str, xr.Dataset]:
    root = Path(record.products)
    return {
        product.path: xr.load_dataset(root / product.path)
        for scene in record.scenes
        for product in scene.products
    }


_MAIN = {
    "homogeneous": ("total_extinction", "total_extinction_standard_error"),
    "elastic": ("aerosol_backscatter", "aerosol_backscatter_standard_error"),
    "multiangle": ("total_extinction", "total_extinction_standard_error"),
    "visibility": ("total_extinction", "total_extinction_standard_error"),
}


@pytest.mark.slow
def test_omissions_lose_and_change_no_good_value(tmp_path):
    campaign = mixed_campaign.write(tmp_path, profiles=40)
    simulate_campaign(campaign)
    reprocess(campaign)
    with counts_read() as planned_sizes:
        planned_run = reprocess(campaign, options=Options(force=True))
    all_steps = campaign.model_copy(
        update={"all_steps": True, "output": str(tmp_path / "everything")}
    )
    with counts_read() as sizes:
        whole = reprocess(all_steps, options=Options(force=True))
    assert len(whole.scenes) >= 8
    planned_products, all_products = _opened(planned_run), _opened(whole)
    good = 0
    for path, full in all_products.items():
        kind = path.rsplit("/", 1)[-1]
        value, error = next(names for key, names in _MAIN.items() if key in kind)
        unflagged = full["quality_flag"].to_numpy() == 0
        good += int(unflagged.sum())
        if path not in planned_products:
            assert not unflagged.any()
            continue
        product = planned_products[path]
        assert (product["quality_flag"].to_numpy()[unflagged] == 0).all()
        difference = np.abs(product[value].to_numpy() - full[value].to_numpy())[unflagged]
        assert np.all(difference <= 0.1 * full[error].to_numpy()[unflagged])
    assert good > 1000
    assert sum(planned_sizes) <= 0.5 * sum(sizes)


def test_a_section_is_left_out_where_it_holds_no_triple_of_the_cubic():
    cubic = {**SECTIONS, "method": "cubic", "lag": 300}
    plan = planned(LEVEL, **with_products(homogeneous=cubic))
    (step,) = (step for step in plan.steps if step.name == "homogeneous")
    assert step.settings["sections"] == [[1500, 7500]]
    assert step.settings["lag"] == 300
    assert any(
        "fewer than 601 bins, which the cubic needs for lag: 300" in reason
        for reason in decided(plan, "section_inside")[1]
    )


@pytest.mark.parametrize(("given", "windows"), [({"photon_532o": [2.0, 0.1]}, 1), (None, 0)])
def test_far_bins_are_read_for_their_background_only(given, windows):
    known = {
        "channels": ["photon_532o"], "sections": [[750, 4500]],
        "method": "known_background", "background": given,
    }  # fmt: skip
    plan = planned(LEVEL, **with_products(homogeneous=known))
    assert len([step for step in plan.steps if step.name == "range_window"]) == windows
    (step,) = (step for step in plan.steps if step.name == "homogeneous")
    assert ("background" in step.settings) == bool(windows)
    assert ("background_range" in step.settings) != bool(windows)

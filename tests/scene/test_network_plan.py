"""Networks in the campaign file, their scenes and their plans."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from support.archives.network_plans import MEMBERS, campaign, granules
from support.cases import each
from support.factories import ANALOG, DAY, PHOTON

from lidarops.campaign.model import Campaign
from lidarops.products.visibility.retrieval import angle_between
from lidarops.records import Granule, Plan, Scene
from lidarops.run.scenes import cut_scenes
from lidarops.scene.plan import plan_scene


def networks(settings: Campaign, files: list[Granule]) -> list[Scene]:
    return [scene for scene in cut_scenes(settings, files).scenes if scene.members]


def planned(settings: Campaign, files: list[Granule] | None = None) -> Plan:
    (scene,) = networks(settings, granules() if files is None else files)
    return plan_scene(scene, settings)


def reasons(plan: Plan) -> str:
    return "; ".join(left.reason for left in plan.left_out if left.name == "visibility")


RED = replace(granules()[2], layout=(replace(PHOTON, wavelength=1064e-9),))


def turned(degree: float) -> list[Granule]:
    """One granule of each member, whose beams are turned."""
    return [replace(g, azimuth=(g.azimuth or 0.0) + degree) for g in granules(10 + degree)]


class TestCampaign:
    def test_a_network_has_defaults(self):
        settings = campaign().networks["valley"].visibility
        assert settings.visibility.threshold == 0.05
        assert settings.average == timedelta(minutes=10)

    @each(
        ("visibility", "message"),
        [
            ({"average": "7min"}, "divide a day"),
            ({"average": "20min", "block": "30min"}, "multiple of average"),
            ({"exponents": {"south-lidar": 1.2}}, "not in instruments"),
            ({"background_range": [9000, 8000]}, "end farther"),
            ({"visibility": {"contrast": 1.5}}, "contrast"),
            ({"visibility": {"law": "angstrom"}}, "angstrom_exponent"),
            ({"visibility": {"exponent_standard_error": 0.2}}, "needs a law"),
        ],
    )
    def test_invalid_settings_are_refused(self, visibility, message):
        with pytest.raises(ValidationError, match=message):
            campaign(visibility)

    @pytest.mark.parametrize(
        ("network", "message"),
        [
            ({"instruments": ["west-lidar"]}, "at least 2"),
            ({"instruments": ["west-lidar", "west-lidar"]}, "twice"),
            ({"instruments": ["west-lidar", "moon-lidar"]}, "unknown instrument 'moon-lidar'"),
        ],
    )
    def test_members_are_instruments(self, network, message):
        settings = {"valley": network | {"visibility": {"channel": "photon_532o"}}}
        with pytest.raises(ValidationError, match=message):
            campaign(networks=settings)

    def test_the_key_of_a_network_is_unique(self):
        settings = {"west": {"instruments": MEMBERS, "visibility": {"channel": "photon_532o"}}}
        with pytest.raises(ValidationError, match="key of an instrument or station"):
            campaign(networks=settings)

    @pytest.mark.parametrize(("contrast", "value"), [(0.02, 0.02), ("paper", 0.049787)])
    def test_contrasts(self, contrast, value):
        settings = campaign({"visibility": {"contrast": contrast}}).networks["valley"].visibility
        assert settings.visibility.threshold == pytest.approx(value, abs=1e-6)


class TestScenes:
    def test_members_keep_scenes_of_their_own(self):
        settings = campaign()
        scenes = cut_scenes(settings, granules()).scenes
        assert [scene.instrument for scene in scenes] == [*sorted(MEMBERS), "valley"]
        scene = scenes[-1]
        assert scene.id == "valley_20260301T000000"
        assert [member.instrument for member in scene.members] == MEMBERS
        union = {g.path for member in scene.members for g in member.granules}
        assert {g.path for g in scene.granules} == union

    def test_it_is_cut_where_the_facts_of_any_member_change(self):
        noon = DAY + timedelta(hours=12)
        changed = [
            {"full_overlap_range": 150.0, "valid_to": noon},
            {"full_overlap_range": 300.0, "valid_from": noon},
        ]
        settings = campaign(facts={"east-lidar": changed})
        first, second = networks(settings, [*granules(10), *granules(721)])
        assert first.stop == noon == second.start
        assert [len(member.granules) for member in first.members] == [1, 1, 1]
        near = [
            beam["nearest"] for beam in plan_scene(second, settings).steps[-1].settings["beams"]
        ]
        assert near == [150.0, 300.0, 150.0]

    def test_one_lidar_alone_is_no_network(self):
        assert networks(campaign(), granules()[:1]) == []
        (scene,) = networks(campaign(), granules()[:2])
        assert len(scene.members) == 2

    def test_each_range_grid_makes_a_scene(self):
        short = replace(PHOTON, bins=1000)
        late = replace(granules(30)[0], layout=(short,))
        scenes = networks(campaign(), [*granules(), late])
        assert len(scenes) == 2
        assert len({scene.id for scene in scenes}) == 2
        # Nothing is lost: each granule is in at least one scene.
        assert {g.path for s in scenes for g in s.granules} == {g.path for g in [*granules(), late]}

    @given(st.permutations(granules() + granules(10) + granules(20)))
    def test_the_order_of_files_does_not_matter(self, shuffled):
        settings = campaign()
        assert networks(settings, shuffled) == networks(
            settings, granules() + granules(10) + granules(20)
        )

    def test_without_a_network_nothing_changes(self):
        single_lidars = [s for s in cut_scenes(campaign(), granules()).scenes if not s.members]
        assert single_lidars == list(cut_scenes(campaign(networks={}), granules()).scenes)


class TestPlans:
    def test_it_names_beams_and_members(self):
        plan = planned(campaign())
        step = plan.steps[-1]
        assert step.name == "visibility"
        assert [beam["azimuth"] for beam in step.settings["beams"]] == [70.0, 310.0, 190.0]
        assert "3 beams of 3 instruments have 3 crossings, 3 of them near ones" in step.reason
        per_member = [s for s in plan.steps if s.instrument]
        assert {s.instrument for s in per_member} == set(MEMBERS)
        assert all(s.reason.startswith(f"{s.instrument}: ") for s in per_member)
        names = [s.name for s in plan.steps if s.instrument == "west-lidar"]
        assert names == ["read", "overlap", "noise", "background", "range_window"]
        joint = [s.name for s in plan.steps if not s.instrument]
        assert joint == ["average", "prior", "visibility"]

    def test_members_are_not_read_for_themselves(self):
        settings = campaign()
        alone = next(
            s for s in cut_scenes(settings, granules()).scenes if s.instrument == "west-lidar"
        )
        plan = plan_scene(alone, settings)
        assert plan.steps == ()
        left_out = {left.channel: left.reason for left in plan.left_out}
        assert left_out["photon_532o"] == "used only by network valley"
        assert left_out["analog_532o"] == "no product of the campaign uses this channel"
        glued = plan_scene(alone, campaign({"channel": "glued_532o"}))
        assert {left.reason for left in glued.left_out} == {"used only by network valley"}

    def test_it_is_plain_data(self):
        plan = planned(campaign({"exponents": {"east-lidar": 1.2}}))
        assert plan.as_dict()["steps"][0]["instrument"] == "west-lidar"
        assert [beam["exponent"] for beam in plan.steps[-1].settings["beams"]] == [1.0, 1.2, 1.0]
        assert plan.hash != planned(campaign()).hash

    @pytest.mark.parametrize(
        ("facts", "changes", "message"),
        [
            ({"west-lidar": [{}]}, {}, "west-lidar: the campaign gives neither full_overlap_range"),
            ({}, {"layout": (ANALOG,)}, "the files hold no photon_532o, only analog_532o"),
            ({}, {"zenith_angle": None}, "neither headers nor campaign give the pointing"),
            (
                {},
                {"layout": (replace(PHOTON, wavelength=float("nan")),)},
                "wavelength in the header is implausible",
            ),
        ],
    )
    def test_the_reason_names_what_a_member_lacks(self, facts, changes, message):
        plan = planned(campaign(facts=facts), granules(**changes))
        assert plan.steps == ()
        assert message in reasons(plan)

    def test_the_reason_names_beams_without_crossings(self):
        plan = planned(campaign(), granules(zenith_angle=0.0))
        assert plan.steps == ()
        assert "no beam has two crossings with other beams" in reasons(plan)
        assert "fewer than two crossings with other beams" in reasons(plan)

    def test_the_reason_names_a_missing_member(self):
        plan = planned(campaign(), granules()[:2])
        assert "north-lidar: no granule in the window" in reasons(plan)

    def test_members_must_have_one_wavelength(self):
        other = (replace(PHOTON, wavelength=1064e-9),)
        red = [*granules()[:2], replace(granules()[2], layout=other)]
        assert "different wavelengths: 532, 1064 nm" in reasons(planned(campaign(), red))

    @each(
        ("rule", "settings", "files", "number"),
        [
            ("member_present", {}, granules()[:2], 0.0),
            ("member", {"facts": {"west-lidar": [{}]}}, None, 0.0),
            ("beams_meet", {}, granules(zenith_angle=0.0), 0.0),
            ("some_meet", {}, granules(zenith_angle=0.0), 0.0),
            ("one_wavelength", {}, [*granules()[:2], RED], 532e-9),
            ("few_beams", {}, [g for k in range(180) for g in turned(k)], 540.0),
            ("prior", {"visibility": {"prior": "none"}}, None, None),
        ],
    )
    def test_rules_that_leave_out(self, rule, settings, files, number):
        plan = planned(campaign(**settings), files)
        omissions = [omission for omission in plan.left_out if omission.rule == rule]
        assert omissions
        assert all(omission.number == pytest.approx(number) for omission in omissions)
        whole = planned(campaign())
        assert not [omission for omission in whole.left_out if omission.rule == rule]

    @pytest.mark.parametrize(
        ("rule", "number"),
        [
            ("background", 200.0),
            ("average", 600.0),
            ("prior", 36.0),
            ("visibility", 3.0),
        ],
    )
    def test_rules_that_run_steps(self, rule, number):
        plan = planned(campaign())
        steps = [step for step in plan.steps if step.rule == rule]
        assert steps
        assert all(step.number == pytest.approx(number) for step in steps)
        without_crossings = planned(campaign(), granules(zenith_angle=0.0))
        assert without_crossings.steps == ()

    def test_the_range_window_holds_the_bins_of_crossings_and_background(self):
        plan = planned(campaign())
        windows = [step for step in plan.steps if step.rule == "member_window"]
        assert len(windows) == len(MEMBERS)
        for window in windows:
            kept = window.settings["bins"]
            assert window.number == sum(past - first for first, past in kept)
            assert kept[0][0] == 0
            assert kept[-1][1] == PHOTON.bins
            # The points are 4 km away; the tail begins at 13.5 km.
            assert 4000.0 < kept[0][1] * PHOTON.bin_width < 8000.0
            assert 13_450.0 < kept[-1][0] * PHOTON.bin_width < 13_500.0
            (before,) = kept[1:-1]
            assert -50.0 < before[0] * PHOTON.bin_width - 0.6 * 13_500 < 0.0
            assert 0.0 < before[1] * PHOTON.bin_width - 0.7 * 13_500 < 50.0

    @pytest.mark.parametrize(
        ("settings", "layout", "message"),
        [
            ({"all_steps": True}, PHOTON, "all_steps is set"),
            ({"visibility": {"channel": "analog_532o"}}, ANALOG, "noise of an analog record"),
            ({}, replace(PHOTON, bins=650), "need all bins"),
        ],
    )
    def test_all_bins_are_read_where_they_are_needed(self, settings, layout, message):
        files = granules(layout=(layout,))
        plan = planned(campaign(**settings), files)
        assert plan.steps[-1].name == "visibility"
        omissions = [omission for omission in plan.left_out if omission.rule == "member_window"]
        assert len(omissions) == len(MEMBERS)
        assert all(message in omission.reason for omission in omissions)
        assert not [step for step in plan.steps if step.rule == "member_window"]

    def test_facts_override_headers(self):
        facts = [{"full_overlap_range": 150.0, "zenith_angle": 90.0, "azimuth": 70.0}]
        strange = [replace(granules()[0], azimuth=12.0, zenith_angle=3.0), *granules()[1:]]
        plan = planned(campaign(facts={"west-lidar": facts}), strange)
        assert plan.steps[-1].settings["beams"][0]["azimuth"] == 70.0

    def test_beams_of_one_instrument_are_distinguished(self):
        other = [replace(g, azimuth=(g.azimuth or 0) + 2.0) for g in granules(10)]
        jitter = [replace(g, azimuth=(g.azimuth or 0) + 0.05) for g in granules(20)]
        beams = planned(campaign(), [*granules(), *other, *jitter]).steps[-1].settings["beams"]
        assert [beam["instrument"] for beam in beams] == [m for m in MEMBERS for _ in range(2)]


@given(st.floats(0, 180), st.floats(0, 360), st.floats(0, 180), st.floats(0, 360))
def test_angles_between_pointings(zenith, azimuth, other_zenith, other_azimuth):
    first, second = (zenith, azimuth), (other_zenith, other_azimuth)
    assert angle_between(first, first) < 1e-5
    assert angle_between(first, second) == pytest.approx(angle_between(second, first), abs=1e-9)
    assert angle_between((zenith, 0.0), (other_zenith, 0.0)) == pytest.approx(
        abs(zenith - other_zenith), abs=1e-5
    )

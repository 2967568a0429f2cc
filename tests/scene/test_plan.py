"""Plans of single instruments: steps that run, steps that are left out, and their reasons."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from support import factories
from support.cases import each

from lidarops.errors import SceneError
from lidarops.kinds import Scope, kinds_of
from lidarops.records import Plan, Role, Scene
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.run.scenes import cut_scenes
from lidarops.scene import dependence
from lidarops.scene.case import member_channel
from lidarops.scene.plan import plan_scene


def _scene(*granules: object) -> Scene:
    members = granules or (factories.granule(0),)
    return cut_scenes(factories.campaign(), members).scenes[0]  # type: ignore[arg-type]


def _steps(result: Plan, channel: str) -> dict[str, dict[str, object]]:
    return {step.name: dict(step.settings) for step in result.steps if step.channel == channel}


def _left_out(result: Plan, channel: str) -> dict[str, str]:
    return {left.name: left.reason for left in result.left_out if left.channel == channel}


def test_photon_channel() -> None:
    result = plan_scene(_scene(), factories.campaign())
    steps = _steps(result, "photon_532o")
    assert list(steps) == [
        "read",
        "overlap",
        "dead_time",
        "noise",
        "range_window",
        "homogeneous",
    ]
    assert steps["dead_time"] == {
        "dead_time": 4e-9,
        "dead_time_uncertainty": 0.2,
    }
    assert steps["homogeneous"]["sections"] == [[750.0, 4500.0]]
    assert "photon-counting background" in _left_out(result, "photon_532o")["dark"]


def test_a_channel_that_no_product_uses_is_not_read() -> None:
    result = plan_scene(_scene(), factories.campaign())
    assert not _steps(result, "analog_532o")
    assert "no product" in _left_out(result, "analog_532o")["read"]


def test_a_channel_without_any_product_is_not_read() -> None:
    products = {
        "homogeneous": {"channels": ["analog_532o"], "sections": [[14_000, 16_000]]},
        "signal": {"channels": ["photon_532o"]},
    }
    result = plan_scene(_scene(), factories.campaign(products=products))
    assert {step.channel for step in result.steps} == {"photon_532o"}
    left_out = _left_out(result, "analog_532o")
    assert set(left_out) == {"read", *(kind.name for kind in kinds_of(Scope.CHANNEL))}
    assert left_out["read"] == "no requested product of this channel can be made"
    assert "14000-16000 m" in left_out["homogeneous"]


@pytest.mark.parametrize(
    "products",
    [
        {"signal": {"channels": ["glued_532o"]}},
        {"elastic": {"channels": ["glued_532o"]}, "signal": {"channels": ["photon_532o"]}},
        {
            "homogeneous": {"channels": ["analog_532o"], "sections": [[14_000, 16_000]]},
            "signal": {"channels": "all"},
        },
    ],
)
def test_steps_of_a_plan_are_those_that_its_products_need(products: dict[str, object]) -> None:
    result = plan_scene(_scene(), factories.campaign(products=products))
    needed = dependence.plan_closure(result, result.product_keys)
    assert [(s.channel, s.name, s.settings) for s in result.steps] == [
        (s.channel, s.name, s.settings) for s in needed.steps
    ]
    read = {step.channel for step in result.steps if step.name == "read"}
    idle = {left.channel for left in result.left_out if left.name == "read"}
    assert not read & idle


@pytest.mark.parametrize("with_dark", [True, False])
def test_dark_only_where_there_are_dark_files(*, with_dark: bool) -> None:
    campaign = factories.campaign(products={"signal": {"channels": ["analog_532o"]}})
    granules = [factories.granule(0)]
    if with_dark:
        granules.append(factories.granule(-30, path="dark/d", role=Role.DARK))
    result = plan_scene(_scene(*granules), campaign)
    assert ("dark" in _steps(result, "analog_532o")) is with_dark
    assert ("dark" in _left_out(result, "analog_532o")) is not with_dark


def test_a_dead_time_of_zero_means_that_counts_are_corrected() -> None:
    campaign = factories.campaign(facts=[{"channels": {"photon_532o": {"dead_time": 0}}}])
    result = plan_scene(_scene(), campaign)
    assert _steps(result, "photon_532o")["dead_time"] == {
        "dead_time": 0.0,
        "dead_time_uncertainty": 0.0,
    }
    reasons = {step.name: step.reason for step in result.steps if step.channel == "photon_532o"}
    assert reasons["dead_time"] == "0 by the campaign: the counts of the files are corrected"


def test_the_reason_names_an_unknown_dead_time() -> None:
    result = plan_scene(_scene(), factories.campaign(facts=[{}]))
    assert "dead_time" in _left_out(result, "photon_532o")["dead_time"]
    assert "full_overlap_range" in _left_out(result, "photon_532o")["overlap"]


def test_a_channel_that_the_files_lack_is_named() -> None:
    products = {"homogeneous": {"channels": ["photon_999x"], "sections": [[500, 900]]}}
    reason = _left_out(plan_scene(_scene(), factories.campaign(products=products)), "photon_999x")
    assert "photon_532o" in reason["homogeneous"]


def test_a_channel_that_the_files_lack_has_no_layout() -> None:
    layout = _scene().layout
    with pytest.raises(
        SceneError, match="the files hold no channel photon_1o, only photon_532o, analog_532o"
    ):
        member_channel(layout, "photon_1o")
    with pytest.raises(SceneError, match="no channel glued_1o"):
        member_channel(layout, "glued_1o")


@pytest.mark.parametrize("section", [[14_000, 16_000], [1000, 1030]])
def test_a_section_outside_the_bins_is_left_out(section: list[float]) -> None:
    products = {"homogeneous": {"channels": ["photon_532o"], "sections": [section, [750, 4500]]}}
    result = plan_scene(_scene(), factories.campaign(products=products))
    assert f"{section[0]}-{section[1]}" in _left_out(result, "photon_532o")["homogeneous"]
    assert _steps(result, "photon_532o")["homogeneous"]["sections"] == [[750.0, 4500.0]]


@each(
    ("pointings", "farthest", "method"),
    [
        ([(90.0, 20.0), (90.0, 20.0)], 4500, "direct"),
        ([(90.0, 20.0), (60.0, 20.0)], 4500, "known_background"),
        ([(90.0, 20.0), (90.0, 25.0)], 4500, "known_background"),
        ([(90.0, 359.99), (90.0, 0.01)], 4500, "direct"),
        ([(90.0, 358.0), (90.0, 3.0)], 4500, "known_background"),
        # The last tenth of the bins begins before.
        ([(90.0, 20.0), (90.0, 25.0)], 14_500, "direct"),
    ],
)
def test_the_background_of_a_moving_beam_is_that_of_the_far_range(
    pointings: list[tuple[float, float]], farthest: int, method: str
) -> None:
    products = {"homogeneous": {"channels": ["photon_532o"], "sections": [[750, farthest]]}}
    granules = [
        factories.granule(number, zenith_angle=zenith, azimuth=azimuth)
        for number, (zenith, azimuth) in enumerate(pointings)
    ]
    campaign = factories.campaign(products=products, facts=[{}])
    result = plan_scene(_scene(*granules), campaign)
    (step,) = (step for step in result.steps if step.name == "homogeneous")
    assert step.settings["method"] == method
    assert ("because the beam moves" in step.reason) == (method == "known_background")


def test_an_implausible_wavelength_needs_the_campaign() -> None:
    odd = tuple(replace(channel, wavelength=math.nan) for channel in factories.granule().layout)
    scene = _scene(factories.granule(0, layout=odd))
    assert "wavelength" in _left_out(plan_scene(scene, factories.campaign()), "photon_532o")["read"]
    known_facts = factories.campaign(facts=[{"channels": {"photon_532o": {"wavelength": 532e-9}}}])
    assert _steps(plan_scene(scene, known_facts), "photon_532o")["read"]["wavelength"] == 532e-9


def test_the_hash_follows_every_setting() -> None:
    base = plan_scene(_scene(), factories.campaign())
    assert plan_scene(_scene(), factories.campaign()).hash == base.hash
    other = factories.campaign(facts=[{"channels": {"photon_532o": {"dead_time": 5e-9}}}])
    assert plan_scene(_scene(), other).hash != base.hash
    assert json.loads(json.dumps(base.as_dict()))["scene"] == base.scene


@pytest.mark.parametrize("background", [[14_990, 16_000], [20_000, 30_000]])
def test_a_background_without_bins_leaves_the_signal_out(background: list[float]) -> None:
    products = {"signal": {"channels": ["photon_532o"], "background_range": background}}
    result = plan_scene(_scene(), factories.campaign(products=products))
    assert "background_range" in _left_out(result, "photon_532o")["signal"]
    assert "signal" not in _steps(result, "photon_532o")


# Averages, references and glued channels -----------------------------------------------------


def _elastic(*granules: object, facts: dict[str, object] | None = None, **settings: object) -> Plan:
    """Plan the elastic product of a vertical lidar whose bins end at 15 km."""
    known_facts: dict[str, object] = {"zenith_angle": 0.0} if facts is None else facts
    products = {"elastic": {"channels": ["photon_532o"], **settings}}
    campaign = factories.campaign(products=products, facts=[known_facts])
    return plan_scene(_scene(*granules), campaign)


def test_elastic_steps_in_their_order() -> None:
    result = _elastic()
    steps = _steps(result, "photon_532o")
    assert list(steps) == [
        "read",
        "noise",
        "molecular",
        "average",
        "known_shape",
        "reference",
        "elastic",
    ]
    assert steps["average"] == {"seconds": 1800.0}
    assert steps["elastic"] == {
        "lidar_ratio": 50.0,
        "lidar_ratio_standard_error": 10.0,
        "molecular_relative_error": 0.01,
        "least_signal_to_noise": 1.0,
    }
    assert steps["reference"] == {
        "lowest": 3000.0,
        "highest": 12_000.0,
        "width": 1000.0,
        "scattering_ratio": 1.0,
        "relative_error": 0.02,
    }
    assert "elastic" not in _left_out(result, "photon_532o")
    reasons = {step.name: step.reason for step in result.steps}
    assert "US Standard Atmosphere 1976" in reasons["molecular"]
    assert all(reasons.values())
    without = plan_scene(_scene(), factories.campaign())
    assert "not requested" in _left_out(without, "photon_532o")["elastic"]


def test_what_the_campaign_gives_replaces_what_is_assumed() -> None:
    facts = {
        "zenith_angle": 0.0,
        "molecular_profile": "air/ecmwf.nc",
        "overlap_profile": "overlap.csv",
        "full_overlap_range": 120.0,
    }
    result = _elastic(facts=facts, background="tail_mean", average="5min", lidar_ratio=28)
    steps = _steps(result, "photon_532o")
    assert steps["molecular"] == {"molecular_profile": "air/ecmwf.nc"}
    assert steps["overlap"] == {"full_overlap_range": 120.0, "overlap_profile": "overlap.csv"}
    assert steps["average"] == {"seconds": 300.0}
    assert steps["elastic"]["lidar_ratio"] == 28.0
    assert "known_shape" not in steps
    assert "biases" in _left_out(result, "photon_532o")["known_shape"]


def test_each_channel_may_have_a_lidar_ratio_of_its_own() -> None:
    of_photon = {"lidar_ratio": 70, "lidar_ratio_standard_error": 5}
    facts = {"zenith_angle": 0.0, "channels": {"photon_532o": of_photon}}
    channels = ["photon_532o", "analog_532o", "glued_532o"]
    result = _elastic(facts=facts, channels=channels, lidar_ratio=28)
    given = {
        name: (steps["lidar_ratio"], steps["lidar_ratio_standard_error"])
        for name in channels
        if (steps := _steps(result, name)["elastic"])
    }
    assert given == {
        "photon_532o": (70.0, 5.0),
        "analog_532o": (28.0, 10.0),
        "glued_532o": (70.0, 5.0),
    }


def test_a_channel_may_have_a_profile_of_the_lidar_ratio() -> None:
    of_photon = {"lidar_ratio_profile": "ratio.csv"}
    facts = {"zenith_angle": 0.0, "channels": {"photon_532o": of_photon}}
    steps = _steps(_elastic(facts=facts), "photon_532o")["elastic"]
    assert steps["lidar_ratio_profile"] == "ratio.csv"
    # Above a measured profile.
    assert (steps["lidar_ratio"], steps["lidar_ratio_standard_error"]) == (50.0, 10.0)
    for other in ({"lidar_ratio": 50}, {"lidar_ratio_standard_error": 5}):
        facts["channels"] = {"photon_532o": of_photon | other}
        with pytest.raises(ValidationError, match="lidar_ratio_profile is given together with"):
            _elastic(facts=facts)


def test_heights_of_the_reference_become_ranges_along_a_slanted_beam() -> None:
    window = {"lowest": 2000, "highest": 6000, "width": 500}
    steps = _steps(_elastic(facts={"zenith_angle": 60.0}, reference=window), "photon_532o")
    for name, value in (("lowest", 4000.0), ("highest", 12_000.0), ("width", 1000.0)):
        assert steps["reference"][name] == pytest.approx(value)


def test_the_reference_ends_with_the_bins() -> None:
    window = {"lowest": 5000, "highest": 40_000}
    steps = _steps(_elastic(reference=window), "photon_532o")
    # The centre of the last bin, because a window is a set of bin centres.
    assert steps["reference"]["highest"] == 14_996.25


@each(
    ("granules", "facts", "settings", "words"),
    [
        (
            [factories.granule(0, zenith_angle=0.0), factories.granule(5, zenith_angle=10.0)],
            {},
            {},
            "changes from 0 to 10 degree",
        ),
        ([factories.granule(0, zenith_angle=90.0)], {}, {}, "of 90 degree the beam does not"),
        ([], {"zenith_angle": 81.0}, {}, "of 81 degree the beam does not"),
        ([], {"zenith_angle": 180.0}, {}, "of 180 degree the beam does not"),
        ([factories.granule(0, zenith_angle=None)], {}, {}, "neither headers nor campaign"),
        (
            [],
            {"zenith_angle": 0.0},
            {"reference": {"lowest": 14_100, "highest": 20_000}},
            "the last bin at 14996",
        ),
        # 15 km along the beam are 5.1 km above the station.
        (
            [],
            {"zenith_angle": 70.0},
            {"reference": {"lowest": 4500, "highest": 9000}},
            "the last bin at 14996",
        ),
    ],
)
def test_no_elastic_product_without_aerosol_free_air_or_zenith_angle(
    granules: list[object], facts: dict[str, object], settings: dict[str, object], words: str
) -> None:
    result = _elastic(*granules, facts=facts, **settings)
    assert words in _left_out(result, "photon_532o")["elastic"]
    assert not {"average", "reference", "elastic"} & set(_steps(result, "photon_532o"))


def test_a_beam_is_fixed_despite_scattered_readings() -> None:
    still = [factories.granule(minute, zenith_angle=3.0 + 0.004 * minute) for minute in range(10)]
    assert "elastic" in _steps(_elastic(*still, facts={}), "photon_532o")
    # Facts of the campaign override headers.
    moving = [factories.granule(minute, zenith_angle=9.0 * minute) for minute in range(10)]
    assert "elastic" in _steps(_elastic(*moving, facts={"zenith_angle": 5.0}), "photon_532o")


@each("zenith", [0.0, 5.0, 20.0, 30.0, 40.0, 47.0, 60.0, 63.0])
def test_a_reference_of_one_window_is_one_at_any_angle(zenith: float) -> None:
    window = {"lowest": 3000, "highest": 4000, "width": 1000}
    steps = _steps(_elastic(facts={"zenith_angle": zenith}, reference=window), "photon_532o")
    found = steps["reference"]
    bottom, top, width = (found[name] for name in ("lowest", "highest", "width"))
    assert top - bottom == pytest.approx(width)  # type: ignore[operator]


@pytest.mark.parametrize(("offset", "planned"), [(0.0, True), (-30.0, False), (30.0, True)])
def test_an_offset_of_the_bins_moves_their_end(offset: float, *, planned: bool) -> None:
    # 2000 bins end at 15 km, the window needs 14.99 km.
    facts = {"zenith_angle": 0.0, "channels": {"photon_532o": {"range_offset": offset}}}
    window = {"lowest": 13_990, "highest": 20_000, "width": 1000}
    steps = _steps(_elastic(facts=facts, reference=window), "photon_532o")
    assert ("elastic" in steps) is planned


class TestDark:
    def _step(self, *minutes: float) -> dict[str, object]:
        granules = [factories.granule(60), factories.granule(120)]
        granules += [
            factories.granule(minute, path=f"dark/d{minute}", role=Role.DARK) for minute in minutes
        ]
        campaign = factories.campaign(products={"signal": {"channels": ["analog_532o"]}})
        result = plan_scene(_scene(*granules), campaign)
        self.reason = next(step.reason for step in result.steps if step.name == "dark")
        return _steps(result, "analog_532o")["dark"]

    @pytest.mark.parametrize(
        ("minutes", "where"),
        [
            ((0.0, 50.0), "2 dark files within 24 h of the scene, 2 before its profiles"),
            ((130.0, 300.0), "2 dark files within 24 h of the scene, 2 after its profiles"),
        ],
    )
    def test_on_one_side_the_nearest(self, minutes: tuple[float, ...], where: str) -> None:
        assert self._step(*minutes) == {"files": len(minutes), "method": "nearest"}
        assert self.reason == f"{where}: the nearest in time is used"

    @each(
        ("minutes", "where"),
        [
            ((90.0,), "1 dark file within 24 h of the scene, 1 among its profiles"),
            ((0.0,), "1 dark file within 24 h of the scene, 1 before its profiles"),
            ((0.0, 10.0), "2 dark files within 24 h of the scene, 2 before its profiles"),
            ((60.0, 90.0), "2 dark files within 24 h of the scene, 2 among its profiles"),
            (
                (100.0, 115.0, 125.0),
                "3 dark files within 24 h of the scene, 2 among and 1 after its profiles",
            ),
        ],
    )
    def test_one_session_serves_all(self, minutes: tuple[float, ...], where: str) -> None:
        assert self._step(*minutes) == {"files": len(minutes), "method": "nearest"}
        assert self.reason == f"{where}: one session, used for all profiles"

    @pytest.mark.parametrize(
        ("minutes", "where"),
        [
            ((0.0, 300.0), "1 before and 1 after"),
            ((0.0, 90.0), "1 before and 1 among"),
            ((70.0, 110.0), "2 among"),
            ((0.0, 10.0, 90.0, 300.0), "2 before, 1 among and 1 after"),
        ],
    )
    def test_around_it_interpolated(self, minutes: tuple[float, ...], where: str) -> None:
        assert self._step(*minutes) == {"files": len(minutes), "method": "interpolated"}
        files = f"{len(minutes)} dark files within 24 h of the scene"
        assert self.reason == f"{files}, {where} its profiles: interpolated in time"

    @pytest.mark.parametrize("minutes", [(90.0,), (60.0, 90.0), (100.0, 115.0, 125.0)])
    def test_of_one_session_either_method_gives_the_same(self, minutes: tuple[float, ...]) -> None:
        """So that calling it the nearest changes no product."""
        signals = np.random.default_rng(1).normal(size=(len(minutes), 8))
        midnight = np.datetime64("2024-01-01", "m")
        times = midnight + np.array(minutes).astype(int)
        products = midnight + np.array([60, 90, 120])
        nearest, interpolated = (
            DarkSignals(signals, times, method=method).at(products)
            for method in ("nearest", "interpolated")
        )
        assert np.array_equal(nearest, interpolated)

    def test_photon_counting_needs_none(self) -> None:
        dark = factories.granule(0, path="dark/d", role=Role.DARK)
        result = plan_scene(_scene(factories.granule(60), dark), factories.campaign())
        assert "photon-counting background" in _left_out(result, "photon_532o")["dark"]


class TestGlued:
    def _plan(
        self,
        *granules: object,
        analog: dict[str, object] | None = None,
        facts: dict[str, object] | None = None,
        products: dict[str, object] | None = None,
    ) -> Plan:
        known_facts: dict[str, object] = {
            "zenith_angle": 0.0,
            "channels": {"analog_532o": analog or {}, "photon_532o": {"dead_time": 4e-9}},
            **(facts or {}),
        }
        products = products or {"elastic": {"channels": ["glued_532o"]}}
        return plan_scene(
            _scene(*granules), factories.campaign(products=products, facts=[known_facts])
        )

    def test_both_parts_are_read_and_glued(self) -> None:
        result = self._plan()
        for part in ("analog_532o", "photon_532o"):
            assert _steps(result, part)["read"]["wavelength"] == 532e-9
            assert "elastic" not in _steps(result, part)
            assert next(
                s.reason for s in result.steps if (s.channel, s.name) == (part, "read")
            ) == ("required by glued_532o")
        steps = _steps(result, "glued_532o")
        assert list(steps) == [
            "read",
            "lag",
            "glue",
            "molecular",
            "average",
            "known_shape",
            "reference",
            "elastic",
        ]
        assert steps["glue"] == {"analog": "analog_532o", "photon": "photon_532o"}
        assert steps["lag"] == {"method": "estimate"}
        assert _steps(result, "photon_532o")["dead_time"] == {
            "dead_time": 4e-9,
            "dead_time_uncertainty": 0.2,
        }

    @pytest.mark.parametrize(
        ("lag", "settings"),
        [
            (5.5, {"method": "given", "lag": 5.5}),
            (0, {"method": "given", "lag": 0.0}),
            ("estimate", {"method": "estimate"}),
        ],
    )
    def test_lag(self, lag: object, settings: dict[str, object]) -> None:
        result = self._plan(analog={"lag": lag})
        assert _steps(result, "glued_532o")["lag"] == settings
        assert "lag" not in _left_out(result, "glued_532o")

    def test_a_lag_that_range_offsets_state_is_not_estimated(self) -> None:
        result = self._plan(analog={"range_offset": -45.0})
        assert "range offsets" in _left_out(result, "glued_532o")["lag"]

    @pytest.mark.parametrize(
        ("facts", "lag"),
        [
            ({}, "estimate"),
            ({"lag": "estimate", "range_offset": -45.0}, "estimate"),
            ({"lag": 5.5}, "given"),
            ({"range_offset": -45.0}, "given"),
        ],
    )
    def test_an_estimate_of_the_dead_time_takes_the_lag_that_the_campaign_gives(
        self, facts: dict[str, object], lag: str
    ) -> None:
        channels = {"analog_532o": facts, "photon_532o": {"dead_time": "estimate"}}
        result = self._plan(facts={"channels": channels})
        expected = {"analog": "analog_532o", "lag": lag}
        assert _steps(result, "photon_532o")["dead_time"] == expected

    def test_a_lag_of_another_channel_is_not_overlooked(self) -> None:
        known_facts = {"channels": {"photon_532o": {"lag": 5}, "analog_532o": {}}}
        result = self._plan(facts=known_facts)
        assert _steps(result, "glued_532o")["lag"] == {"method": "estimate"}
        assert "analog" in _left_out(result, "photon_532o")["lag"]

    def test_facts_of_a_channel_that_the_files_lack_are_not_overlooked(self) -> None:
        known_facts = {"channels": {"photon_523o": {"dead_time": 4e-9}}}
        reason = _left_out(self._plan(facts=known_facts), "photon_523o")["read"]
        assert "photon_532o" in reason

    def test_a_part_that_the_files_lack_is_named(self) -> None:
        alone = factories.granule(0, layout=(factories.PHOTON,))
        reason = _left_out(self._plan(alone), "glued_532o")["elastic"]
        assert "no analog_532o" in reason
        assert "photon_532o" not in reason
        assert not _steps(self._plan(alone), "glued_532o")

    def test_parts_of_different_bin_width_are_not_glued(self) -> None:
        odd = factories.granule(
            0, layout=(factories.PHOTON, replace(factories.ANALOG, bin_width=15))
        )
        assert "7.5 m" in _left_out(self._plan(odd), "glued_532o")["elastic"]

    def test_the_glued_channel_ends_with_the_shorter_part(self) -> None:
        short = factories.granule(0, layout=(factories.PHOTON, replace(factories.ANALOG, bins=500)))
        reason = _left_out(self._plan(short), "glued_532o")["elastic"]
        assert "the last bin at 3746" in reason

    def test_a_glued_channel_is_made_only_on_request(self) -> None:
        result = self._plan(products={"signal": {"channels": "all"}})
        assert not _steps(result, "glued_532o")
        requested = self._plan(products={"signal": {"channels": ["glued_532o"]}})
        assert list(_steps(requested, "glued_532o")) == [
            "read",
            "lag",
            "glue",
            "background",
            "signal",
        ]

    def test_a_glued_channel_has_no_homogeneous_product(self) -> None:
        products = {
            "elastic": {"channels": ["glued_532o"]},
            "homogeneous": {"channels": ["glued_532o"], "sections": [[750, 4500]]},
        }
        result = self._plan(products=products)
        assert "homogeneous" not in _steps(result, "glued_532o")
        reasons = [x.reason for x in result.left_out if x.channel == "glued_532o"]
        assert any("own background" in reason for reason in reasons)

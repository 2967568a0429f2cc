"""Grouping of granules into scenes."""

from __future__ import annotations

import random
from dataclasses import replace
from datetime import timedelta

from support import factories

from lidarops.records import Granule, Role, Status
from lidarops.run.options import Selection
from lidarops.run.scenes import cut_scenes, scene_stop


def test_one_scene_for_each_utc_day() -> None:
    granules = [factories.granule(minutes) for minutes in (0, 1439, 1440, 2000)]
    scenes = cut_scenes(factories.campaign(), granules).scenes
    assert [len(scene.granules) for scene in scenes] == [2, 2]
    assert [scene.id for scene in scenes] == ["lidar_20260301T000000", "lidar_20260302T000000"]
    assert scenes[0].stop - scenes[0].start == timedelta(days=1)


def test_a_window_divides_the_day() -> None:
    campaign = factories.campaign()
    campaign = campaign.model_copy(
        update={"scenes": campaign.scenes.model_copy(update={"window": timedelta(hours=6)})}
    )
    granules = [factories.granule(60 * hour) for hour in range(24)]
    scenes = cut_scenes(campaign, granules).scenes
    assert [scene.start.hour for scene in scenes] == [0, 6, 12, 18]
    assert all(len(scene.granules) == 6 for scene in scenes)


def scan_of(cycles: int, first: float) -> list[Granule]:
    """Return a scan over 10 elevations to one azimuth, one a minute, from a minute of the day."""
    return [
        factories.granule(
            first + minute, zenith_angle=85.0 - 5.0 * (minute % 10), azimuth=62.0 + minute // 5 % 2
        )
        for minute in range(10 * cycles)
    ]


def test_a_scan_cycle_belongs_to_the_window_in_which_it_begins() -> None:
    campaign = factories.campaign()
    hourly = campaign.scenes.model_copy(update={"window": timedelta(hours=1)})
    campaign = campaign.model_copy(update={"scenes": hourly})
    granules = scan_of(12, 5.0)
    scenes = cut_scenes(campaign, granules).scenes
    assert [(scene.start.hour, len(scene.granules)) for scene in scenes] == [(0, 60), (1, 60)]
    random.Random(1).shuffle(granules)
    assert cut_scenes(campaign, granules).scenes == scenes
    one = (factories.DAY + timedelta(hours=1)).isoformat()
    changed = factories.campaign(facts=[{"valid_to": one}, {"valid_from": one}])
    changed = changed.model_copy(update={"scenes": hourly})
    scenes = cut_scenes(changed, granules).scenes
    assert [len(scene.granules) for scene in scenes] == [55, 60, 5]


def test_a_scene_ends_where_the_facts_change() -> None:
    noon = factories.DAY + timedelta(hours=12, minutes=7)
    campaign = factories.campaign(
        facts=[
            {"valid_to": noon.isoformat(), "channels": {"photon_532o": {"dead_time": 4e-9}}},
            {"valid_from": noon.isoformat(), "channels": {"photon_532o": {"dead_time": 9e-9}}},
        ]
    )
    scenes = cut_scenes(campaign, [factories.granule(60 * hour) for hour in range(24)]).scenes
    assert [(scene.start, scene.stop) for scene in scenes] == [
        (factories.DAY, noon),
        (noon, factories.DAY + timedelta(days=1)),
    ]
    assert [len(scene.granules) for scene in scenes] == [13, 11]


def test_the_end_of_a_scene_is_known_by_its_name() -> None:
    noon = factories.DAY + timedelta(hours=12, minutes=7)
    campaign = factories.campaign(
        facts=[{"valid_to": noon.isoformat()}, {"valid_from": noon.isoformat()}]
    )
    windows = (campaign.scenes.window, timedelta(hours=6), timedelta(minutes=30))
    for window in windows:
        scenes = campaign.scenes.model_copy(update={"window": window})
        other = campaign.model_copy(update={"scenes": scenes})
        found = cut_scenes(other, [factories.granule(20 * k) for k in range(72)]).scenes
        assert [scene_stop(scene.id, other) for scene in found] == [scene.stop for scene in found]
    assert scene_stop("gone_20260301T000000", campaign) == factories.DAY + timedelta(days=1)


def test_any_order_of_files_gives_the_same_scenes() -> None:
    granules = [factories.granule(7 * k) for k in range(400)]
    expected = cut_scenes(factories.campaign(), granules)
    shuffled = granules.copy()
    random.Random(1).shuffle(shuffled)
    assert cut_scenes(factories.campaign(), shuffled) == expected


def test_other_grids_make_other_scenes() -> None:
    coarse = tuple(replace(channel, bin_width=15.0) for channel in factories.granule().layout)
    granules = [factories.granule(k, **({"layout": coarse} if k == 3 else {})) for k in range(6)]
    scenes = cut_scenes(factories.campaign(), granules).scenes
    assert sorted(len(scene.granules) for scene in scenes) == [1, 5]
    assert len({scene.id for scene in scenes}) == 2


def test_two_files_of_one_time_are_not_counted_twice() -> None:
    twin = factories.granule(5, path="coast/z-copy")
    result = cut_scenes(factories.campaign(), [factories.granule(5), twin, factories.granule(6)])
    assert len(result.scenes[0].granules) == 2
    assert [aside.path for aside in result.set_aside] == ["coast/z-copy"]
    assert result.set_aside[0].status is Status.REFUSED
    assert factories.granule(5).path in result.set_aside[0].reason


def test_dark_files_serve_scenes_within_a_day() -> None:
    near = factories.granule(-60, path="dark/near", role=Role.DARK)
    far = factories.granule(-60 * 48, path="dark/far", role=Role.DARK)
    scene = cut_scenes(factories.campaign(), [factories.granule(0), near, far]).scenes[0]
    assert [granule.path for granule in scene.dark] == ["dark/near"]


def test_refused_granules_are_passed_over() -> None:
    refused = factories.granule(1, status=Status.REFUSED, reason="truncated", start=None)
    assert (
        len(cut_scenes(factories.campaign(), [factories.granule(0), refused]).scenes[0].granules)
        == 1
    )


def test_a_selection_of_times_holds_the_scenes_that_touch_it() -> None:
    campaign = factories.campaign()
    scenes = cut_scenes(campaign, [factories.granule(0), factories.granule(1500)]).scenes
    for selection in (
        Selection(since=factories.DAY + timedelta(days=1)),
        Selection(until=factories.DAY + timedelta(hours=1)),
    ):
        assert sum(selection.scene(scene.id, campaign) for scene in scenes) == 1

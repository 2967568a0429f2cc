"""What a plan runs, what it leaves out, and that it says why."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import factories
import pytest

from lidarops.plans import plan
from lidarops.records import Plan, Role, Scene
from lidarops.scenes import cut


def _scene(*granules: object) -> Scene:
    members = granules or (factories.granule(0),)
    return cut(factories.campaign(), members).scenes[0]  # type: ignore[arg-type]


def _steps(result: Plan, channel: str) -> dict[str, dict[str, object]]:
    return {step.name: dict(step.settings) for step in result.steps if step.channel == channel}


def _left_out(result: Plan, channel: str) -> dict[str, str]:
    return {left.name: left.reason for left in result.left_out if left.channel == channel}


def test_photon_channel() -> None:
    result = plan(_scene(), factories.campaign())
    steps = _steps(result, "photon_532o")
    assert list(steps) == ["read", "overlap", "dead_time", "noise", "homogeneous"]
    assert steps["dead_time"] == {"dead_time": 4e-9}
    assert steps["homogeneous"]["sections"] == [[750.0, 4500.0]]
    assert "photon background" in _left_out(result, "photon_532o")["dark"]


def test_a_channel_that_nobody_wants_is_not_read() -> None:
    result = plan(_scene(), factories.campaign())
    assert not _steps(result, "analog_532o")
    assert "no product" in _left_out(result, "analog_532o")["read"]


@pytest.mark.parametrize("with_dark", [True, False])
def test_dark_only_where_there_are_dark_files(*, with_dark: bool) -> None:
    campaign = factories.campaign(products={"signal": {"channels": ["analog_532o"]}})
    granules = [factories.granule(0)]
    if with_dark:
        granules.append(factories.granule(-30, path="dark/d", role=Role.DARK))
    result = plan(_scene(*granules), campaign)
    assert ("dark" in _steps(result, "analog_532o")) is with_dark
    assert ("dark" in _left_out(result, "analog_532o")) is not with_dark


def test_unknown_dead_time_is_said() -> None:
    result = plan(_scene(), factories.campaign(facts=[{}]))
    assert "dead_time" in _left_out(result, "photon_532o")["dead_time"]
    assert "full_overlap_range" in _left_out(result, "photon_532o")["overlap"]


def test_a_channel_that_the_files_lack_is_named() -> None:
    wanted = {"homogeneous": {"channels": ["photon_999x"], "sections": [[500, 900]]}}
    reason = _left_out(plan(_scene(), factories.campaign(products=wanted)), "photon_999x")
    assert "photon_532o" in reason["homogeneous"]


@pytest.mark.parametrize("section", [[14_000, 16_000], [1000, 1030]])
def test_a_section_outside_the_bins_is_left_out(section: list[float]) -> None:
    wanted = {"homogeneous": {"channels": ["photon_532o"], "sections": [section, [750, 4500]]}}
    result = plan(_scene(), factories.campaign(products=wanted))
    assert f"{section[0]}-{section[1]}" in _left_out(result, "photon_532o")["homogeneous"]
    assert _steps(result, "photon_532o")["homogeneous"]["sections"] == [[750.0, 4500.0]]


def test_an_implausible_wavelength_needs_the_campaign() -> None:
    odd = tuple(replace(channel, wavelength=math.nan) for channel in factories.granule().layout)
    scene = _scene(factories.granule(0, layout=odd))
    assert "wavelength" in _left_out(plan(scene, factories.campaign()), "photon_532o")["read"]
    told = factories.campaign(facts=[{"channels": {"photon_532o": {"wavelength": 532e-9}}}])
    assert _steps(plan(scene, told), "photon_532o")["read"]["wavelength"] == 532e-9


def test_the_hash_follows_every_setting() -> None:
    base = plan(_scene(), factories.campaign())
    assert plan(_scene(), factories.campaign()).hash == base.hash
    other = factories.campaign(facts=[{"channels": {"photon_532o": {"dead_time": 5e-9}}}])
    assert plan(_scene(), other).hash != base.hash
    assert json.loads(json.dumps(base.as_dict()))["scene"] == base.scene


@pytest.mark.parametrize("background", [[14_990, 16_000], [20_000, 30_000], [100, 101]])
def test_a_background_without_bins_leaves_the_signal_out(background: list[float]) -> None:
    wanted = {"signal": {"channels": ["photon_532o"], "background_range": background}}
    result = plan(_scene(), factories.campaign(products=wanted))
    assert "background_range" in _left_out(result, "photon_532o")["signal"]
    assert "signal" not in _steps(result, "photon_532o")

"""Channels that files lack: typing errors, and channels that came or went with the lidar."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from support import factories

from lidarops.catalog.raw_files import row_of
from lidarops.catalog.store import Store
from lidarops.records import Granule, Role, Unmet
from lidarops.run.day_states import validity_edges
from lidarops.run.findings import unavailable_channels
from lidarops.run.options import Selection

DAY = 1440
OLD = factories.PHOTON
NEW = replace(OLD, name="photon_607o", wavelength=607e-9)
EDGE = "2026-03-02T00:00:00Z"
BEFORE, AFTER = {"valid_to": EDGE}, {"valid_from": EDGE}


def unavailable(
    facts: list[dict[str, Any]],
    *granules: Granule,
    products: dict[str, Any] | None = None,
    folder: Path,
    **selection: Any,
) -> list[Unmet]:
    campaign = factories.campaign(facts=facts, products=products or {"signal": {}})
    with Store(f"sqlite:///{folder}/catalog.sqlite", campaign.name) as store:
        store.replace([row_of(granule, campaign.name, "key") for granule in granules])
        holdings = store.holdings(validity_edges(campaign))
        instruments = selection.pop("instruments", campaign.instruments)
        chosen = Selection(**selection)
        return list(unavailable_channels(campaign, holdings, instruments, chosen))


def file_of(day: int, *layout: Any, minutes: float = 0.0, role: Role = Role.SIGNAL) -> Granule:
    name = f"coast/h{day}{minutes:g}{role}"
    return factories.granule(day * DAY + minutes, path=name, role=role, layout=layout)


def dead_times_of(*channels: str) -> dict[str, Any]:
    return {"channels": {name: {"dead_time": 4e-9} for name in channels}}


def test_a_name_that_no_file_has_is_reported_with_counts(tmp_path: Path) -> None:
    products = {"homogeneous": {"channels": ["photon_999o"], "sections": [[750, 900]]}}
    files = [file_of(0, OLD), file_of(1, OLD), file_of(1, NEW, role=Role.DARK)]
    facts = [dead_times_of("photon_533o", "photon_532o")]
    by_channel = {
        channel.channel: channel
        for channel in unavailable(facts, *files, products=products, folder=tmp_path)
    }
    assert by_channel.keys() == {"photon_999o", "photon_533o"}
    assert by_channel["photon_999o"].requested_by == "homogeneous"
    assert by_channel["photon_533o"].requested_by == "facts"
    for channel in by_channel.values():
        assert (channel.nowhere, channel.files, channel.files_expected) == (True, 2, 2)
        assert "photon_532o" in channel.reason


def test_a_channel_of_a_new_detector_is_not_a_typing_error(tmp_path: Path) -> None:
    products = {"signal": {"channels": ["photon_607o", "photon_607o"]}}
    files = [file_of(0, OLD), file_of(1, OLD), file_of(2, OLD, NEW)]
    missing = unavailable(
        [dead_times_of("photon_607o")], *files, products=products, folder=tmp_path
    )
    assert {
        (channel.requested_by, channel.nowhere, channel.files, channel.files_expected)
        for channel in missing
    } == {
        ("signal", False, 2, 3),
        ("facts", False, 2, 3),
    }


def test_facts_are_compared_with_the_files_of_their_period(tmp_path: Path) -> None:
    # At the edge itself the later facts hold.
    files = [file_of(0, OLD), file_of(1, NEW, minutes=0.0), file_of(2, NEW)]
    right = [{**BEFORE, **dead_times_of("photon_532o")}, {**AFTER, **dead_times_of("photon_607o")}]
    assert unavailable(right, *files, folder=tmp_path) == []
    wrong = [{**BEFORE, **dead_times_of("photon_532o")}, {**AFTER, **dead_times_of("photon_532o")}]
    (channel,) = unavailable(wrong, *files, folder=tmp_path)
    assert (channel.requested_by, channel.files, channel.files_expected) == (
        "facts from 2026-03-02T00:00:00Z",
        2,
        2,
    )
    # Reported, but no failure: facts of two periods may name the same channels.
    assert channel.files_with_channel == 1
    assert not channel.nowhere
    slip = [{**BEFORE, **dead_times_of("photon_532o")}, {**AFTER, **dead_times_of("photon_606o")}]
    (channel,) = unavailable(slip, *files, folder=tmp_path)
    assert channel.nowhere


def test_facts_of_a_time_without_files_are_not_reported(tmp_path: Path) -> None:
    facts = [{**BEFORE, **dead_times_of("photon_532o")}, {**AFTER, **dead_times_of("photon_533o")}]
    assert unavailable(facts, file_of(0, OLD), folder=tmp_path) == []


@pytest.mark.parametrize(
    ("selection", "channels"),
    [
        ({}, {"photon_533o", "photon_999o"}),
        ({"since": datetime(2026, 3, 2, tzinfo=UTC)}, {"photon_999o"}),
        ({"until": datetime(2026, 3, 2, tzinfo=UTC)}, {"photon_533o", "photon_999o"}),
        ({"kinds": ("signal",)}, {"photon_533o", "photon_999o"}),
        ({"kinds": ("elastic",)}, {"photon_533o"}),
        ({"instruments": {"another"}}, set()),
    ],
)
def test_the_selection_restricts_the_result(
    selection: dict[str, Any], channels: set[str], tmp_path: Path
) -> None:
    products = {"signal": {"channels": ["photon_999o"]}}
    facts = [{**BEFORE, **dead_times_of("photon_533o")}, {**AFTER, **dead_times_of("photon_532o")}]
    files = [file_of(0, OLD), file_of(1, OLD)]
    missing = unavailable(facts, *files, products=products, folder=tmp_path, **selection)
    assert {channel.channel for channel in missing} == channels

"""Simulated archives: deterministic, readable, and consistent with their truth."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from support.archives.small_campaign import FAST, SLOW

from lidarops.errors import CampaignError
from lidarops.raw import licel
from lidarops.records import Role
from lidarops.simulate.campaign import simulate_campaign
from lidarops.simulate.planned_files import random_stream


def _contents(root):
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(Path(root).rglob("*"))
        if path.is_file()
    }


def _signals(root, path):
    """Return header and physical values by channel."""
    content = (Path(root) / path).read_bytes()
    header = licel.parse_header(content, file=path)
    values = {
        d.name: np.frombuffer(content, "<i4", d.bins, d.offset) * d.scale for d in header.channels
    }
    return header, values


def _simulated(tree):
    return tree["simulation"]["instruments"]


def test_the_same_seed_gives_the_same_bytes(small):
    one, two = small(archive="one"), small(archive="two")
    first, second = simulate_campaign(one), simulate_campaign(two)
    assert _contents(first.archive) == _contents(second.archive)
    assert first.paths == second.paths
    assert first.truth.identical(second.truth)
    reseeded = simulate_campaign(small(lambda t: t["simulation"].update(seed=8), archive="three"))
    changed, before = _contents(reseeded.archive), _contents(first.archive)
    assert changed.keys() == before.keys()
    assert all(changed[name] != before[name] for name in changed)


def test_a_file_does_not_depend_on_the_others(small):
    whole = _contents(simulate_campaign(small(archive="whole")).archive)

    def shorter(tree):
        tree["simulation"]["duration"] = 600
        del _simulated(tree)["hill-lidar"]
        _simulated(tree)["coast-lidar"]["damage"] = [{"kind": "garbage", "index": 3}]

    shortened = _contents(simulate_campaign(small(shorter, archive="part")).archive)
    different = {name for name in shortened if shortened[name] != whole.get(name)}
    # The damaged file, and the dark file after the end, which is now earlier.
    assert different == {"coast/h24C3123.540000", "coast/dark/d2510100.010000"}


def test_streams_of_different_files_differ():
    draws = {
        tuple(random_stream(seed, key, role, index).integers(0, 2**63, 2))
        for seed in (1, 2)
        for key in ("a", "b")
        for role in (Role.SIGNAL, Role.DARK)
        for index in range(3)
    }
    assert len(draws) == 2 * 2 * 2 * 3


def test_simulating_again_changes_nothing(small):
    campaign = small()
    before = _contents(simulate_campaign(campaign).archive)
    assert _contents(simulate_campaign(campaign).archive) == before


def test_names_and_headers_follow_licel(small):
    result = simulate_campaign(small())
    assert sorted(_contents(result.archive)) == sorted(result.paths)
    assert len(result.paths) == 3 + 20 + 4
    name = re.compile(r"[a-z]\d\d[1-9A-C]\d\d\d\d\.\d{6}")
    for path in result.paths:
        header, values = _signals(result.archive, path)
        leaf = path.rpartition("/")[2]
        assert name.fullmatch(leaf)
        assert header.name == leaf
        stop = header.stop
        assert leaf[1:] == f"{stop:%y}{stop.month:X}{stop:%d%H.%M%S}00"
        assert stop - header.start == timedelta(seconds=60)
        coast = path.startswith("coast")
        assert header.zenith_angle == (90 if coast else 0)
        assert header.azimuth == (315 if coast else None)
        assert header.position() == ((54.4, 10.2) if coast else (47.8, 11.0))
        assert header.lasers[0] == licel.Laser(600, 10)
        channels = ["analog_532o", "photon_532o"] if coast else ["analog_1064o", "photon_532o"]
        assert list(values) == channels
    assert "coast/h24C3123.510000" in result.paths  # the month is hexadecimal


def test_the_schema_of_the_truth(small):
    truth = simulate_campaign(small()).truth
    profiles = {"profile_hill_lidar": 4, "wavelength_hill_lidar": 2, "range_hill_lidar": 200}
    assert dict(truth.sizes) == {"granule": 24} | profiles
    assert list(truth["path"].values[:1]) == ["coast/h24C3123.510000"]
    assert set(truth["instrument"].values) == {"coast-lidar", "hill-lidar"}
    assert truth["time"].values[0] == np.datetime64("2024-12-31T23:50:30")
    coast = truth["instrument"].values == "coast-lidar"
    assert np.all(np.isfinite(truth["total_extinction"].values) == coast)
    np.testing.assert_array_equal(truth["homogeneous"].values, coast.astype(int))
    for quantity in ("background", "amplitude"):
        assert truth[f"{quantity}_photon_532o"].attrs["units"].startswith("MHz")
        assert truth[f"{quantity}_analog_532o"].attrs["units"].startswith("mV")
    assert np.all(np.isfinite(truth["background_photon_532o"].values))
    assert np.all(np.isnan(truth["background_analog_532o"].values) == ~coast)
    assert np.all(np.isnan(truth["amplitude_photon_532o"].values) == ~coast)
    np.testing.assert_allclose(truth["background_analog_532o"].values[coast], 2.0 * 0.05)
    assert np.all(truth["dark_offset_analog_532o"].values[coast] == 3.0)
    assert "dark_offset_photon_532o" not in truth
    assert not truth["refused"].values.any()
    assert all("long_name" in variable.attrs for variable in truth.variables.values())


def _expected(truth, index, channel, distance):
    """Return P* + B R^-2 exp(-2 sigma R) with the values of the truth."""
    sigma = float(truth["total_extinction"][index])
    background = float(truth[f"background_{channel}"][index])
    amplitude = float(truth[f"amplitude_{channel}"][index])
    return background + amplitude * distance**-2.0 * np.exp(-2 * sigma * distance)


def test_files_agree_with_the_truth_within_their_noise(small):
    result = simulate_campaign(small())
    truth = result.truth
    distance = (np.arange(600) + 0.5) * 7.5
    beyond = distance >= 300
    exposure = 600 * 0.05
    scores = {"photon": [], "analog": []}
    wrong = []
    for index in np.flatnonzero(truth["instrument"].values == "coast-lidar"):
        header, values = _signals(result.archive, str(truth["path"].values[index]))
        early = header.start < datetime(2024, 12, 31, 23, 58, tzinfo=UTC)
        for tau, pile in ((SLOW if early else FAST, scores["photon"]), (SLOW, wrong)):
            rate = _expected(truth, index, "photon_532o", distance)[beyond]
            load = rate * 1e6 * tau
            counts = rate / (1 + load)
            deviation = np.sqrt(rate / exposure / (1 + load) ** 3)
            pile.append((values["photon_532o"][beyond] - counts) / deviation)
        rate = _expected(truth, index, "photon_532o", distance)[beyond]
        voltage = _expected(truth, index, "analog_532o", distance)[beyond] + 3.0
        variance = 1.2 * 0.05**2 * rate / exposure + (0.2**2 + (100 / 4096) ** 2 / 12) / 600
        scores["analog"].append((values["analog_532o"][beyond] - voltage) / np.sqrt(variance))
    for name, score in scores.items():
        z = np.array(score)
        assert z.shape == (20, beyond.sum()), name
        assert abs(z.mean()) < 4 / np.sqrt(z.size), name
        assert z.std() == pytest.approx(1.0, abs=0.03), name
        # The same for every bin.
        assert np.abs(z.mean(axis=0) * np.sqrt(20)).max() < 5, name
        assert (z.mean(axis=0) ** 2).mean() * 20 == pytest.approx(1.0, abs=0.25), name
    # The dead time of the other period does not explain the later files.
    assert np.abs(np.array(wrong)[8:, :20].mean()) > 10


def test_dark_files_hold_offset_and_noise_only(small):
    result = simulate_campaign(small())
    dark = [path for path in result.paths if "/dark/" in path]
    assert len(dark) == 3
    for path in dark:
        _, values = _signals(result.archive, path)
        assert not values["photon_532o"].any()
        expected = np.sqrt((0.2**2 + (100 / 4096) ** 2 / 12) / 600)
        assert values["analog_532o"].mean() == pytest.approx(3.0, abs=4 * expected / np.sqrt(600))
        assert values["analog_532o"].std() == pytest.approx(expected, rel=0.15)


def test_a_trigger_delay_of_the_facts_shifts_a_channel(small):
    def delayed(tree):
        for facts in tree["instruments"]["coast-lidar"]["facts"]:
            facts["channels"]["analog_532o"] = {"range_offset": -75.0}

    plain, moved = (
        simulate_campaign(small(archive="plain")),
        simulate_campaign(small(delayed, archive="moved")),
    )
    path = plain.truth["path"].values[0]
    _, before = _signals(plain.archive, path)
    _, after = _signals(moved.archive, path)
    # Ten bins later, with sky background only before the pulse leaves.
    rate = _expected(plain.truth, 0, "photon_532o", (np.arange(600) + 0.5) * 7.5)[50:-10]
    noise = np.sqrt(0.2**2 / 600 + 1.2 * 0.05**2 * rate / 30)
    score = (after["analog_532o"][60:] - before["analog_532o"][50:-10]) / noise / np.sqrt(2)
    assert score.std() == pytest.approx(1, abs=0.1)
    assert abs(score.mean()) < 4 / np.sqrt(score.size)
    assert after["analog_532o"][:10].mean() == pytest.approx(3.1, abs=0.05)
    # The photon counter has no delay, so it stays where it was.
    late = after["photon_532o"][60:120].mean() / before["photon_532o"][60:120].mean()
    assert late == pytest.approx(1, abs=0.02)


def test_a_blinding_signal_saturates_but_does_not_crash(small):
    def blind(tree):
        coast = _simulated(tree)["coast-lidar"]
        coast["acquisition"]["bin_width"] = 0.5
        coast["detectors"][0]["signal_rate"] = 1e5
        extinction = {"minimum": 0.5, "maximum": 0.5}
        coast["atmosphere"] = {"homogeneous": {"extinction": extinction}}
        for facts in tree["instruments"]["coast-lidar"]["facts"]:
            facts["full_overlap_range"] = 0

    result = simulate_campaign(small(blind))
    header, values = _signals(result.archive, str(result.truth["path"].values[0]))
    analog = header.channels[0]
    assert values["analog_532o"][0] == pytest.approx(analog.full_scale * analog.scale)
    assert values["photon_532o"][0] == pytest.approx(1e-6 / SLOW, rel=0.02)


def test_progress_counts_every_file(small):
    steps = []
    result = simulate_campaign(small(), progress=steps.append)
    assert sum(steps) == len(result.paths)


def test_foreign_files_in_the_archive_are_refused(small):
    campaign = small()
    foreign = Path(campaign.archive) / "coast" / "h24C3122.000000"
    foreign.parent.mkdir(parents=True)
    foreign.write_bytes(b"a real measurement")
    (foreign.parent / "readme").write_text("not matched by any pattern")
    with pytest.raises(CampaignError, match="h24C3122"):
        simulate_campaign(campaign)
    assert _contents(campaign.archive).keys() == {"coast/h24C3122.000000", "coast/readme"}
    foreign.unlink()
    assert simulate_campaign(campaign).paths


def _drop_dead_time(tree):
    tree["instruments"]["coast-lidar"]["facts"][1]["channels"] = {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("simulation"), "has no simulation"),
        (
            lambda t: _simulated(t).update({"sea-lidar": _simulated(t).pop("hill-lidar")}),
            "sea-lidar",
        ),
        (lambda t: t["instruments"]["hill-lidar"].update(files="**/v*"), "where to write"),
        (lambda t: t["instruments"]["hill-lidar"].update(files=["a/v*", "b/v*"]), "where to write"),
        (lambda t: t["instruments"]["coast-lidar"].update(dark_files=[]), "dark_files"),
        (lambda t: t["instruments"]["hill-lidar"].update(files="coast/ha*"), "would be taken"),
        (_drop_dead_time, "dead time"),
        (lambda t: t.update(archive="s3://bucket/raw"), "local folder"),
    ],
)
def test_a_simulation_that_contradicts_the_campaign_is_refused_before_it_writes(
    small, change, message
):
    campaign = small(change)
    with pytest.raises(CampaignError, match=message):
        simulate_campaign(campaign)
    assert not Path(campaign.archive).exists()

"""Damage of every kind: the changed bytes, and the handling by the processing."""

from __future__ import annotations

from collections import Counter
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from lidarops.campaign.simulated_instrument import DamageKind, Handling
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError, RawFormatError
from lidarops.flags import Quality
from lidarops.raw import licel
from lidarops.records import Role, Status
from lidarops.run.archive import reprocess
from lidarops.run.scenes import cut_scenes
from lidarops.simulate.campaign import simulate_campaign

# A stale pointing needs a scan, see `test_scans_of_raymetrics.py`.
KINDS = [kind for kind in DamageKind if kind is not DamageKind.STALE_POINTING]
ALL_DAMAGE = [{"kind": kind.value, "index": 2 * i} for i, kind in enumerate(KINDS)]


def _coast(tree):
    return tree["simulation"]["instruments"]["coast-lidar"]


def _all_kinds(tree):
    tree["simulation"]["duration"] = 60 * 2 * len(KINDS)
    _coast(tree)["damage"] = ALL_DAMAGE
    del tree["simulation"]["instruments"]["hill-lidar"]


def _without_damage(tree):
    _all_kinds(tree)
    _coast(tree)["damage"] = []


@pytest.fixture
def damaged(small):
    campaign = small(_all_kinds, archive="damaged")
    return campaign, simulate_campaign(campaign)


def _granules(campaign):
    store = Store(campaign.catalog_url, campaign.name)
    scan_archive(campaign, store)
    granules = store.granules()
    store.close()
    return granules


def test_the_catalog_refuses_exactly_the_unreadable_files(damaged):
    campaign, result = damaged
    truth = result.truth
    refused = dict(zip(truth["path"].values, truth["refused"].values, strict=True))
    assert sum(refused.values()) == 8
    granules = {g.path: g for g in _granules(campaign) if g.role is Role.SIGNAL}
    assert granules.keys() == refused.keys()
    for path, granule in granules.items():
        assert (granule.status is Status.REFUSED) == bool(refused[path]), (path, granule.reason)
        assert bool(granule.reason) == bool(refused[path])


def test_the_copy_of_a_file_is_set_aside(damaged):
    campaign, result = damaged
    aside = cut_scenes(campaign, _granules(campaign)).set_aside
    truth = result.truth
    expected = truth["path"].values[truth["handling"].values == Handling.SET_ASIDE]
    assert [granule.path for granule in aside] == list(expected)
    assert [path.endswith(".copy") for path in expected] == [True]
    original = result.archive / expected[0].removesuffix(".copy")
    assert original.read_bytes() == (result.archive / expected[0]).read_bytes()


def test_the_retrieval_flags_exactly_the_damaged_profiles(small):
    def retrieved(tree):
        _all_kinds(tree)
        # Weak enough that no good file comes near the limits of the photon counter.
        _coast(tree)["detectors"][0]["signal_rate"] = 0.5
        tree["instruments"]["coast-lidar"]["products"] = {
            "homogeneous": {
                "channels": ["photon_532o", "analog_532o"],
                "sections": [[300, 2000]],
            }
        }

    campaign = small(retrieved)
    truth = simulate_campaign(campaign).truth
    record = reprocess(campaign)
    assert not any(scene.error for scene in record.scenes)
    flags = {}
    for scene in record.scenes:
        for product in scene.products:
            with xr.open_dataset(Path(record.products) / product.path) as dataset:
                for time, flag in zip(
                    dataset["time"].values, dataset["quality_flag"].values, strict=True
                ):
                    flags[time, product.channel] = Quality(int(flag.squeeze()))
    raised = {
        DamageKind.GLITCH: {"analog_532o": Quality.SATURATED},
        DamageKind.SATURATION: {"analog_532o": Quality.SATURATED},
        DamageKind.DEAD_PHOTON: {"photon_532o": Quality.INPUT_MISSING},
        DamageKind.ZERO_SHOTS: dict.fromkeys(("photon_532o", "analog_532o"), Quality.INPUT_MISSING),
        DamageKind.LARGEST_INTEGER: {
            "analog_532o": Quality.SATURATED,
            "photon_532o": Quality.SATURATED,
        },
    }
    assert {kind for kind in KINDS if kind.handling is Handling.FLAG} == raised.keys()
    alarms = Quality.SATURATED | Quality.NO_SIGNAL | Quality.INPUT_MISSING
    used = 0
    for index, kind in enumerate(truth["damage"].values):
        expected = raised.get(DamageKind(kind), {}) if kind else {}
        for channel in ("photon_532o", "analog_532o"):
            flag = flags.get((truth["time"].values[index], channel))
            if kind and DamageKind(kind).handling is Handling.REFUSE:
                assert flag is None, kind
                continue
            used += 1
            required = expected.get(channel, Quality(0))
            assert flag & alarms & required == required, (kind, channel, flag)
            assert required or not flag & alarms, (kind, channel, flag)
    assert used == 2 * (2 * len(KINDS) + 1 - 8)


def test_random_damage_is_refused_too(small):
    def chance(tree):
        tree["simulation"]["duration"] = 60 * 120
        _coast(tree)["acquisition"]["bins"] = 64
        _coast(tree)["random_damage"] = {"fraction": 0.3, "kinds": [kind.value for kind in KINDS]}
        del tree["simulation"]["instruments"]["hill-lidar"]

    campaign = small(chance)
    truth = simulate_campaign(campaign).truth
    kinds = Counter(truth["damage"].values)
    assert 15 < 120 - kinds[""] < 60
    assert len(kinds) > 10
    refused = {g.path for g in _granules(campaign) if g.status is Status.REFUSED}
    assert refused == set(truth["path"].values[truth["refused"].values == 1])


def test_each_kind_of_damage_changes_the_stated_bytes(small, damaged):
    clean = simulate_campaign(small(_without_damage, archive="clean"))
    _, result = damaged
    paths = [path for path in result.truth["path"].values if not path.endswith(".copy")]
    for number, kind in enumerate(KINDS):
        good = (clean.archive / str(clean.truth["path"].values[2 * number])).read_bytes()
        path = paths[2 * number]
        bad = (result.archive / path).read_bytes()
        _CHECKS[kind](good, bad, path)
        untouched = paths[2 * number + 1]
        assert (result.archive / untouched).read_bytes() == (clean.archive / untouched).read_bytes()


def _body(content):
    return content.partition(b"\r\n\r\n")[2]


def _read(content):
    header = licel.parse_header(content)
    return header, {
        d.name: np.frombuffer(content, "<i4", d.bins, d.offset) for d in header.channels
    }


def _changed(good, bad):
    """Return the number of differing bins of each channel; the headers must be equal."""
    assert good.partition(b"\r\n\r\n")[0] == bad.partition(b"\r\n\r\n")[0]
    before, after = _read(good)[1], _read(bad)[1]
    return {name: int((before[name] != after[name]).sum()) for name in before}


def _same_counts(good, bad):
    assert _body(good) == _body(bad)
    assert good != bad
    return _read(bad)[0]


def _truncated(good, bad, _):
    assert good.startswith(bad)
    assert 500 < len(bad) < len(good) - 1000


def _surplus(good, bad, _):
    assert bad.startswith(good)
    assert len(bad) == len(good) + 1000


def _foreign(_, bad, path):
    assert path.endswith("log.txt")
    assert bad.isascii()


def _garbage(good, bad, _):
    assert len(bad) == len(good)
    assert b"coast" not in bad[:500]


def _negative_bins(good, bad, _):
    assert bad == good.replace(b" 00600 ", b" -0005 ", 1)


def _too_many_bins(good, bad, _):
    assert bad == good.replace(b" 00600 ", b" 01200 ", 1)


def _impossible_position(good, bad, _):
    assert _body(bad) == _body(good)
    assert b" 0987.6 0765.4 90.0" in bad


def _long_site(good, bad, _):
    assert _same_counts(good, bad).site == "Demonstration site"


def _blank_site(good, bad, _):
    assert _same_counts(good, bad).site == ""


def _zenith_minus_90(good, bad, _):
    header = _same_counts(good, bad)
    assert header.zenith_as_written == -90
    assert "vertical" in header.notes[0]


def _wide_line(good, bad, _):
    header = _same_counts(good, bad)
    assert header.pressure == pytest.approx(101300)
    assert header.temperature == pytest.approx(303.15)
    assert len(bad.split(b"\r\n")[1]) > 80


def _decimal_comma(good, bad, _):
    header = _same_counts(good, bad)
    before = licel.parse_header(good)
    assert b"532.o" in bad
    assert b" 7,50 " in bad
    assert header.position() == before.position()
    assert [d.scale for d in header.channels] == [d.scale for d in before.channels]


def _zero_shots(good, bad, _):
    header, counts = _read(bad)
    assert len(bad) == len(good)
    assert [d.shots for d in header.channels] == [0, 0]
    assert not any(values.any() for values in counts.values())
    assert all("no shots" in note for note in header.notes)


def _zero_voltage(good, bad, _):
    assert {d.high_voltage for d in _same_counts(good, bad).channels} == {0}


def _glitch(good, bad, _):
    assert _changed(good, bad) == {"analog_532o": 1, "photon_532o": 0}
    header, counts = _read(bad)
    assert counts["analog_532o"].max() == 3 * header.channels[0].full_scale


def _largest_integer(good, bad, _):
    assert _changed(good, bad) == {"analog_532o": 1, "photon_532o": 1}
    assert all(values.max() == 2**31 - 1 for values in _read(bad)[1].values())


def _dead_photon(good, bad, _):
    assert _changed(good, bad)["analog_532o"] == 0
    assert not _read(bad)[1]["photon_532o"].any()


def _saturation(good, bad, _):
    assert _changed(good, bad) == {"analog_532o": 150, "photon_532o": 0}


def _renamed(good, bad, path):
    assert bad == good
    leaf = path.rpartition("/")[2]
    assert leaf != licel.parse_header(bad).name
    assert leaf.endswith(licel.parse_header(bad).name)


def _is(expected):
    def check(good, bad, _):
        assert bad == expected(good)

    return check


def _stop_before_start(good, bad, _):
    start = licel.parse_header(good).start
    written = [f"{start - timedelta(seconds=early):%d/%m/%Y %H:%M:%S}".encode() for early in (0, 1)]
    assert b" ".join(written) in bad
    assert licel.parse_header(bad).start == start
    assert licel.parse_header(bad).stop > start


_CHECKS = {
    DamageKind.TRUNCATED: _truncated,
    DamageKind.EMPTY: _is(lambda _: b""),
    DamageKind.GARBAGE: _garbage,
    DamageKind.NEGATIVE_BINS: _negative_bins,
    DamageKind.TOO_MANY_BINS: _too_many_bins,
    DamageKind.IMPOSSIBLE_POSITION: _impossible_position,
    DamageKind.FOREIGN: _foreign,
    DamageKind.SURPLUS: _surplus,
    DamageKind.NO_FINAL_NEWLINE: _is(lambda good: good[:-2]),
    DamageKind.GLITCH: _glitch,
    DamageKind.DEAD_PHOTON: _dead_photon,
    DamageKind.LONG_SITE: _long_site,
    DamageKind.BLANK_SITE: _blank_site,
    DamageKind.ZENITH_MINUS_90: _zenith_minus_90,
    DamageKind.WIDE_LINE: _wide_line,
    DamageKind.DECIMAL_COMMA: _decimal_comma,
    DamageKind.SATURATION: _saturation,
    DamageKind.ZERO_SHOTS: _zero_shots,
    DamageKind.RENAMED: _renamed,
    DamageKind.ZERO_VOLTAGE: _zero_voltage,
    DamageKind.LARGEST_INTEGER: _largest_integer,
    DamageKind.DUPLICATE: _is(lambda good: good),
    DamageKind.STOP_BEFORE_START: _stop_before_start,
}


def test_a_vertical_sign_on_a_level_path_is_refused(small):
    def level(tree):
        _coast(tree)["damage"] = [{"kind": "zenith_minus_90", "index": 1}]
        _coast(tree)["scan"] = {"zenith_angles": [80, 90]}
        for facts in tree["instruments"]["coast-lidar"]["facts"]:
            del facts["zenith_angle"]

    with pytest.raises(CampaignError, match="is not vertical"):
        simulate_campaign(small(level))


def test_the_error_names_the_refused_file(damaged):
    _, result = damaged
    for path in result.truth["path"].values[result.truth["refused"].values == 1]:
        with pytest.raises(RawFormatError, match=Path(path).name):
            licel.read_header(result.archive / path).position()

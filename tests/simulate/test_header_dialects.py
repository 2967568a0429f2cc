"""Headers in the dialects of real stations, jumping clocks and changing acquisitions."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.raw import licel
from lidarops.raw.archive import open_archive
from lidarops.records import Status
from lidarops.run.scenes import cut_scenes
from lidarops.simulate.campaign import simulate_campaign

DIALECTS = ["licel", "manaus", "saopaulo", "pilar", "golmud"]


def _hill(tree):
    return tree["simulation"]["instruments"]["hill-lidar"]


def _speaking(dialect, **acquisition):
    def change(tree):
        _hill(tree)["acquisition"].update(dialect=dialect, **acquisition)
        if dialect == "golmud":
            _hill(tree)["acquisition"]["bin_width"] = 15
            _hill(tree)["detectors"][0]["bin_width"] = 30
            _hill(tree)["detectors"][0]["bins"] = 400
            _hill(tree)["detectors"][0]["analog"]["adc_bits"] = 14
        tree["stations"]["hill"]["name"] = "Sao Paulo"
        tree["stations"]["hill"]["latitude"] = -23.6
        tree["stations"]["hill"]["longitude"] = -46.7
        del tree["simulation"]["instruments"]["coast-lidar"]

    return change


def _headers(result):
    return [licel.read_header(result.archive / path) for path in result.paths]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_holds_the_same_values(small, dialect):
    result = simulate_campaign(small(_speaking(dialect)))
    headers = _headers(result)
    assert len(headers) == 4
    for number, header in enumerate(headers):
        start = datetime(2024, 12, 31, 23, 50, tzinfo=UTC) + number * timedelta(seconds=300)
        assert (header.start, header.stop) == (start, start + timedelta(seconds=60))
        assert header.position() == (-23.6, -46.7)
        assert header.altitude == 900
        assert header.zenith_angle == 0
        shots = {header.lasers[d.laser - 1].shots for d in header.channels}
        assert shots == {600} == {d.shots for d in header.channels}
        assert header.lasers[header.channels[0].laser - 1].repetition_rate == 10
        assert [d.name for d in header.channels] == ["analog_1064o", "photon_532o"]
        assert [d.bin_width for d in header.channels] == (
            [30, 15] if dialect == "golmud" else [7.5, 7.5]
        )


@pytest.mark.parametrize(
    ("dialect", "site", "zenith", "lasers", "dataset"),
    [
        # As in the files of these stations, except for the times.
        (
            "manaus",
            b"Sao Paulo",
            b"-90 00 30.0 1013.0",
            b" 0000600 0010 0000600 0010 02",
            b" 1 0 1 00800 1 0800 7.50 01064.o 0 0 00 000 12 000600 0.500 BT0",
        ),
        (
            "saopaulo",
            b"Sao Paul",
            b"00",
            b" 0000000 0010 0000600 0010 02",
            b" 1 0 2 00800 1 0800 7.50 01064.o 0 0 00 000 12 000600 0.500 BT0",
        ),
        (
            "pilar",
            b"Sao Paul",
            b"00",
            b" 0000600 0010 0000000 0000 02",
            b" 1 0 1 00800 1 0800 7.50 01064.o 0 0 00 000 12 000600 0.500 BT0",
        ),
        (
            "golmud",
            b"Sao Paulo",
            b"00",
            b" 0000600 0010 0000000 0000 02",
            b" 1 0 1 00400 1 0800 0030 01064.o 0 0 00 000 14 000600 0.500 BT0",
        ),
    ],
)
def test_header_lines_equal_those_of_the_station(small, dialect, site, zenith, lasers, dataset):
    result = simulate_campaign(small(_speaking(dialect)))
    lines = (result.archive / result.paths[0]).read_bytes().split(b"\r\n")
    times = b"31/12/2024 23:50:00 31/12/2024 23:51:00 0900 -046.7 -023.6"
    line = b" " + b" ".join([site, times, zenith])
    assert [text.rstrip() for text in lines[1:4]] == [line, lasers, dataset]
    # Padded to 78 characters, except for a longer line 2.
    assert [len(text) for text in lines[:5]] == [78, max(78, len(line)), 78, 78, 78]


def test_manaus_names_files_by_tens_of_seconds(small):
    result = simulate_campaign(small(_speaking("manaus")))
    assert result.paths[:2] == ("hill/v24C3123.510", "hill/v24C3123.560")
    with pytest.raises(CampaignError, match="two files"):
        simulate_campaign(small(_speaking("manaus", interval=4, shots=20), archive="often"))


def test_positions_may_be_swapped_or_without_signs(small):
    def turned(tree):
        tree["instruments"]["hill-lidar"]["header_position"] = "latitude_first"

    headers = _headers(simulate_campaign(small(_speaking("pilar"), turned, archive="turned")))
    assert headers[0].position("latitude_first") == (-23.6, -46.7)
    assert headers[0].position() == (-46.7, -23.6)
    unsigned = _headers(
        simulate_campaign(small(_speaking("pilar", signs_lost=True), archive="unsigned"))
    )
    assert unsigned[0].position() == (23.6, 46.7)


def test_bins_and_shots_may_change_within_a_day(small):
    changes = [
        {"at": "2024-12-31T23:55:00Z", "shots": 300, "bins": 400},
        {"at": "2025-01-01T00:00:00Z", "bin_width": 15},
    ]
    campaign = small(_speaking("pilar", changes=changes))
    headers = _headers(simulate_campaign(campaign))
    acquisitions = [
        (h.channels[0].shots, h.channels[0].bins, h.channels[0].bin_width, (h.stop - h.start))
        for h in headers
    ]
    minute, half = timedelta(seconds=60), timedelta(seconds=30)
    assert acquisitions == [
        (600, 800, 7.5, minute),
        (300, 400, 7.5, half),
        (300, 400, 15, half),
        (300, 400, 15, half),
    ]
    store = Store(campaign.catalog_url, campaign.name)
    scan_archive(campaign, store)
    scenes = cut_scenes(campaign, store.granules()).scenes
    store.close()
    # A scene has one layout and one day.
    assert sorted(len(scene.granules) for scene in scenes) == [1, 1, 2]


def test_a_gap_changes_no_other_file(small):
    def coast(tree):
        del tree["simulation"]["instruments"]["hill-lidar"]

    def gap(tree):
        coast(tree)
        tree["simulation"]["instruments"]["coast-lidar"]["acquisition"]["gaps"] = [
            {"start": "2024-12-31T23:53:30Z", "stop": "2024-12-31T23:57:00Z"}
        ]

    whole, gapped = (
        simulate_campaign(small(coast, archive="whole")),
        simulate_campaign(small(gap, archive="gapped")),
    )
    missing = set(whole.paths) - set(gapped.paths)
    # Files that start at minutes 53 to 56; names hold the stop time.
    assert missing == {f"coast/h24C3123.{minute}0000" for minute in (54, 55, 56, 57)}
    assert gapped.truth.sizes["granule"] == 16
    for path in gapped.paths:
        assert (gapped.archive / path).read_bytes() == (whole.archive / path).read_bytes()


def test_a_clock_that_jumps_back_loses_no_file(small):
    def summer_time(tree):
        tree["simulation"]["duration"] = 7200
        del tree["simulation"]["instruments"]["hill-lidar"]
        tree["simulation"]["instruments"]["coast-lidar"]["acquisition"]["clock"] = [
            {"at": "2025-01-01T00:50:00Z", "offset": -3600}
        ]

    campaign = small(summer_time)
    result = simulate_campaign(campaign)
    assert len(set(result.paths)) == 123
    headers = [
        licel.read_header(result.archive / str(path)) for path in result.truth["path"].values
    ]
    error = result.truth["clock_error"].values
    assert set(error) == {0.0, -3600.0}
    for header, middle, off in zip(headers, result.truth["time"].values, error, strict=True):
        true = header.start.replace(tzinfo=None) + timedelta(seconds=30 - off)
        assert np.datetime64(true) == middle
    # The hour that occurs twice on the clock is used once.
    store = Store(campaign.catalog_url, campaign.name)
    scan_archive(campaign, store)
    granules = store.granules()
    store.close()
    assert all(granule.status is Status.GOOD for granule in granules)
    assert len(cut_scenes(campaign, granules).set_aside) == 60


def test_a_year_may_end_within_an_archive(small):
    result = simulate_campaign(small())
    coast = [path for path in result.paths if path.startswith("coast/h")]
    assert coast[0].startswith("coast/h24C31")
    assert coast[-1].startswith("coast/h25101")
    opened = open_archive(result.archive / "coast", channels=["photon_532o"])
    steps = np.diff(opened["time"].values[1:-1])
    assert set(steps[1:]) == {np.timedelta64(60, "s")}
    assert opened["time"].values.min() < np.datetime64("2025-01-01") < opened["time"].values.max()


def test_line_ends_inside_the_data_are_data(small):
    def bright(tree):
        # About 2573 counts a bin, which are 0x0A0D.
        tree["simulation"]["instruments"]["hill-lidar"]["detectors"][1]["background"] = {
            "night": 129,
            "day": 129,
        }

    result = simulate_campaign(small(bright))
    held = 0
    for path in result.paths:
        header = licel.read_header(result.archive / path)
        content = (result.archive / path).read_bytes()
        for dataset in header.channels:
            body = content[dataset.offset : dataset.offset + 4 * dataset.bins]
            held += b"\r\n" in body
            assert content[dataset.offset + 4 * dataset.bins :][:2] == b"\r\n"
    assert held > 0

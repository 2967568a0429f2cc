"""Simulated scans in the files of a Raymetrics lidar, from headers to products."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.cli.app import app
from lidarops.errors import CampaignError
from lidarops.raw import licel
from lidarops.raw.archive import open_archive
from lidarops.records import Status
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign

ELEVATIONS = [5.0, 10.0, 20.0, 40.0]
AZIMUTHS = [20.0, 95.5]
START = datetime(2024, 12, 31, 23, 50, tzinfo=UTC)


def hill(tree):
    return tree["simulation"]["instruments"]["hill-lidar"]


def scan(dialect, damage=(), **acquisition):
    def change(tree):
        del tree["simulation"]["instruments"]["coast-lidar"]
        tree["simulation"]["duration"] = 240
        tree["simulation"]["atmosphere"] = {}
        del hill(tree)["atmosphere"]
        hill(tree).update(
            damage=list(damage),
            scan={
                "zenith_angles": [90.0 - elevation for elevation in ELEVATIONS],
                "azimuth": AZIMUTHS[0],
                "further_azimuths": AZIMUTHS[1:],
            },
        )
        hill(tree)["acquisition"].update(
            {"dialect": dialect, "interval": 30, "shots": 41, "repetition_rate": 20} | acquisition
        )
        tree["instruments"]["hill-lidar"]["products"] = {
            "signal": {"channels": ["photon_532o"], "background_range": [4000, 6000]}
        }

    return change


def granules(campaign):
    store = Store(campaign.catalog_url, campaign.name)
    scan_archive(campaign, store)
    found = sorted(store.granules(), key=lambda granule: granule.path)
    store.close()
    return found


def test_headers_hold_the_scan_and_two_memories(small):
    result = simulate_campaign(small(scan("raymetrics_scan")))
    lines = (result.archive / result.paths[5]).read_bytes().split(b"\r\n")
    place = b"0900 11.0000 47.8000 -10.0 95.5 30.0 1013.0"
    time = b"31/12/2024 23:52:30"
    assert lines[1].rstrip() == b" " + b" ".join([b"hill", time, time, place])
    assert lines[2].rstrip() == b" 20.0 095.5 75.5  -5.0 -40.0 05.0  00.0"
    assert lines[3].rstrip() == b" 0000021 0020 0000021 0000 04"
    assert [line.split()[13] for line in lines[4:8]] == [b"000021", b"000020"] * 2
    _, counts = licel.read_counts(result.archive / result.paths[5])
    assert counts["photon_532o"].any()
    assert not counts["photon_532o_2"].any()


def test_files_hold_the_values_of_another_dialect(small):
    """Counts, shots, times and pointings, as the reader of archives sees them."""
    one, other = (
        open_archive(
            simulate_campaign(small(scan(dialect, shots=40), archive=dialect)).archive,
            mask_and_scale=False,
        ).load()
        for dialect in ("raymetrics_scan", "licel")
    )
    pointings = [(90.0 - e, a) for a in AZIMUTHS for e in ELEVATIONS]
    np.testing.assert_allclose(one["zenith_angle"], [zenith for zenith, _ in pointings])
    np.testing.assert_allclose(one["azimuth"], [azimuth for _, azimuth in pointings])
    for name in ("analog_1064o", "photon_532o", "photon_532o_shots", "time", "time_bnds"):
        np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_array_equal(one["zenith_angle"], other["zenith_angle"])


def test_a_file_of_unknown_pointing_is_refused_unless_the_campaign_gives_it(small):
    damage = [{"kind": "stale_pointing", "index": 0}, {"kind": "stop_before_start", "index": 3}]
    campaign = small(scan("raymetrics_scan", damage))
    result = simulate_campaign(campaign)
    assert result.truth["refused"].values.tolist() == [1] + [0] * 7
    found = granules(campaign)
    assert [granule.status for granule in found] == [Status.REFUSED] + [Status.GOOD] * 7
    assert "89 degree at azimuth 20 is not on the grid of its scan" in found[0].reason
    assert "give zenith_angle in the facts if the beam is fixed" in found[0].reason
    assert "stop lies 1 s before start" in " ".join(found[3].notes)
    assert found[3].stop - found[3].start == timedelta(seconds=2.05)
    facts = campaign.instruments["hill-lidar"].facts[0].model_copy(update={"zenith_angle": 12.0})
    instrument = campaign.instruments["hill-lidar"].model_copy(update={"facts": [facts]})
    known = campaign.model_copy(update={"instruments": {"hill-lidar": instrument}})
    assert [granule.zenith_angle for granule in granules(known)] == [12.0] * 8


def _on_local_time(tree, zone=-18000):
    hill(tree)["acquisition"]["clock"] = [
        {"at": "2024-12-31T00:00:00Z", "offset": zone},
        {"at": "2024-12-31T23:52:00Z", "offset": zone + 3600},
    ]
    facts = tree["instruments"]["hill-lidar"]["facts"][0]
    tree["instruments"]["hill-lidar"]["facts"] = [
        facts | {"clock_offset": zone, "valid_to": "2024-12-31T23:52:00Z"},
        facts | {"clock_offset": zone + 3600, "valid_from": "2024-12-31T23:52:00Z"},
    ]


def test_times_are_utc_where_the_campaign_gives_the_offset_of_the_clock(small):
    """Also where the clock jumps by an hour within the scan; in products and their day too."""
    campaign = small(scan("raymetrics_scan", shots=40), _on_local_time)
    result = simulate_campaign(campaign)
    written = [licel.read_header(result.archive / path).start for path in result.paths]
    starts = [START + k * timedelta(seconds=30) for k in range(8)]
    offsets = [5] * 4 + [4] * 4
    assert sorted(written) == sorted(
        start - timedelta(hours=hours) for start, hours in zip(starts, offsets, strict=True)
    )
    assert sorted(granule.start for granule in granules(campaign)) == starts
    record = reprocess(campaign)
    times = []
    for path in sorted({p.path for scene in record.scenes for p in scene.products}):
        assert "20241231" in path.replace("/", "")
        with xr.open_dataset(f"{record.products}/{path}") as product:
            times.extend(product["time"].values)
        made = CliRunner().invoke(app, ["reproduce", f"{record.products}/{path}"])
        assert made.exit_code == 0, made.output
    middles = [start.replace(tzinfo=None) + timedelta(seconds=1) for start in starts]
    np.testing.assert_array_equal(times, np.array(middles, "datetime64[ns]"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tree: hill(tree).pop("scan"), "states a scan, but there is none"),
        (
            lambda tree: (
                hill(tree)["acquisition"].update(dialect="licel", shots=40),
                hill(tree).update(damage=[{"kind": "stale_pointing", "index": 0}]),
            ),
            "needs the grid of a scan",
        ),
    ],
)
def test_scans_and_their_dialect_belong_together(small, change, words):
    with pytest.raises(CampaignError, match=words):
        simulate_campaign(small(scan("raymetrics_scan"), change))

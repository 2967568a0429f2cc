"""The campaigns in catalogs/ can be simulated, read and used for retrievals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.raw import licel
from lidarops.raw.archive import open_archive
from lidarops.retrieve.network import geometry
from lidarops.simulate.campaign import simulate_campaign


def _short(repository, tmp_path, name, **settings):
    campaign = load_campaign(repository / f"catalogs/{name}.yaml", archive=tmp_path / "raw")
    simulation = campaign.simulation.model_copy(update=settings)
    return campaign.model_copy(update={"simulation": simulation})


def test_a_scan_crosses_the_zenith(repository, tmp_path):
    campaign = _short(repository, tmp_path, "scan", duration=40 * 60)
    result = simulate_campaign(campaign)
    west, east = [90, 85, 80, 75, 70, 60, 45, 30], [0, 30, 45, 60, 70, 75, 80, 85, 90]
    cycle = [(zenith, 270) for zenith in west] + [(zenith, 90) for zenith in east]
    expected = [cycle[index % 17] for index in range(40)]
    opened = open_archive(result.archive / "plain", channels=["photon_532o"])
    signal = opened.isel(time=np.isin(opened["time"].values, result.truth["time"].values))
    assert signal.sizes["time"] == 40
    np.testing.assert_array_equal(signal["zenith_angle"], [zenith for zenith, _ in expected])
    np.testing.assert_array_equal(signal["azimuth"], [azimuth for _, azimuth in expected])
    np.testing.assert_array_equal(result.truth["zenith_angle"], signal["zenith_angle"])
    np.testing.assert_array_equal(result.truth["azimuth"], signal["azimuth"])
    # The level beam has one extinction.
    level = result.truth["zenith_angle"].values == 90
    np.testing.assert_array_equal(result.truth["homogeneous"].values == 1, level)
    assert np.isfinite(result.truth["total_extinction"].values[level]).all()


def test_both_sides_of_a_layered_sky_are_alike(repository, tmp_path):
    result = simulate_campaign(_short(repository, tmp_path, "scan", duration=17 * 60))
    truth = result.truth
    depth = (
        truth["profile_path_optical_depth_plain_scanner"].isel(wavelength_plain_scanner=0).values
    )
    rows = truth["profile_granule_plain_scanner"].values
    zenith, azimuth = truth["zenith_angle"].values[rows], truth["azimuth"].values[rows]
    far = truth["range_end_plain_scanner"].values
    # To the same height, which lies in the free atmosphere, the optical depth is that of the
    # zenith over the cosine; the boundary layer grows meanwhile.
    height = 2000.0
    vertical = np.interp(height, far, depth[(zenith == 0)][0])
    for angle in (30, 45, 60):
        sides = [depth[(zenith == angle) & (azimuth == side)][0] for side in (90, 270)]
        for side in sides:
            slant = np.interp(height / math.cos(math.radians(angle)), far, side)
            assert slant * math.cos(math.radians(angle)) == pytest.approx(vertical, rel=0.05)


@pytest.mark.slow
def test_a_network_shares_one_atmosphere(repository, tmp_path):
    campaign = _short(repository, tmp_path, "network")
    result = simulate_campaign(campaign)
    truth = result.truth
    directions = {"west": 70, "east": 310, "north": 190}
    for name, azimuth in directions.items():
        opened = open_archive(result.archive / name)
        assert opened.sizes["time"] == 120
        assert set(opened["zenith_angle"].values) == {90}
        assert set(opened["azimuth"].values) == {azimuth}
        station = campaign.stations[name]
        assert float(opened["longitude"]) == pytest.approx(station.longitude, abs=1e-6)
        assert float(opened["latitude"]) == pytest.approx(station.latitude, abs=1e-6)

    def extinction(name):
        return truth[f"profile_total_extinction_{name}_lidar"].isel({f"wavelength_{name}_lidar": 0})

    # Each beam crosses the two others; there both lidars measure the same air.
    names = list(directions)
    places = [campaign.stations[name] for name in names]
    net = geometry.build_network(
        [
            geometry.Beam(at.latitude, at.longitude, at.altitude, azimuth, 0.0)
            for at, azimuth in zip(places, directions.values(), strict=True)
        ],
        nearest=150.0,
    )
    assert net.crossings == 3
    assert net.near_crossing.all()
    for crossing in range(3):
        at_crossing = net.passages.crossing == crossing
        series = []
        beams, distances = net.passages.beam[at_crossing], net.passages.range[at_crossing]
        for beam, distance in zip(beams, distances, strict=True):
            cells = truth[f"range_{names[beam]}_lidar"].values
            series.append(
                np.log(extinction(names[beam]).values[:, np.argmin(np.abs(cells - distance))])
            )
        assert 1500.0 < distances.min() < 1700.0
        assert 2900.0 < distances.max() < 3050.0
        # At most half a bin apart, far less than eddies of 400 m.
        assert np.abs(series[0] - series[1]).mean() < 0.02
        assert np.corrcoef(*series)[0, 1] > 0.98
    # Haze is thicker in the west.
    west = extinction("west").values.mean(axis=0)
    assert west[0] > west[40]


def test_an_archive_of_four_stations(repository, tmp_path):
    campaign = _short(repository, tmp_path, "archive", duration=1800)
    result = simulate_campaign(campaign)
    refused = dict(zip(result.truth["path"].values, result.truth["refused"].values, strict=True))
    sites = {"manaus": "Manaus", "saopaulo": "Sao Paul", "pilar": "LidarPi", "golmud": "Golmud"}
    stations = set()
    for path in result.paths:
        if refused[path]:
            continue
        header = licel.read_header(result.archive / path)
        stations.add(path.partition("/")[0])
        assert header.site == sites[path.partition("/")[0]]
        assert header.zenith_angle == 0
    assert stations == sites.keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["simulation"].update(origin="nowhere"), "nowhere"),
        (lambda t: t["stations"]["north"].update(latitude=-47), "flat"),
        (lambda t: t["instruments"]["west-lidar"]["facts"][0].update(zenith_angle=90), "scanning"),
        (
            lambda t: t["simulation"]["instruments"]["west-lidar"]["acquisition"].update(
                dialect="pilar"
            ),
            "azimuth of a scan",
        ),
    ],
)
def test_an_impossible_network_is_refused(repository, tmp_path, change, message):
    campaign = load_campaign(repository / "catalogs/network.yaml", archive=tmp_path / "raw")
    tree = campaign.model_dump()
    change(tree)
    with pytest.raises(CampaignError, match=message):
        simulate_campaign(Campaign.model_validate(tree))
    assert not (tmp_path / "raw").exists()

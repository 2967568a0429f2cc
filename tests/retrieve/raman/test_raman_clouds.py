"""Clouds in means of Raman and elastic signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.raman_signals import LASER, RAMAN, make_sky, mean_over

from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.labeled import retrieve
from lidarops.retrieve.raman.signals import largest_of_cells, make_cells, state_of_cells, touched
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled_averaging import (
    ClockAverage,
    IntervalSums,
    Screening,
)
from lidarops.retrieve.signal.thresholds import THRESHOLDS

STEP = 15.0
R = STEP * (np.arange(1000) + 0.5)
HAZE = np.where(R < 4000.0, 1e-4 * np.exp(-R / 1500.0), 0.0)
CIRRUS = np.where((R > 6000.0) & (R < 6300.0), 1e-4, 0.0)
"""m-1; grey."""
CLOUD_RATIO = 20.0
WINDOW = (7000.0, 12_000.0, 4000.0)
PROFILES = 6
EXPOSURE = 1000.0
"""Counts per MHz."""
SKY = 2e-5


def conditioned(counts):
    """Return conditioned profiles of these counts, (time, range)."""
    length = np.timedelta64(300, "s")
    begin = np.datetime64("2026-03-01", "ns") + np.arange(PROFILES) * length
    plane = ("time", "range")
    return xr.Dataset(
        {
            "power": (plane, counts / EXPOSURE, {"units": "MHz", "dead_time_standard_error": 0.0}),
            "variance": (plane, np.maximum(counts, 1.0) / EXPOSURE**2, {"units": "MHz2"}),
            "quality": (plane, np.zeros(counts.shape, np.int32)),
            "noise_correlation_length": ("time", np.ones(PROFILES)),
        },
        coords={
            "time": begin + length // 2,
            "time_bnds": (("time", "nv"), np.stack([begin, begin + length], axis=-1)),
            "range": ("range", R, {"units": "m"}),
        },
    )


def averages(profiles):
    """Return the screened means over half an hour of both channels."""
    shots = xr.DataArray(np.full(PROFILES, 10_000), dims="time")
    times = profiles[0][["time", "time_bnds"]]
    means = [
        IntervalSums(times, R, seconds=1800, shots=shots, parts=THRESHOLDS.most_parts)
        for _ in profiles
    ]
    screening = Screening(cloud_contrast(LASER), 12_000.0)
    average = ClockAverage(means, screening)
    average.add(profiles)
    ((elastic, raman),) = average.completed()
    return elastic, raman


def product_of(cloudy, cirrus=CIRRUS, light=3e5):
    """Return the product of half an hour, `cloudy` of whose profiles have a cirrus."""
    clear, seen = (make_sky(HAZE + cloud, STEP, light, window=WINDOW) for cloud in (0.0, cirrus))
    # The cirrus has another lidar ratio than the haze.
    total = clear.air.backscatter + (HAZE + cirrus) / 50.0
    bright = seen.elastic * (1.0 + cirrus * (1.0 / CLOUD_RATIO - 1.0 / 50.0) / total)
    first = int(np.searchsorted(R, 1000.0))
    assert clear.elastic[first] == pytest.approx(bright[first])
    rng = np.random.default_rng(3)
    profiles = [
        conditioned(rng.poisson([of_cloud if k < cloudy else of_air for k in range(PROFILES)]))
        for of_cloud, of_air in ((bright, clear.elastic), (seen.raman, clear.raman))
    ]
    elastic, raman = averages(profiles)
    return retrieve(
        elastic.assign_coords(zenith_angle=0.0),
        raman,
        molecules=MolecularProfile.us_standard(),
        station_altitude=0.0,
        wavelengths=(LASER, RAMAN),
        settings=replace(clear.settings, highest=10_000.0, molecular_slope_error=0.0),
        overlap=clear.air.overlap,
    )


@pytest.fixture(scope="module")
def partly_cloudy():
    return product_of(2)


def inside(product, low, high):
    r = product["range"].to_numpy()
    return (low < r) & (r < high)


def raised(product, bit):
    return (product["quality_flag"].to_numpy()[0] & np.int32(bit)) != 0


def test_a_cirrus_in_some_of_the_profiles_is_stated(partly_cloudy):
    cloud = inside(partly_cloudy, 6000.0, 6300.0)
    state, fraction = (
        partly_cloudy[name].to_numpy()[0] for name in ("cloud_mask", "cloud_fraction")
    )
    assert (state[cloud] == 1).all()
    np.testing.assert_allclose(fraction[cloud], 2 / 6)
    elsewhere = inside(partly_cloudy, 300.0, 5850.0) | inside(partly_cloudy, 6500.0, 1e5)
    assert (state[elsewhere] == 0).all()
    assert partly_cloudy["cloud_base_altitude"][0] == pytest.approx(6000.0, abs=60.0)
    assert partly_cloudy["cloud_top_altitude"][0] == pytest.approx(6300.0, abs=120.0)
    assert raised(partly_cloudy, RamanQuality.PARTLY_CLOUDY)[cloud].all()


def test_clouds_beyond_the_product_have_no_heights():
    product = product_of(PROFILES, cirrus=np.where((R > 13_000.0) & (R < 13_300.0), 3e-4, 0.0))
    assert product["range"][-1] < 10_000.0
    assert np.isnan(product["cloud_top_altitude"]).all()
    assert np.isnan(product["cloud_base_altitude"]).all()
    assert not raised(product, RamanQuality.CLOUD).any()


def test_the_edges_of_a_cloud_are_to_be_used_with_care(partly_cloudy):
    """Up to 300 m below and above it, as in elastic products."""
    edges = inside(partly_cloudy, 5730.0, 6570.0)
    assert raised(partly_cloudy, RamanQuality.PARTLY_CLOUDY)[edges].all()
    assert raised(product_of(PROFILES), RamanQuality.CLOUD)[edges].all()


def test_backscatter_has_the_bits_of_its_cell_and_extinction_those_of_its_mean():
    product = product_of(PROFILES, light=1e4)
    state, r = product["cloud_mask"].to_numpy()[0], product["range"].to_numpy()
    cloud = r[state == 2]
    beside = (r > cloud.min() - 330.0) & (r < cloud.max() + 330.0)
    bits = product["aerosol_backscatter_quality_flag"].to_numpy()[0]
    np.testing.assert_array_equal((bits & RamanQuality.CLOUD) != 0, beside)
    reach = product["vertical_resolution"].to_numpy()[0] / 2.0
    of_mean = (r + reach > cloud.min()) & (r - reach < cloud.max())
    assert (of_mean & ~beside).any()
    assert raised(product, RamanQuality.CLOUD)[of_mean | beside].all()


def test_values_without_the_bit_are_right(partly_cloudy):
    """In the mean of clear and cloudy air."""
    r = partly_cloudy["range"].to_numpy()
    true = HAZE + CIRRUS * 2 / PROFILES
    length = np.nan_to_num(partly_cloudy["vertical_resolution"].to_numpy()[0], nan=60.0)
    extinction = mean_over(true, STEP, r, length, 300.0)
    backscatter = HAZE / 50.0 + CIRRUS / CLOUD_RATIO * 2 / PROFILES
    of_cells = mean_over(backscatter, STEP, r, np.full(r.size, 60.0))
    for name, flags, values in (
        ("aerosol_extinction", "quality_flag", extinction),
        ("aerosol_backscatter", "aerosol_backscatter_quality_flag", of_cells),
    ):
        good = (partly_cloudy[flags].to_numpy()[0] == 0) & inside(partly_cloudy, 400.0, 7500.0)
        assert good.sum() > 60
        error = partly_cloudy[f"{name}_standard_error"].to_numpy()[0]
        away = (partly_cloudy[name].to_numpy()[0] - values) / error
        assert np.abs(away[good]).max() < 4.0, name


def test_a_cloud_in_all_profiles_is_no_partial_one():
    product = product_of(PROFILES)
    cloud = inside(product, 6060.0, 6240.0)
    assert (product["cloud_mask"].to_numpy()[0, cloud] == 2).all()
    assert not raised(product, RamanQuality.PARTLY_CLOUDY)[cloud].any()
    assert raised(product, RamanQuality.CLOUD)[cloud].all()
    assert not raised(product, RamanQuality.CLOUD)[inside(product, 1000.0, 5000.0)].any()


def test_a_cloud_of_most_profiles_is_partial_and_one_of_the_mean():
    product = product_of(PROFILES - 1)
    cloud = inside(product, 6060.0, 6240.0)
    assert (product["cloud_mask"].to_numpy()[0, cloud] == 2).all()
    np.testing.assert_allclose(product["cloud_fraction"].to_numpy()[0, cloud], 5 / 6)
    for bit in (RamanQuality.PARTLY_CLOUDY, RamanQuality.CLOUD):
        assert raised(product, bit)[cloud].all()


def test_clear_air_has_no_cloud():
    product = product_of(0)
    assert not product["cloud_mask"].to_numpy()[0, inside(product, 300.0, 1e5)].any()
    assert np.isnan(product["cloud_base_range"]).all()


def test_states_of_cells_are_those_of_their_bins():
    cells = make_cells(np.arange(8) + 0.5, 8.0, 2.0)
    state = np.array([[0, 1, 3, 3, 3, 0, 2, 1]], np.int8)
    assert state_of_cells(state, cells, 3).tolist() == [[1, 3, 0, 2]]
    fraction = np.array([[0.0, 0.5, np.nan, np.nan, np.nan, 0.0, 1.0, 0.5]])
    np.testing.assert_array_equal(largest_of_cells(fraction, cells), [[0.5, np.nan, 0.0, 1.0]])


def test_a_cloud_takes_part_in_the_values_within_the_resolution():
    mask = np.zeros((2, 9), np.bool_)
    mask[:, 6] = True
    resolution = np.array([np.full(9, np.nan), np.full(9, 250.0)])
    near = touched(mask, resolution, 60.0)
    assert np.flatnonzero(near[0]).tolist() == [6]
    assert np.flatnonzero(near[1]).tolist() == [4, 5, 6, 7, 8]
    # Of cells next to partial overlap, the mean begins there.
    resolution = np.where(np.arange(9) < 3, np.nan, 250.0)[np.newaxis]
    near = touched(np.arange(9)[np.newaxis] == 6, resolution, 60.0)
    assert np.flatnonzero(near[0]).tolist() == [3, 4, 5, 6, 7, 8]

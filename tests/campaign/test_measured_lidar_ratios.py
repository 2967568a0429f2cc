"""Elastic inversion with the lidar ratios of a Raman product, on the published simulation."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from lidarops.campaign.ancillary_files import lidar_ratio_profile
from lidarops.flags import Quality, rejecting
from lidarops.products.raman.variables import FLAGS
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.clouds.labeled import Reference
from lidarops.retrieve.elastic.labeled import invert_elastic
from lidarops.retrieve.raman.labeled import retrieve
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.signal.counts_to_signal import photon_signal
from lidarops.retrieve.signal.labeled import DEAD_TIME_ERROR
from lidarops.settings import ReferenceSettings

RAMAN = {"355": ("387", 386.7e-9), "532": ("608", 607.4e-9)}


def averages(counts, r):
    """Return the means of one profile each, of photon counts without dead time."""
    rows, plane = len(counts), ("time", "range")
    shots = np.full(rows, 1000, np.int32)
    signal = photon_signal(counts.astype(np.int32), shots, r, bin_width=15.0, dead_time=0.0)
    near = np.where(r < 345.0, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
    return xr.Dataset(
        {
            "power": (plane, counts / 100.0, {DEAD_TIME_ERROR: 0.0}),
            "variance": (plane, np.maximum(signal.variance, 1e-12)),
            "quality": (plane, np.tile(near, (rows, 1))),
            "noise_correlation_length": ("time", np.ones(rows)),
            "profiles": ("time", np.ones(rows, np.int32)),
            "shots": ("time", shots),
        },
        coords={"time": np.arange(rows), "range": r, "zenith_angle": 0.0},
    )


@pytest.mark.parametrize("name", RAMAN)
def test_elastic_values_with_measured_lidar_ratios_are_right_within_their_errors(
    data_root, tmp_path, name
):
    folder = data_root / "synthetic/pappalardo_raman"
    if not folder.exists():
        pytest.skip("no published Raman signals")
    raman, wavelength = RAMAN[name]
    laser = float(name) * 1e-9
    with (
        xr.open_dataset(folder / "signals.nc") as counts,
        xr.open_dataset(folder / "truth.nc") as truth,
    ):
        r = counts["rangebin"].values
        nitrogen, elastic = (
            averages(counts["phy"].sel(channel=f"{c}_1").values, r) for c in (raman, name)
        )
        true, ratio = (
            truth[key].sel(channel=f"{name}_1").values for key in ("backscatter", "lidar_ratio")
        )
    levels = np.loadtxt(folder / "pressure_temperature.txt", skiprows=1)
    air = MolecularProfile.from_profile(levels[:, 1], levels[:, 2], levels[:, 3] + 273.15)
    product = retrieve(
        elastic,
        nitrogen,
        molecules=air,
        station_altitude=0.0,
        wavelengths=(laser, wavelength),
        settings=RamanSettings(),
        overlap=np.where(r < 345.0, np.nan, 1.0),
    )
    rejected = (product["quality_flag"] & np.int32(rejecting(FLAGS))) != 0
    heights = ("range", product["range"].values)
    product = product.assign(usable=2 * rejected.astype(np.int8)).assign_coords(altitude=heights)
    product.to_netcdf(tmp_path / "night.nc")
    measured, _ = lidar_ratio_profile(tmp_path, "night.nc")
    # Means of the lidar ratios of single profiles are above 70 sr in places.
    low = measured.altitude < 1200.0
    mean = np.interp(measured.altitude, r, ratio)[low].mean()
    assert measured.ratio[low].mean() == pytest.approx(mean, rel=0.1)
    found = invert_elastic(
        elastic,
        molecules=air,
        wavelength=laser,
        station_altitude=0.0,
        lidar_ratio=lambda altitude: measured.at(altitude, (50.0, 10.0)),
        molecular_relative_error=0.01,
        reference=Reference(**dict(ReferenceSettings())),
        overlap_is_stated=True,
    )
    # Products end above all clouds.
    r, true = r[: found.sizes["range"]], true[: found.sizes["range"]]
    error = found["aerosol_backscatter_standard_error"].values
    z = np.abs(found["aerosol_backscatter"].values - true) / error
    for top in (1000.0, 5000.0):
        good = (found["quality_flag"].values == 0) & (r > 350.0) & (r < top)
        assert np.mean(good[:, (r > 350.0) & (r < top)]) > 0.95
        assert np.mean(z[good] < 1.96) > 0.92
        assert np.mean(z[good] > 4.0) <= 1e-3

"""The elastic inversion of published simulations: the EARLINET algorithm intercomparisons."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from support.inversions import invert_elastic

from lidarops.flags import Quality
from lidarops.products.elastic import ReferenceSettings
from lidarops.raw import licel
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.elastic import labeled
from lidarops.retrieve.signal.counts_to_signal import photon_signal

GREEN = 532e-9


def within(r, window):
    return (r >= window[0]) & (r <= window[1])


def sounding(folder, columns):
    rows = np.loadtxt(folder / "molecular_profile_hPa.csv", delimiter=",")
    altitude, pressure, temperature = (rows[:, columns.index(name)] for name in "zpT")
    return MolecularProfile.from_profile(altitude, pressure, temperature, pressure_unit="hPa")


def green_counts(path):
    return licel.read_counts(path, ["analog_532o"])[1]["analog_532o"].astype(np.float64)


def clear_shape(clear, r):
    """Attenuated backscatter of air over range squared."""
    extinction = clear["molecular_extinction"]
    steps = 0.5 * (extinction[1:] + extinction[:-1]) * np.diff(r)
    depth = extinction[0] * r[0] + np.concatenate([[0.0], np.cumsum(steps)])
    return clear["molecular_backscatter"] * np.exp(-2.0 * depth) / r**2


def line(shape, values, variance):
    """Return the coefficients of a constant and a shape, and their covariance."""
    design = np.stack([np.ones_like(shape), shape], axis=-1)
    weighted = design / variance[:, np.newaxis]
    covariance = np.linalg.inv(weighted.T @ design)
    return covariance @ (weighted.T @ values), covariance


GREEN_MAXIMUM = 1.9093e7
"""Counts at the maximum of the 532 nm signal of the set."""


@pytest.fixture(scope="module")
def boeckmann(data_root):
    folder = data_root / "synthetic/boeckmann"
    r = 15.0 * (np.arange(1005) + 0.5)
    profile = sounding(folder, "pTz")
    clear = {
        "molecular_backscatter": profile.backscatter(r, GREEN),
        "molecular_extinction": profile.extinction(r, GREEN),
    }
    clean = green_counts(folder / "noise_free.licel")
    clean = clean / clean.max() * GREEN_MAXIMUM
    setup = {**clear, "lidar_ratio": 39.0, "reference": (7e3, 8e3)}
    overlap = r > 400.0
    clean[~overlap] = np.nan
    return folder, r, clear, clean, setup


@pytest.mark.parametrize("level", [0, 2, 4, 6, 8])
def test_boeckmann_set_is_retrieved_or_reported_as_uncertain(boeckmann, level):
    folder, r, clear, clean, setup = boeckmann
    truth = invert_elastic(clean, r, **setup).backscatter
    assert np.all(np.isfinite(truth[r > 400.0]))

    raw = green_counts(folder / f"background_1e{level}.licel")
    total = raw / raw.max() * (GREEN_MAXIMUM + 10.0**level)
    power = np.where(r > 400.0, total, np.nan)
    # Weights from a model, not from the noise of the single bin.
    variance = (np.nan_to_num(clean) + 10.0**level) / 1000.0
    far = r > 9e3
    phi = clear_shape(clear, r)
    fitted_line, covariance = line(phi[far] / phi[far].mean(), power[far], variance[far])
    background_error = np.sqrt(covariance[0, 0])
    assert abs(fitted_line[0] - true_background(r, clean, total, level)) < max(
        1.0, 3.5 * background_error
    )

    result = invert_elastic(
        power - fitted_line[0], r, **setup, variance=variance,
        background_standard_error=background_error,
    )  # fmt: skip
    near = within(r, (500.0, 6e3))
    if level <= 5:
        assert np.all(result.valid[near])
        bias = np.mean(result.backscatter[near] - truth[near]) / np.mean(truth[near])
        assert abs(bias) < 0.01
    deviation = (result.backscatter - truth) / result.backscatter_standard_error
    solved = near & result.valid
    if np.any(solved):
        assert np.sqrt(np.mean(deviation[solved] ** 2)) < 2.0
    if level == 8:
        assert np.all(result.unstable[within(r, (7e3, 8e3))])


def true_background(r, clean, total, level):
    """Return the background of a file, fitted with the noise-free signal of unknown scale."""
    use = np.arange(r.size) >= 60
    variance = (clean + 10.0**level)[use] / 1000.0
    return line(clean[use], total[use], variance)[0][0]


@pytest.fixture(scope="module")
def pappalardo(data_root):
    folder = data_root / "synthetic/pappalardo"
    files = sorted(folder.glob("*.licel"))
    counts = np.stack([green_counts(file) for file in files])
    r = 15.0 * (np.arange(counts.shape[1]) + 0.5)
    profile = sounding(folder, "zTp")
    return r, counts, {
        "molecular_backscatter": profile.backscatter(r, GREEN),
        "molecular_extinction": profile.extinction(r, GREEN),
        "lidar_ratio": 65.41,
        "reference": (7e3, 9e3),
    }  # fmt: skip


def test_pappalardo_files_agree_within_their_errors(pappalardo):
    """Compare each file with the mean of all others, whose noise is 3.7 times less."""
    r, counts, setup = pappalardo
    near = within(r, (500.0, 5e3))
    x = np.where(r > 300.0, counts, np.nan)
    deviations = []
    for k in range(len(x)):
        others = np.delete(x, k, axis=0).mean(axis=0)
        variance = np.maximum(np.nan_to_num(others), 1.0 / (len(x) - 1))
        single = invert_elastic(x[k], r, **setup, variance=variance)
        mean_of_others = invert_elastic(others, r, **setup, variance=variance / (len(x) - 1))
        assert np.all(single.valid[near])
        error = np.hypot(
            single.backscatter_standard_error, mean_of_others.backscatter_standard_error
        )
        deviations.append(((single.backscatter - mean_of_others.backscatter) / error)[near])
    deviations = np.array(deviations)
    assert np.mean(np.abs(deviations) < 3.0) > 0.994
    assert 0.95 < np.std(deviations) < 1.05
    # The mean of each file is within the error of its reference.
    assert np.max(np.abs(deviations.mean(axis=1))) < 3.0


def test_pappalardo_particles_do_not_depend_on_the_reference_in_clean_air(pappalardo):
    r, counts, setup = pappalardo
    total = np.where(r > 300.0, counts.sum(axis=0), np.nan)
    variance = np.maximum(np.nan_to_num(total), 1.0)
    near = within(r, (500.0, 5e3))
    solutions = [
        invert_elastic(total, r, **setup | {"reference": window}, variance=variance)
        for window in ((7e3, 8.5e3), (8.5e3, 10e3), (10e3, 12e3))
    ]
    for other in solutions[1:]:
        error = np.hypot(solutions[0].backscatter_standard_error, other.backscatter_standard_error)
        difference = np.abs(other.backscatter - solutions[0].backscatter)
        assert np.all(difference[near] < 3.0 * error[near])


CHANNELS = {"355": 355e-9, "532": 532e-9, "1064": 1064e-9}


def single_files(folder, channel):
    """Return counts, ranges, and averages of one file each, as products make them."""
    files = sorted(folder.glob("*.licel"))
    name = f"analog_{channel}o"
    counts = np.stack([licel.read_counts(file, [name])[1][name] for file in files])
    r = 15.0 * (np.arange(counts.shape[1]) + 0.5)
    shots = np.full(len(counts), 1000)
    # The counts are Poisson numbers without dead time.
    signal = photon_signal(counts, shots, r, bin_width=15.0, dead_time=0.0)
    near = np.where(r < 300.0, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
    over = ("time", "range")
    return r, xr.Dataset(
        {
            "power": (over, counts / (shots[:, np.newaxis] * 0.1)),
            "variance": (over, np.maximum(signal.variance, 1e-12)),
            "quality": (over, np.broadcast_to(near, counts.shape)),
            "shots": ("time", shots.astype(np.int32)),
            "profiles": ("time", np.ones(len(counts), np.int32)),
        },
        coords={"range": r, "zenith_angle": 0.0},
    )


@pytest.mark.parametrize("channel", CHANNELS)
def test_single_files_are_right_within_their_errors_or_have_no_reference(data_root, channel):
    folder = data_root / "synthetic/pappalardo"
    r, averages = single_files(folder, channel)
    with xr.open_dataset(data_root / "synthetic/pappalardo_raman/truth.nc") as truth:
        row = list(CHANNELS).index(channel)
        true = truth["backscatter"].values[row]
        ratio = truth["lidar_ratio"].values[row]
    compared = within(r, (300.0, 5e3)) & (true > 0.0)
    reference = ReferenceSettings()
    result = labeled.invert_elastic(
        averages,
        molecules=sounding(folder, "zTp"),
        wavelength=CHANNELS[channel],
        station_altitude=0.0,
        lidar_ratio=labeled.constant_ratio(
            float(np.average(ratio[compared], weights=true[compared])), 10.0
        ),
        molecular_relative_error=0.01,
        reference=labeled.Reference(**dict(reference)),
        overlap_is_stated=True,
    )
    # Products end above all clouds.
    true, compared = true[: result.sizes["range"]], compared[: result.sizes["range"]]
    score = (result["aerosol_backscatter"].values - true) / result[
        "aerosol_backscatter_standard_error"
    ].values
    used = (result["quality_flag"].values == 0) & compared
    assert np.count_nonzero(np.abs(score[used]) > 4.0) <= 1e-3 * np.count_nonzero(used)
    assert np.mean(np.abs(score[used]) < 1.96) > 0.95
    # At 1064 nm air is faint: the reference of one file is not certain enough for all values.
    assert channel != "1064" or 0.5 < used[:, compared].mean() < 0.8
    if channel != "1064":
        assert used[:, compared].mean() > 0.95
        mean, error = mean_of_files(result.isel(range=compared))
        score = np.abs(mean - true[compared]) / error
        # All windows hold some aerosol: the error of the reference is common to the files.
        assert np.mean(score > 2.0) < 0.05
        assert np.sqrt(np.mean(score**2)) < 1.1


def mean_of_files(result):
    """Return mean backscatter and its error; random errors decrease with the number of files."""
    errors = {
        source: np.abs(result[f"aerosol_backscatter_error_{source}"].values)
        for source in ("noise", "background", "reference", "lidar_ratio", "molecular")
    }
    random = sum(np.nansum(errors.pop(source) ** 2, axis=0) for source in ("noise", "background"))
    files = np.isfinite(result["aerosol_backscatter"].values).sum(axis=0)
    shared = sum(np.nanmean(error, axis=0) ** 2 for error in errors.values())
    return np.nanmean(result["aerosol_backscatter"].values, axis=0), np.sqrt(
        random / files**2 + shared
    )

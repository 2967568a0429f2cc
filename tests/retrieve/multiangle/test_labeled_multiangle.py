"""The multi-angle product from profiles of a scanning lidar, simulated by the lidar equation."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.cases import each
from support.oracles.angle_scenes import on_altitudes, retrieve_scan
from support.scan_arguments import altitude_cycles

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.multiangle import labeled, labeled_altitudes
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.optical_depth import MultiAngleMethod, OpticalDepthSettings

STATION = 120.0
RANGE = 15.0 * (np.arange(1200) + 0.5)
ALTITUDE = STATION + 300.0 + 60.0 * np.arange(60)
ONE_SIDE = np.array([0.0, 20.0, 32.0, 42.0, 50.0, 56.0, 61.0, 65.0, 68.0, 70.0])
TWO_SIDED = np.concatenate([-ONE_SIDE[:0:-2], ONE_SIDE[::2]])
MISSING, OVERLAP = np.int32(Quality.INPUT_MISSING), np.int32(Quality.INCOMPLETE_OVERLAP)
SETTINGS = {
    "altitude_grid": ALTITUDE,
    "station_altitude": STATION,
    "background_range": (16200.0, 18000.0),
}


def optical_depth(height):
    """Return the optical depth of molecules, and of haze with a scale height of 1.2 km."""
    height = np.asarray(height, dtype=np.float64)
    return 0.05 * -np.expm1(-height / 8000.0) + 0.3 * -np.expm1(-height / 1200.0)


def backscatter(height):
    return 1.5e-6 * np.exp(-height / 8000.0) + 5e-6 * np.exp(-height / 1200.0)


def power(zenith):
    """Return the received power along beams without background, (beam, range)."""
    cosine = np.cos(np.radians(zenith))[:, np.newaxis]
    height = RANGE * cosine
    return 3e14 * backscatter(height) / RANGE**2 * np.exp(-2.0 * optical_depth(height) / cosine)


def scan(
    cycles: int = 24,
    zenith=TWO_SIDED,
    seed: int = 5,
    *,
    sigma: float = 0.5,
    scatter: float = 0.01,
    jitter: float = 0.0,
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return conditioned profiles, and their pointing and times.

    Noise is white with the standard deviation `sigma`. The backscatter of each beam and cycle
    deviates by `scatter` from bin to bin, and the energy of each profile by `jitter`.
    """
    rng = np.random.default_rng(seed)
    beams = len(zenith)
    clean = power(np.abs(zenith))
    patches = rng.normal(0.0, scatter, (cycles, beams, RANGE.size))
    energy = np.exp(rng.normal(0.0, jitter, (cycles, beams, 1)))
    values = clean * energy * np.exp(patches) + rng.normal(5.0, 0.2, (cycles, beams, 1))
    values = (values + rng.normal(0.0, sigma, values.shape)).reshape(-1, RANGE.size)
    bits = np.zeros(values.shape, dtype=np.int32)
    bits[:, RANGE < 300.0] = OVERLAP
    starts = np.datetime64("2026-03-01", "ns") + 30 * np.arange(cycles * beams).astype(
        "timedelta64[s]"
    )
    length = np.timedelta64(30, "s")
    dims = ("time", "range")
    conditioned = xr.Dataset(
        {
            "power": (dims, values),
            "variance": (dims, np.full(values.shape, sigma**2)),
            "quality": (dims, bits),
            "noise_correlation_length": ("time", np.ones(len(values))),
        },
        coords={"range": RANGE},
    )
    return conditioned, {
        "zenith_angle": np.tile(np.abs(zenith), cycles),
        "azimuth": np.tile(np.where(np.asarray(zenith) < 0, 200.0, 20.0), cycles),
        "time_bnds": np.stack([starts, starts + length], axis=-1),
        "shots": np.full(cycles * beams, 600),
    }


def take(conditioned: xr.Dataset, pointing: dict[str, Any], kept) -> tuple[xr.Dataset, dict]:
    return conditioned.isel(time=kept), {name: v[kept] for name, v in pointing.items()}


def solve(conditioned: xr.Dataset, pointing: dict[str, Any], **changes: Any) -> xr.Dataset:
    return retrieve_scan(conditioned, **(pointing | SETTINGS | changes))


def has(product: xr.Dataset, bit: Quality) -> np.ndarray:
    return (product["quality_flag"].to_numpy() & int(bit)) != 0


def assert_explained(product: xr.Dataset) -> None:
    flagged = product["quality_flag"].to_numpy() != 0
    for name, variable in product.data_vars.items():
        if variable.dims == ("time", "altitude"):
            assert np.all(flagged | np.isfinite(variable.to_numpy())), name


AIR = MolecularProfile(
    altitude=np.arange(0.0, 40e3, 500.0),
    pressure=101325.0 * np.exp(-np.arange(0.0, 40e3, 500.0) / 8000.0),
    temperature=np.full(80, 273.0),
)
"""With the scale height of the simulated molecules."""
FAR = {"molecules": AIR, "wavelength": 532e-9}


def errors(product: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return errors over standard errors, and where nothing is flagged."""
    truth = optical_depth(ALTITUDE - STATION)
    off = (product["vertical_optical_depth"] - truth) / product[
        "vertical_optical_depth_standard_error"
    ]
    plain = product["quality_flag"].to_numpy() == 0
    return off.to_numpy(), plain


# Against the truth


@pytest.mark.parametrize("method", ["joint", "kano_hamilton"])
@pytest.mark.parametrize("background", [{}, FAR], ids=["tail", "known_shape"])
@pytest.mark.parametrize(
    ("zenith", "noise"),
    [(TWO_SIDED, (0.5, 0.01)), (ONE_SIDE, (0.5, 0.01)), (TWO_SIDED, (0.02, 0.03))],
    ids=["two_sided", "one_sided", "bright"],
)
def test_unflagged_optical_depths_lie_within_three_standard_errors(
    zenith, noise, background, method
):
    off, plain = [], []
    for seed in range(1, 9):
        profiles = scan(16, zenith, seed, sigma=noise[0], scatter=noise[1])
        product = solve(*profiles, method=method, **background)
        assert_explained(product)
        for kept, part in zip((off, plain), errors(product), strict=True):
            kept.append(part)
    good = np.concatenate(plain)
    size = np.abs(np.concatenate(off)[good])
    assert np.mean(size < 3) >= 0.99
    assert np.mean(size < 1) >= 0.6
    assert good.mean() >= (0.4 if background is FAR else 0.1)


def test_optical_depths_stay_valid_if_shot_energy_jitters():
    """Errors common to all altitudes of a beam are air with the largest correlation."""
    product = solve(*scan(32, sigma=0.05, scatter=0.002, jitter=0.02), **FAR)
    off, _ = errors(product)
    stands = ~has(product, flags_of("multiangle").rejecting)
    assert stands.mean() > 0.5
    assert np.mean(np.abs(off[stands]) < 3) >= 0.99
    assert_explained(product)


def test_extinction_is_that_of_the_layers():
    product = solve(*scan(32), method="joint", **FAR)
    tops = np.append(0.0, ALTITUDE - STATION)
    truth = np.diff(optical_depth(tops)) / np.diff(tops)
    off = (
        (product["total_extinction"] - truth) / product["total_extinction_standard_error"]
    ).to_numpy()
    good = ~has(product, flags_of("multiangle").rejecting)
    assert np.mean(np.abs(off[good]) < 3) >= 0.98
    assert float(product["total_extinction_standard_error"].median()) < 3e-5


@pytest.mark.parametrize("method", ["joint", "kano_hamilton"])
def test_optical_depths_of_layers_lie_within_their_errors(method):
    layers = [(STATION, STATION + 600.0), (STATION + 610.0, STATION + 1500.0)]
    off = []
    for seed in range(4):
        product = solve(*scan(32, seed=seed), method=method, **FAR, layers=layers)
        bounds = product["layer_bnds"].to_numpy()
        np.testing.assert_allclose(bounds, STATION + np.array([[0, 600], [600, 1500]]))
        np.testing.assert_allclose(product["layer_altitude"], STATION + np.array([300, 1050]))
        truth = np.diff(optical_depth(bounds - STATION), axis=1)[:, 0]
        error = np.hypot(
            product["layer_vertical_optical_depth_standard_error"],
            product["layer_vertical_optical_depth_gradient_error"],
        )
        off.append(((product["layer_vertical_optical_depth"] - truth) / error).to_numpy())
        reject = has(product, flags_of("multiangle").rejecting)
        hidden = np.stack([reject[:, 5], reject[:, 5] | reject[:, 20]], axis=1)
        np.testing.assert_array_equal(np.isnan(product["layer_vertical_optical_depth"]), hidden)
        # Equal to the difference of the optical depths but for rounding.
        depth = product["vertical_optical_depth"].to_numpy()
        layer = np.where(hidden[:, 1], np.nan, depth[:, 20] - depth[:, 5])
        np.testing.assert_allclose(product["layer_vertical_optical_depth"][:, 1], layer, atol=1e-12)
    size = np.abs(np.concatenate(off))
    size = size[np.isfinite(size)]
    assert size.size > 100
    assert np.mean(size < 3) >= 0.97
    assert "layer_vertical_optical_depth" not in solve(*scan(3), method=method)


@pytest.mark.parametrize("base", [0.0, 1500.0])
def test_an_optical_depth_below_zero_or_falling_is_flagged(base):
    """A gain that increases with the path through the air above the base."""
    conditioned, pointing = scan(12)
    cosine = np.cos(np.radians(pointing["zenith_angle"]))[:, np.newaxis]
    added = 5e-4 * np.maximum(RANGE * cosine - base, 0.0)
    light = power(pointing["zenith_angle"])
    conditioned["power"] += light * np.expm1(2.0 * np.minimum(added, 1.0) / cosine)
    product = solve(conditioned, pointing)
    flagged = has(product, MultiAngleQuality.NEGATIVE_OPTICAL_DEPTH)
    depth = product["vertical_optical_depth"].to_numpy()
    below_zero = depth < -2.0 * product["vertical_optical_depth_standard_error"].to_numpy()
    assert below_zero.any()
    assert flagged[below_zero].all()
    height = product["altitude"].to_numpy() - STATION
    assert flagged[:, (base + 200.0 < height) & (height < base + 1800.0)].all()
    assert not flagged[:, height < base - 200.0].any()
    assert not has(solve(*scan(12)), MultiAngleQuality.NEGATIVE_OPTICAL_DEPTH).any()


def test_no_good_optical_depth_lies_below_a_good_one_under_it():
    """Optical depths that fall by less than the error of a step, over many steps."""
    conditioned, pointing = scan(12)
    cosine = np.cos(np.radians(pointing["zenith_angle"]))[:, np.newaxis]
    added = 1.5e-4 * np.maximum(RANGE * cosine - 1200.0, 0.0)
    light = power(pointing["zenith_angle"])
    conditioned["power"] += light * np.expm1(2.0 * np.minimum(added, 1.0) / cosine)
    product = solve(conditioned, pointing)
    good = product["quality_flag"].to_numpy() == 0
    depth, error = (
        np.where(good, product[f"vertical_optical_depth{of}"], np.nan)
        for of in ("", "_standard_error")
    )
    fall = depth[:, :, np.newaxis] - depth[:, np.newaxis]
    most = 2.0 * np.hypot(error[:, :, np.newaxis], error[:, np.newaxis])
    assert not np.triu(fall > most, 1).any()
    assert np.isfinite(depth).sum() > 50


def test_product_has_monotone_profiles_and_chi_square():
    product = solve(*scan(16), **FAR)
    depth, risen = (
        product["vertical_optical_depth"].to_numpy(),
        product["monotone_vertical_optical_depth"].to_numpy(),
    )
    np.testing.assert_array_equal(np.isnan(depth), np.isnan(risen))
    for rising_row, row in zip(risen, depth, strict=True):
        steps = np.diff(rising_row[np.isfinite(rising_row)])
        assert np.all(steps >= 0)
        rising = np.all(np.diff(row[np.isfinite(row)], prepend=0.0) >= 0)
        assert np.array_equal(rising_row, row, equal_nan=True) == rising
    assert float(product["reduced_chi2"].mean()) == pytest.approx(1.0, abs=0.15)


def test_extinction_that_varies_along_the_paths_is_withheld():
    """Jittering shot energy, in a cloud whose extinction varies along the paths."""
    rng = np.random.default_rng(3)
    height, cycles, beams = 10.0 * np.arange(1, 61), 24, 8
    zenith = np.linspace(0.0, 60.0, beams)
    path = 1.0 / np.cos(np.radians(zenith))[:, np.newaxis]
    air = 0.1 * rng.normal(size=(cycles, beams, 1)) + 0.1 * rng.normal(size=(cycles, beams, 60))
    lost = np.cumsum(5e-3 * 10.0 * np.exp(2.0 * air), axis=-1)
    lost *= np.clip((height - 200.0) / 100.0, 0.0, 1.0)
    signal = np.exp(air - 2.0 * path * lost)
    dims = ("time", "beam", "altitude")
    beams = xr.Dataset(
        {
            "signal": (dims, signal),
            "variance": (dims, (1e-5 * signal) ** 2),
            "quality": (dims[::2], np.zeros((cycles, 60), np.int32)),
            "left": (dims[:2], np.zeros((cycles, beams))),
            "obstruction": (dims[:2], np.full((cycles, beams), np.nan)),
            "response": (dims[1:], np.ones((beams, 60))),
            "shots": ("time", np.ones(cycles, np.int32)),
        },
        coords={"altitude": height, "beam_zenith_angle": ("beam", zenith)},
    )
    product = labeled.retrieve_optical_depth(beams, OpticalDepthSettings())
    assert has(product, MultiAngleQuality.POOR_STRATIFICATION).all()
    assert np.isfinite(product["vertical_optical_depth"]).any()
    for name in (
        "total_extinction",
        "total_extinction_standard_error",
        "total_extinction_gradient_error",
    ):
        assert np.isnan(product[name]).all()


def test_signal_left_in_the_tail_is_part_of_the_error():
    """Of beams so bright that errors without it would be far too small."""
    conditioned, pointing = scan(32, sigma=0.02, scatter=0.003)
    product = solve(conditioned, pointing, method="kano_hamilton")
    off, plain = errors(product)
    assert plain.mean() > 0.9
    assert np.mean(np.abs(off[plain]) < 3) > 0.99


# Cycles, beams and inputs


def test_cycles_times_and_shots():
    conditioned, pointing = scan(3)
    product = solve(conditioned, pointing)
    assert dict(product.sizes) == {"time": 3, "altitude": 60, "beam": 10, "nv": 2}
    bounds = pointing["time_bnds"].reshape(3, 10, 2)
    np.testing.assert_array_equal(product["time_bnds"][:, 0], bounds[:, 0, 0])
    np.testing.assert_array_equal(product["time_bnds"][:, 1], bounds[:, -1, 1])
    np.testing.assert_array_equal(
        product["time"], bounds[:, 0, 0] + (bounds[:, -1, 1] - bounds[:, 0, 0]) // 2
    )
    np.testing.assert_array_equal(product["shots"], 6000)
    np.testing.assert_array_equal(product["beams"], 10)
    np.testing.assert_allclose(product["beam_zenith_angle"], np.abs(np.sort(TWO_SIDED)))
    np.testing.assert_allclose(product["beam_azimuth"], [200.0] * 5 + [20.0] * 5)
    assert "joint" in product.attrs["steps"]


def test_a_cycle_keeps_the_beams_left_by_missing_files():
    conditioned, pointing = scan(6)
    whole = solve(conditioned, pointing)
    kept = np.setdiff1d(np.arange(60), [21, 24, 25])
    product = solve(*take(conditioned, pointing, kept))
    assert product["beams"].to_numpy().tolist() == [10, 10, 7, 10, 10, 10]
    assert product["shots"].to_numpy().tolist() == [6000, 6000, 4200, 6000, 6000, 6000]
    gone = np.isnan(product["residual"].to_numpy()).all(axis=2)
    assert np.flatnonzero(gone[2]).tolist() == [1, 4, 5]
    assert not gone[[0, 1, 3, 4, 5]].any()
    np.testing.assert_array_equal(product["time"], whole["time"])
    off, plain = errors(product)
    assert np.nanmax(np.abs(off[2])[plain[2]], initial=0.0) < 4
    assert_explained(product)


def test_incomplete_cycles_are_used_as_far_as_possible():
    conditioned, pointing = scan(6)
    kept = np.setdiff1d(np.arange(60), [*range(22, 30), *range(41, 50)])
    product = solve(*take(conditioned, pointing, kept), method="kano_hamilton")
    assert product["beams"].to_numpy().tolist() == [10, 10, 2, 10, 1, 10]
    # Two beams to one side, of a scan to both sides: a gradient does not cancel.
    two, full = product.isel(time=2), product.isel(time=1)
    known = np.isfinite(two["vertical_optical_depth"])
    assert (two["vertical_optical_depth_gradient_error"] > 0.0).to_numpy()[known].all()
    wider = (
        two["vertical_optical_depth_standard_error"] > full["vertical_optical_depth_standard_error"]
    )
    assert wider.to_numpy()[np.isfinite(two["vertical_optical_depth"])].all()
    assert np.isnan(product["vertical_optical_depth"][4]).all()
    assert np.isnan(product["reach"][4])
    assert has(product, MultiAngleQuality.NO_LEVERAGE)[4].all()
    assert_explained(product)


@each("method", [m.value for m in MultiAngleMethod])
def test_every_missing_value_is_explained_whatever_the_method(method):
    conditioned, pointing = scan(5, ONE_SIDE, sigma=40.0)
    conditioned["power"][7] = np.nan
    conditioned["power"][20:30] = np.nan
    conditioned["quality"][33, 200:400] |= np.int32(Quality.SATURATED)
    conditioned["quality"][40:48, 60:120] |= np.int32(Quality.SATURATED)
    conditioned["quality"][2, 30:40] |= np.int32(Quality.PILE_UP)
    product = solve(conditioned, pointing, method=method)
    assert_explained(product)
    assert has(product, Quality.INPUT_MISSING)[2].all()
    assert has(product, Quality.PILE_UP)[0].any()
    assert product["beams"].to_numpy().tolist() == [9, 10, 0, 10, 10]
    assert has(product, MultiAngleQuality.EXTRAPOLATED).any()


def test_an_angle_to_one_side_has_a_systematic_error():
    one_sided, two_sided = (
        solve(*scan(4, zenith), method="kano_hamilton") for zenith in (ONE_SIDE, TWO_SIDED)
    )
    ratio = (
        one_sided["vertical_optical_depth_gradient_error"]
        / two_sided["vertical_optical_depth_gradient_error"]
    )
    assert float(ratio[:, 5:50].median()) > 100
    half = solve(*scan(4, ONE_SIDE), method="kano_hamilton", largest_gradient=2.5e-5)
    np.testing.assert_allclose(
        2.0 * half["vertical_optical_depth_gradient_error"],
        one_sided["vertical_optical_depth_gradient_error"],
    )


def test_a_beam_ends_at_an_obstruction_and_says_where():
    conditioned, pointing = scan(4, ONE_SIDE)
    free = solve(conditioned, pointing)
    assert np.isnan(free["beam_obstruction"]).all()
    # The lowest beam of the second cycle hits a mast, and has no light from there on.
    power = conditioned["power"].to_numpy()
    power[19, RANGE > 2000.0] = power[19, -200:].mean()
    power[19, (RANGE > 1990.0) & (RANGE < 2020.0)] *= 10.0
    blocked = solve(conditioned, pointing)
    found = blocked["beam_obstruction"].to_numpy()
    assert np.argwhere(np.isfinite(found)).tolist() == [[1, 9]]
    assert 1880.0 < found[1, 9] <= 2010.0
    height = 2000.0 * np.cos(np.radians(70.0))
    seen = np.isfinite(blocked["residual"].to_numpy()[1, 9])
    assert seen[height - 200.0 > ALTITUDE - STATION].all()
    assert not seen[height < ALTITUDE - STATION].any()
    off, plain = errors(blocked)
    assert np.nanmax(np.abs(off[1])[plain[1]]) < 4.0


def test_a_plume_in_one_plane_of_a_volume_does_not_widen_the_errors_of_another():
    conditioned, pointing = scan(8, np.concatenate([ONE_SIDE[1:], -ONE_SIDE[1:]]))
    pointing["azimuth"] = np.tile(np.repeat([20.0, 80.0], 9), 8)
    plume = np.exp(np.random.default_rng(9).normal(0.0, 0.2, conditioned["power"].shape))
    plume[pointing["azimuth"] == 20.0] = 1.0
    calm = solve(conditioned, pointing)
    rough = solve(conditioned.assign(power=conditioned["power"] * plume), pointing)
    np.testing.assert_allclose(calm["plane_azimuth"], [20.0, 80.0])
    ratio = (
        (
            rough["plane_vertical_optical_depth_standard_error"]
            / calm["plane_vertical_optical_depth_standard_error"]
        )
        .isel(altitude=slice(5, 30))
        .median(("time", "altitude"))
    )
    assert ratio[0] == pytest.approx(1.0, abs=0.1)
    assert ratio[1] > 3.0
    truth = optical_depth(ALTITUDE - STATION)
    off = (calm["plane_vertical_optical_depth"] - truth) / calm[
        "plane_vertical_optical_depth_standard_error"
    ]
    assert np.sqrt((off**2).mean()) < 1.3


@pytest.mark.parametrize("scatter", [0.0, 2e-5, 1e-4])
def test_the_gradient_error_of_planes_to_all_sides_is_that_of_their_scatter(scatter):
    """The declared gradient of 5 % per km would make it too large or too small."""
    azimuths, cycles = np.arange(20.0, 360.0, 72.0), 4
    zenith = np.tile(ONE_SIDE[1:], azimuths.size)
    conditioned, pointing = scan(cycles, zenith)
    pointing["azimuth"] = np.tile(np.repeat(azimuths, 9), cycles)
    rng = np.random.default_rng(3)
    east, north = rng.normal(0.0, scatter, (2, cycles)).repeat(zenith.size, axis=1)
    bearing = np.radians(pointing["azimuth"])
    gradient = east * np.sin(bearing) + north * np.cos(bearing)
    away = RANGE * np.sin(np.radians(np.tile(zenith, cycles)))[:, np.newaxis]
    sky = conditioned["power"].to_numpy()[:, -500:].mean(axis=1)[:, np.newaxis]
    light = (conditioned["power"] - sky) * np.exp(gradient[:, np.newaxis] * away) + sky
    product = solve(conditioned.assign(power=light), pointing)
    depth = product["plane_vertical_optical_depth"]
    noise, systematic = (
        product[f"plane_vertical_optical_depth_{of}_error"] for of in ("standard", "gradient")
    )
    assert depth.sizes["plane"] == 5
    total = np.hypot(noise, systematic)
    weights = 1.0 / total.where(depth.notnull()) ** 2
    share = weights / weights.sum("plane")
    off = (depth - (share * depth).sum("plane")) / (total * np.sqrt(1.0 - share))
    if scatter > 0.0:
        assert 0.85 < np.sqrt((off**2).mean()) < 1.2
    else:
        assert systematic.median() < 0.5 * noise.median()


def test_a_scan_in_one_plane_has_no_planes():
    for azimuth in (None, 20.0):
        conditioned, pointing = scan(2, ONE_SIDE)
        pointing["azimuth"] = None if azimuth is None else pointing["azimuth"]
        assert "plane" not in solve(conditioned, pointing).dims


def test_beams_along_the_horizon_and_unknown_ones_are_left_out():
    zenith = np.concatenate([ONE_SIDE, [87.5, 90.0, 95.0]])
    conditioned, pointing = scan(3, zenith)
    pointing["zenith_angle"][12] = 180.0
    pointing["zenith_angle"][5] = np.nan
    product = solve(conditioned, pointing)
    np.testing.assert_allclose(product["beam_zenith_angle"], ONE_SIDE)
    assert product["beams"].to_numpy().tolist() == [9, 10, 10]
    bounds = pointing["time_bnds"]
    assert product["time_bnds"].to_numpy()[0, 0] == bounds[0, 0]
    assert product["time_bnds"].to_numpy()[0, 1] == bounds[9, 1]


def test_profiles_of_one_visit_are_averaged_by_their_shots():
    conditioned, pointing = scan(8, np.repeat(ONE_SIDE, 2))
    pointing["shots"][::2] = 1
    pointing["shots"][1::2] = 10**6
    every = on_altitudes(conditioned, **(pointing | SETTINGS))
    last = on_altitudes(
        *take(conditioned, pointing, slice(1, None, 2))[:1],
        **(take(conditioned, pointing, slice(1, None, 2))[1] | SETTINGS),
    )
    assert every.sizes["time"] == 8
    np.testing.assert_array_equal(every["shots"], 10 * (10**6 + 1))
    np.testing.assert_allclose(
        every["signal"], last["signal"], atol=float(10 * np.sqrt(last["variance"].max())) * 1e-5
    )


def test_an_overlap_divides_the_signal():
    conditioned, pointing = scan(4)
    overlap = np.clip(RANGE / 800.0, 0.0, 1.0)
    unknown = np.where(RANGE < 400.0, np.nan, overlap)
    dimmed = conditioned.assign(
        power=(conditioned["power"] - 5.0) * overlap + 5.0,
        variance=conditioned["variance"] * overlap**2,
    )
    plain = on_altitudes(conditioned, **pointing, **SETTINGS)
    divided = on_altitudes(dimmed, **pointing, **SETTINGS, overlap=unknown)
    above = ALTITUDE - STATION > 900.0
    np.testing.assert_allclose(
        divided["signal"][..., above], plain["signal"][..., above], rtol=1e-9
    )
    assert_explained(solve(dimmed, pointing, method="kano_hamilton", overlap=unknown))
    with_hole = solve(dimmed, pointing, overlap=np.where(RANGE < 1500, np.nan, overlap))
    first = np.isnan(with_hole["residual"].to_numpy()[:, 5]).sum(axis=1)
    assert np.all(first >= np.count_nonzero(ALTITUDE - STATION < 1450))


# Values do not depend on chunks


@pytest.mark.parametrize("step", [1, 2, 100])
def test_any_chunks_of_cycles_give_the_same_bits(step):
    conditioned, pointing = scan(40)
    whole = on_altitudes(conditioned, **(pointing | SETTINGS))
    cycles = altitude_cycles(RANGE, **(pointing | SETTINGS))
    ends = cycles.ends()
    assert ends.size > 3
    edges = [0, *ends[::step], conditioned.sizes["time"]]
    for first, past in itertools.pairwise(edges):
        cycles.add(conditioned.isel(time=slice(first, past)), first)
    xr.testing.assert_identical(cycles.result(), whole)


def test_bins_beyond_the_highest_altitude_and_piece_sizes_do_not_matter(monkeypatch):
    conditioned, pointing = scan(12)
    cut = solve(conditioned, pointing, **FAR)
    monkeypatch.setattr(labeled_altitudes, "_BESIDE", 10**6)
    monkeypatch.setattr(labeled_altitudes, "BATCH", 1)
    xr.testing.assert_identical(cut, solve(conditioned, pointing, **FAR))


# Refusals


@each(
    ("change", "field"),
    [
        ({"background_range": (20e3, 30e3)}, "background"),
        ({"molecules": AIR}, "wavelength"),
        ({"altitude_grid": ALTITUDE - 1000.0}, "altitude"),
        ({"altitude_grid": ALTITUDE[:1]}, "altitude_grid"),
        ({"method": "none"}, "method"),
        ({"zenith_angle": np.full(30, 90.0)}, "zenith_angle"),
        ({"zenith_angle": np.full(30, np.nan)}, "zenith_angle"),
        ({"zenith_angle": np.full(30, -30.0), "azimuth": None}, "zenith_angle"),
        ({"largest_gradient": -1.0}, "largest_gradient"),
        ({"layers": [(STATION, 1e5)]}, "layers"),
        ({"layers": [(1000.0, 500.0)]}, "layers"),
    ],
)
def test_invalid_arguments_are_refused(change, field):
    with pytest.raises(RetrievalInputError) as caught:
        solve(*scan(3), **change)
    assert caught.value.field == field


def test_all_is_uncertain_if_the_signal_left_in_the_tail_is_unknown():
    conditioned, pointing = scan(3)
    # The signal before the tail is hidden.
    before = (conditioned["range"] > 5000.0) & (conditioned["range"] < 16000.0)
    hidden = conditioned.assign(
        quality=conditioned["quality"] | before.astype(np.int32) * np.int32(Quality.SATURATED)
    )
    product = solve(hidden, pointing, method="kano_hamilton")
    stands = np.isfinite(product["vertical_optical_depth"].to_numpy())
    assert stands.any()
    assert has(product, Quality.BACKGROUND_UNCERTAIN)[stands].all()
    assert_explained(product)

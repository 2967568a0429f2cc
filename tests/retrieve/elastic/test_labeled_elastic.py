"""The elastic retrieval of mean profiles returns a simulated truth within its errors."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import xarray as xr

from lidarops.constants import HIGHEST_CLOUD
from lidarops.errors import RetrievalInputError
from lidarops.flags import WITHHELD, Quality
from lidarops.products.elastic.variables import FLAGS
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.air.reference_window import Rejection
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.elastic.labeled import Reference, constant_ratio, invert_elastic
from lidarops.retrieve.signal.counts_to_signal import difference_variance, photon_signal

GREEN = 532e-9
AIR = MolecularProfile.us_standard()
LIDAR_RATIO = 50.0
STATION = 100.0
"""m above sea."""
BRIGHT = 3e12
SKY = 0.5
"""MHz."""
EXPOSURE = 9000.0
"""Counts per MHz: 10 minutes at 30 Hz and 7.5 m."""
BITS = {bit: np.int32(bit) for bit in FLAGS}
distance = 7.5 * (np.arange(1600) + 0.5)


def particles(altitude):
    """Backscatter of a mixed layer with a soft top and of a layer aloft; clean from 4 km on."""
    z = np.asarray(altitude, dtype=float)
    mixed = 2e-6 / (1.0 + np.exp(np.clip((z - 1500.0) / 120.0, -50.0, 50.0)))
    return mixed + 4e-7 * np.exp(-0.5 * ((z - 2800.0) / 300.0) ** 2)


def light(r, *, zenith=0.0, backscatter=particles, ratio=LIDAR_RATIO, constant=BRIGHT, air=AIR):
    """Return the power in MHz without sky; optical depth by Gauss quadrature from bin to bin."""
    climb = np.cos(np.deg2rad(zenith))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    edges = np.concatenate([np.linspace(0.0, r[0], 20), r[1:]])
    half = np.diff(edges)[:, np.newaxis] / 2.0
    z = STATION + climb * (edges[:-1, np.newaxis] + half * (1.0 + nodes))
    of_particles = ratio(z)[0] if callable(ratio) else ratio
    extinction = of_particles * backscatter(z) + air.extinction(z, GREEN)
    depth = np.cumsum(np.sum(extinction * weights * half, axis=-1))[18:]
    z = STATION + climb * r
    total = backscatter(z) + air.backscatter(z, GREEN)
    return constant * total * np.exp(-2.0 * depth) / r**2


def averages(power, variance, r=distance, *, zenith=0.0, quality=None):
    power = np.atleast_2d(power)
    count = len(power)
    bits = np.zeros(power.shape, np.int32) if quality is None else quality.astype(np.int32)
    time = np.datetime64("2026-03-01", "ns") + np.arange(count) * np.timedelta64(600, "s")
    dims = ("time", "range")
    return xr.Dataset(
        {
            "power": (dims, power, {"units": "MHz"}),
            "variance": (dims, np.broadcast_to(variance, power.shape).copy()),
            "quality": (dims, bits),
            "profiles": ("time", np.full(count, 10, np.int32)),
            "shots": ("time", np.full(count, 18_000, np.int32)),
        },
        coords={"time": time, "range": ("range", r, {"units": "m"}), "zenith_angle": zenith},
    )


def counted(signal, draws=1, *, seed=0, r=distance, exposure=EXPOSURE, **changes):
    """Return averages with a sky background and Poisson noise."""
    rng = np.random.default_rng(seed)
    rate = signal + SKY
    power = rng.poisson(np.broadcast_to(rate * exposure, (draws, rate.size))) / exposure
    return averages(power, rate / exposure, r, **changes)


def solved(data, **changes):
    settings = {
        "molecules": AIR,
        "wavelength": GREEN,
        "station_altitude": STATION,
        "lidar_ratio": constant_ratio(LIDAR_RATIO, 0.0),
        "molecular_relative_error": 0.0,
        "reference": Reference(5000.0, 11_000.0, 1000.0, 1.0, 0.0),
        "overlap_is_stated": True,
    }
    return invert_elastic(data, **(settings | changes))


def noiseless(signal, r=distance, **changes):
    return averages(signal + SKY, 1e-8 * (signal + SKY) / EXPOSURE, r, **changes)


def has(retrieved, bit):
    return (retrieved["quality_flag"].to_numpy() & BITS[bit]) != 0


def between(low, high, r=distance):
    return (r > low) & (r < high)


@cache
def truth():
    return light(distance)


@cache
def many():
    """The solution of 200 noisy profiles of one truth."""
    return solved(counted(truth(), 200))


# The truth comes back -------------------------------------------------------------------------


def test_noise_free_profiles_give_the_truth():
    retrieved = solved(noiseless(truth()))
    inside = between(200.0, 4500.0)
    true = particles(STATION + distance)
    np.testing.assert_allclose(
        retrieved["aerosol_backscatter"].to_numpy()[0, inside], true[inside], atol=2e-3 * true.max()
    )
    assert float(retrieved["background"][0]) == pytest.approx(SKY, abs=1e-6)
    assert not retrieved["quality_flag"].to_numpy()[0, inside].any()
    air = AIR.backscatter(STATION + distance, GREEN)
    np.testing.assert_allclose(retrieved["molecular_backscatter"], air, rtol=1e-12)
    np.testing.assert_allclose(
        retrieved["molecular_extinction"], AIR.extinction(STATION + distance, GREEN), rtol=1e-12
    )
    np.testing.assert_allclose(
        retrieved["attenuated_backscatter"].to_numpy()[0, inside],
        (truth() * distance**2 / BRIGHT)[inside],
        rtol=5e-3,
    )


@pytest.mark.parametrize(
    ("name", "true"),
    [
        ("aerosol_backscatter", particles),
        ("aerosol_extinction", lambda z: LIDAR_RATIO * particles(z)),
        ("scattering_ratio", lambda z: 1.0 + particles(z) / AIR.backscatter(z, GREEN)),
    ],
)
@pytest.mark.parametrize("edges", [(300, 1000), (1000, 2000), (2000, 4000), (4000, 6000)])
def test_noisy_profiles_scatter_as_stated(name, true, edges):
    retrieved = many()
    score = (retrieved[name] - true(STATION + distance)) / retrieved[f"{name}_standard_error"]
    score = score.where(retrieved["quality_flag"] == 0).to_numpy()[:, between(*edges)]
    assert np.isfinite(score).mean() > 0.95
    # Errors allow for particles in the reference window, of which this truth has none.
    assert 0.5 < np.sqrt(np.nanmean(score**2)) < 1.15
    assert abs(np.nanmean(score)) < 0.25


def from_noise(retrieved):
    """Deviation of the backscatter from the truth in standard errors of noise and background."""
    error = np.hypot(
        retrieved["aerosol_backscatter_error_noise"],
        retrieved["aerosol_backscatter_error_background"],
    )
    score = (retrieved["aerosol_backscatter"] - particles(STATION + distance)) / error
    return score.where(retrieved["quality_flag"] == 0).to_numpy()


def test_the_error_of_the_background_moves_the_far_range():
    retrieved = many()
    at = int(np.searchsorted(distance, 10_000.0))
    error = (
        retrieved["aerosol_backscatter_error_background"][:, at]
        / retrieved["molecular_backscatter"][at]
    )
    expected = retrieved["background_standard_error"] / truth()[at]
    # Minus its effect on the calibration, where the signal is five times as large.
    assert float(np.abs(error / expected).median()) == pytest.approx(0.8, abs=0.15)


def test_the_reference_error_covers_particles_hidden_by_noise():
    error = np.abs(many()["aerosol_backscatter_error_reference"].to_numpy())[:, between(300, 1000)]
    assert (error > 0).all()


@pytest.mark.parametrize("edges", [(300, 1000), (1000, 2000), (2000, 4000), (4000, 6000)])
def test_noise_and_background_make_the_scatter(edges):
    score = from_noise(many())[:, between(*edges)]
    # Near the lidar all bins of a profile share the noise of the reference: 200 values.
    assert 0.8 < np.sqrt(np.nanmean(score**2)) < 1.3
    assert abs(np.nanmean(score)) < 0.25


def test_the_background_scatters_as_stated():
    retrieved = many()
    score = (retrieved["background"] - SKY) / retrieved["background_standard_error"]
    assert abs(float(score.mean())) < 0.35
    assert 0.8 < float(score.std()) < 1.25


def test_derived_quantities_follow_from_the_backscatter():
    retrieved = many().isel(time=slice(5)).where(lambda f: f["quality_flag"] == 0)
    np.testing.assert_allclose(
        retrieved["aerosol_extinction"], LIDAR_RATIO * retrieved["aerosol_backscatter"], rtol=1e-12
    )
    np.testing.assert_allclose(
        retrieved["scattering_ratio"],
        1.0 + retrieved["aerosol_backscatter"] / retrieved["molecular_backscatter"],
        rtol=1e-12,
    )
    causes = ("noise", "background", "reference", "lidar_ratio", "molecular", "dead_time")
    squares = sum(retrieved[f"aerosol_backscatter_error_{cause}"] ** 2 for cause in causes)
    np.testing.assert_allclose(
        retrieved["aerosol_backscatter_standard_error"], np.sqrt(squares), rtol=1e-12
    )


def test_each_error_of_the_budget_is_the_effect_of_its_cause():
    """One cause off by one standard error moves the backscatter by the stated error."""
    signal, inside = noiseless(truth()), between(300.0, 2000.0)
    # One standard error of the dead time, 0.1 ns, changes a rate by its square times that.
    signal["power"].attrs["dead_time_standard_error"] = 1e-10
    longer = signal.assign(power=signal["power"] + 1e-4 * signal["power"] ** 2)
    stated = solved(
        signal,
        lidar_ratio=constant_ratio(LIDAR_RATIO, 1.0),
        molecular_relative_error=0.005,
        reference=Reference(5000.0, 11_000.0, 1000.0, 1.0, 0.01),
    )
    denser = MolecularProfile(AIR.altitude, 1.005 * AIR.pressure, AIR.temperature)
    changed = {
        "lidar_ratio": solved(signal, lidar_ratio=constant_ratio(LIDAR_RATIO + 1.0, 0.0)),
        "molecular": solved(signal, molecules=denser),
        "reference": solved(signal, reference=Reference(5000.0, 11_000.0, 1000.0, 1.01, 0.0)),
        "dead_time": solved(longer),
    }
    for cause, other in changed.items():
        moved = (other["aerosol_backscatter"] - stated["aerosol_backscatter"]).to_numpy()[0, inside]
        error = stated[f"aerosol_backscatter_error_{cause}"].to_numpy()[0, inside]
        np.testing.assert_allclose(moved, error, rtol=0.06, atol=2e-10, err_msg=cause)


def test_a_slant_beam_gives_the_profile_of_a_vertical_one():
    climb = np.cos(np.deg2rad(30.0))
    slanted = distance / climb
    vertical = solved(noiseless(truth()))
    window = Reference(5000.0 / climb, 11_000.0 / climb, 1000.0 / climb, 1.0, 0.0)
    tilted = solved(noiseless(light(slanted, zenith=30.0), slanted, zenith=30.0), reference=window)
    inside = between(200.0, 4500.0)
    np.testing.assert_allclose(
        tilted["aerosol_backscatter"].to_numpy()[0, inside],
        vertical["aerosol_backscatter"].to_numpy()[0, inside],
        atol=5e-9,
    )
    np.testing.assert_allclose(
        tilted["molecular_backscatter"], vertical["molecular_backscatter"], rtol=1e-12
    )


def test_a_profile_does_not_depend_on_its_neighbours():
    data = counted(truth(), 4, seed=3)
    together = solved(data)
    for k in range(4):
        xr.testing.assert_identical(solved(data.isel(time=[k])), together.isel(time=[k]))


# Quality flags ---------------------------------------------------------------------------------


def cloud(height, strength, width=60.0):
    def backscatter(z):
        return particles(z) + strength * np.exp(-0.5 * ((z - height) / width) ** 2)

    return backscatter


@pytest.mark.parametrize(("zenith", "highest", "end"), [(0.0, 11e3, 19.9e3), (60.0, 11e3, 39.8e3),
                                                        (0.0, 25e3, 25e3)])  # fmt: skip
def test_a_long_record_is_cut_above_all_clouds_and_references(zenith, highest, end):
    """In 84 km of noise, a cloud is found by chance."""
    far = 7.5 * (np.arange(11_000) + 0.5)
    reference = Reference(5000.0, highest, 1000.0, 1.0, 0.0)
    data = counted(light(far, zenith=zenith), 5, r=far, zenith=zenith)
    solution = solved(data, reference=reference)
    assert abs(float(solution["range"][-1]) - end) < 7.5
    assert not (solution["cloud_top_altitude"] > HIGHEST_CLOUD).any()


def test_a_cloud_below_the_reference_is_flagged_with_all_bins_below_it():
    signal = light(distance, backscatter=cloud(3500.0 + STATION, 2e-5))
    retrieved = solved(counted(signal, 20, exposure=100 * EXPOSURE))
    base = retrieved["cloud_base_range"].to_numpy()
    assert np.all((base > 3250.0) & (base < 3500.0))
    bottom = retrieved["reference_bottom"].to_numpy()
    assert np.all(bottom >= 5000.0)
    flagged = has(retrieved, ElasticQuality.CLOUD)
    # The inversion starts above: values below the cloud depend on its lidar ratio.
    assert flagged[:, distance < 3550.0].all()
    assert not flagged[:, between(5000.0, 9000.0)].any()


def test_a_cloud_above_the_reference_flags_the_bins_beyond_it():
    signal = light(distance, backscatter=cloud(8000.0 + STATION, 2e-5))
    window = Reference(5000.0, 7500.0, 1000.0, 1.0, 0.0)
    retrieved = solved(counted(signal, 10, exposure=100 * EXPOSURE), reference=window)
    flagged = has(retrieved, ElasticQuality.CLOUD)
    assert np.all(np.isfinite(retrieved["reference_bottom"]))
    assert flagged[:, distance > 8100.0].all()
    assert not flagged[:, distance < 7400.0].any()
    inside = between(300.0, 2000.0)
    true = particles(STATION + distance)[inside]
    deviation = (retrieved["aerosol_backscatter"].to_numpy()[:, inside] - true).mean(axis=0)
    assert np.abs(deviation).max() < 0.05 * true.max()


def test_values_beyond_either_of_two_clouds_are_flagged():
    def both(z):
        upper = cloud(9000.0 + STATION, 2e-5)(z) - particles(z)
        return cloud(3500.0 + STATION, 1e-5)(z) + upper

    window = Reference(5000.0, 8200.0, 1000.0, 1.0, 0.0)
    retrieved = solved(counted(light(distance, backscatter=both), 5), reference=window)
    assert np.all(retrieved["cloud_base_range"] < 3600.0)
    assert np.all(np.isfinite(retrieved["reference_bottom"]))
    flagged = has(retrieved, ElasticQuality.CLOUD)
    assert flagged[:, distance < 3550.0].all()
    assert not flagged[:, between(5000.0, 8200.0)].any()
    assert flagged[:, distance > 9100.0].all()


def test_a_profile_with_cirrus_is_retrieved():
    """The background is fitted beyond the cloud."""
    signal = light(distance, backscatter=cloud(9000.0 + STATION, 2e-5))
    window = Reference(5000.0, 8200.0, 1000.0, 1.0, 0.0)
    retrieved = solved(counted(signal, 20, exposure=100 * EXPOSURE), reference=window)
    assert np.isfinite(retrieved["reference_bottom"]).all()
    score = (retrieved["background"] - SKY) / retrieved["background_standard_error"]
    assert float(np.abs(score).max()) < 4.0
    assert np.sqrt(np.nanmean(from_noise(retrieved)[:, between(300.0, 2000.0)] ** 2)) < 2.0


def test_a_profile_beside_a_cloudy_one_is_retrieved_as_alone():
    signals = [light(distance), light(distance, backscatter=cloud(9000.0 + STATION, 2e-5))]
    window = Reference(5000.0, 8200.0, 1000.0, 1.0, 0.0)
    data = [counted(signal, exposure=100 * EXPOSURE) for signal in signals]
    both = xr.concat(data, dim="time", data_vars="minimal", coords="minimal")
    together = solved(both, reference=window)
    for place, alone in enumerate(solved(each, reference=window) for each in data):
        for name in ("background", "aerosol_backscatter", "quality_flag"):
            np.testing.assert_array_equal(
                together[name].isel(time=[place]).to_numpy(), alone[name].to_numpy()
            )


@pytest.mark.parametrize(("wavelength", "factor"), [(GREEN, 2.6), (355e-9, 1.5)])
def test_aerosol_whose_scattering_rises_less_than_that_of_a_cloud_is_none(wavelength, factor):
    """The limits are 3 at 532 nm and 1.6 at 355 nm, where air scatters more."""
    z = STATION + distance
    ratio = 1.0 + (factor - 1.0) * np.exp(-(np.abs((distance - 8000.0) / 400.0) ** 9))
    depth = 7.5 * np.cumsum(AIR.extinction(z, wavelength))
    signal = 1e18 * ratio * AIR.backscatter(z, wavelength) * np.exp(-2.0 * depth) / distance**2
    signal *= light(distance)[100] / signal[100]
    for rise, cloudy in ((1.0, False), (1.6, True)):
        layer = np.where(ratio > 1.0 + 0.5 * (factor - 1.0), rise, 1.0)
        data = counted(signal * layer, exposure=1e4 * EXPOSURE)
        found = solved(data, wavelength=wavelength, reference=Reference(4e3, 7e3, 1e3, 1.0, 0.0))
        assert bool(np.isfinite(found["cloud_base_range"]).all()) is cloudy


def test_correlated_noise_is_stated():
    """Neighbouring bins of analog signals are correlated, and their differences too small."""
    rng = np.random.default_rng(3)
    white = rng.standard_normal((150, distance.size + 1))
    sigma = 2e-3 * light(distance)[300]
    noise = sigma * (white[:, 1:] + 0.5 * white[:, :-1]) / np.sqrt(1.25)
    power = light(distance) + SKY + noise
    retrieved = solved(averages(power, difference_variance(noise, distance)))
    assert not np.isfinite(retrieved["cloud_base_range"]).any()
    background = (retrieved["background"] - SKY) / retrieved["background_standard_error"]
    assert 0.8 < float(np.sqrt((background**2).mean())) < 1.15
    score = from_noise(retrieved)[:, between(1000.0, 3000.0)]
    assert 0.85 < np.sqrt(np.nanmean(score**2)) < 1.15


def test_the_background_of_few_photons_is_within_its_error():
    """At night: 1000 counts at 1 km, one in a hundred bins of the sky."""
    rng = np.random.default_rng(7)
    r = 7.5 * (np.arange(4000) + 0.5)
    signal, shots = light(r), np.full(100, 18_000)
    expected = np.where(r < 250.0, 0.0, 1000.0 * signal / signal[133] + 0.01)
    scores = []
    for _ in range(4):
        counts = rng.poisson(expected, (100, r.size)).astype(np.int32)
        found = photon_signal(counts, shots, r, bin_width=7.5, dead_time=0.0)
        data = averages(found.power, found.variance, r)
        data["power"].attrs["dead_time_standard_error"] = 0.0
        retrieved = solved(data)
        deviation = retrieved["background"] - 0.01 / (18_000 * 0.05)
        scores.append(deviation / retrieved["background_standard_error"])
    score = np.concatenate(scores)
    # None of 400: 95 of 100 times, a rate of 0.75 % would show. The mean has an error of 0.05.
    assert not np.any(np.abs(score) > 4.0)
    assert abs(score.mean()) < 0.2


def test_a_lidar_ratio_that_changes_with_altitude():
    """Of a mixed layer, and of a layer aloft."""

    def ratio(z):
        above = 1.0 / (1.0 + np.exp(np.clip((2200.0 - z) / 60.0, -50.0, 50.0)))
        return 30.0 + 40.0 * above, np.full(np.shape(z), 1.0)

    signal = noiseless(light(distance, ratio=ratio))
    inside = between(300.0, 4000.0)
    true = particles(STATION + distance)[inside]

    def worst(given):
        found = solved(signal, lidar_ratio=given)
        return np.abs(
            found["aerosol_backscatter"].to_numpy()[0, inside] - true
        ).max() / true.max(), found

    deviation, found = worst(ratio)
    assert deviation < 2e-3
    np.testing.assert_allclose(
        found["aerosol_extinction"].to_numpy()[0, inside],
        (ratio(STATION + distance)[0][inside] * true),
        atol=3e-3 * 70.0 * true.max(),
    )
    assert worst(constant_ratio(50.0, 1.0))[0] > 0.02


def test_the_reasons_of_rejected_windows_are_given():
    def haze(z):
        return particles(z) + 5e-7 * np.exp(-np.maximum(z - 4000.0, 0.0) / 900.0)

    dusk = light(distance) * np.where(distance > 4500.0, 0.0, 1.0)
    reasons = {}
    for name, signal in (
        ("clean", light(distance)),
        ("haze", light(distance, backscatter=haze)),
        ("cloud", light(distance, backscatter=cloud(8000.0 + STATION, 2e-5))),
        ("dark", dusk),
    ):
        retrieved = solved(counted(signal, 3, exposure=30 * EXPOSURE))
        found = np.bitwise_or.reduce(retrieved["reference_rejections"].to_numpy())
        reasons[name] = Rejection(int(found))
    assert Rejection.MORE_PARTICLES not in reasons["clean"]
    assert Rejection.MORE_PARTICLES in reasons["haze"]
    assert Rejection.EXCLUDED in reasons["cloud"]
    assert Rejection.LOW_SIGNAL in reasons["dark"]


def test_no_reference_window_holds_a_cloud():
    """Two clouds in the search range leave gaps between them."""

    def broken(z):
        return particles(z) + 2e-5 * sum(
            np.exp(-0.5 * ((z - STATION - height) / 40.0) ** 2) for height in (5400.0, 7000.0)
        )

    signal = light(distance, backscatter=broken)
    retrieved = solved(counted(signal, 10, exposure=300 * EXPOSURE))
    bottom, top = (retrieved[f"reference_{end}"].to_numpy() for end in ("bottom", "top"))
    chosen = np.isfinite(bottom)
    assert chosen.any()
    for height in (5400.0, 7000.0):
        assert not np.any((bottom < height) & (top > height))


def not_full():
    """Return an overlap that nothing corrects, and that rises less than a cloud does."""
    return 1.0 - 0.85 * np.exp(-((distance / 1500.0) ** 2))


def test_an_overlap_that_is_not_full_where_stated_is_found_by_negative_backscatter():
    retrieved = solved(counted(truth() * not_full(), 20))
    calibrated = np.isfinite(retrieved["reference_bottom"].to_numpy())
    assert calibrated.sum() > 5
    retrieved = retrieved.isel(time=calibrated)
    negative = has(retrieved, ElasticQuality.NEGATIVE_BACKSCATTER)
    value, error = (
        retrieved[f"aerosol_backscatter{end}"].to_numpy() for end in ("", "_standard_error")
    )
    assert negative[:, between(100.0, 500.0)].all()
    # Everything nearer is flagged, and nothing is as low that is not.
    assert not (np.diff(negative.astype(int), axis=1) > 0).any()
    runs = np.lib.stride_tricks.sliding_window_view(value < -4.0 * error, 4, axis=1).all(axis=2)
    assert not (runs & ~negative[:, 3:]).any()


UNKNOWN = 3
"""State of the cloud mask."""
FULL = 1000.0
OVERLAPS = {
    "sine": np.sin(0.5 * np.pi * np.clip(distance / FULL, 0.0, 1.0)) ** 2,
    "linear": np.clip(distance / FULL, 0.0, 1.0),
    "late": np.clip((distance - 0.4 * FULL) / (0.6 * FULL), 0.0, 1.0),
}


@pytest.mark.parametrize("name", OVERLAPS)
def test_an_overlap_that_is_not_stated_is_no_cloud(name):
    overlap = OVERLAPS[name]
    data = counted(truth() * overlap, 10, exposure=30 * EXPOSURE)
    retrieved = solved(data, overlap_is_stated=False)
    assert not has(retrieved, ElasticQuality.CLOUD).any()
    assert np.isnan(retrieved["cloud_base_range"]).all()
    assert has(retrieved, Quality.INCOMPLETE_OVERLAP)[:, overlap < 0.98].all()
    assert not has(retrieved, Quality.INCOMPLETE_OVERLAP)[:, distance > 1.1 * FULL].any()
    # The signal cannot show where the overlap becomes full: nearer than the reference, no value
    # is without a flag.
    nearer = distance < float(retrieved["reference_bottom"].min())
    assert has(retrieved, ElasticQuality.UNKNOWN_OVERLAP)[:, nearer & (distance > 1.1 * FULL)].all()
    assert not (retrieved["quality_flag"].to_numpy()[:, nearer] == 0).any()
    # Where it is full, values hold their errors.
    score = (retrieved["aerosol_backscatter"] - particles(STATION + distance)).to_numpy()
    score /= np.hypot(
        retrieved["aerosol_backscatter_error_noise"],
        retrieved["aerosol_backscatter_error_background"],
    )
    assert np.sqrt(np.mean(score[:, between(1.1 * FULL, 4500.0)] ** 2)) < 1.3


def test_an_overlap_below_dense_aerosol_is_no_cloud():
    """The signal falls back to its level near the lidar before the reference window."""

    def dense(z):
        return 3.0 * particles(z)

    signal = light(distance, backscatter=dense) * np.clip(0.02 + distance / FULL, 0.0, 1.0)
    data = counted(signal, 10, exposure=30 * EXPOSURE)
    retrieved = solved(data, overlap_is_stated=False)
    assert not has(retrieved, ElasticQuality.CLOUD).any()
    assert has(retrieved, Quality.INCOMPLETE_OVERLAP)[:, distance < 400.0].all()
    assert has(retrieved, ElasticQuality.UNKNOWN_OVERLAP)[:, between(1100.0, 4900.0)].all()


def test_a_cloud_over_an_overlap_that_is_not_stated_is_found():
    signal = light(distance, backscatter=cloud(8000.0 + STATION, 2e-5)) * OVERLAPS["late"]
    window = Reference(5000.0, 7500.0, 1000.0, 1.0, 0.0)
    retrieved = solved(counted(signal, 10, exposure=100 * EXPOSURE), reference=window)
    base = retrieved["cloud_base_range"].to_numpy()
    assert np.all((base > 7700.0) & (base < 8000.0))
    assert not has(retrieved, ElasticQuality.CLOUD)[:, distance < 7400.0].any()


@pytest.mark.parametrize("full", [150.0, 300.0, 1000.0])
def test_a_low_cloud_over_an_overlap_that_is_not_stated_is_found(full):
    """Beyond the cloud, the signal is less than in front of it, but not less than in the window."""
    signal = light(distance, backscatter=cloud(2000.0 + STATION, 2e-5))
    signal = signal * np.clip(distance / full, 0.0, 1.0) ** 2
    retrieved = solved(counted(signal, 10, exposure=100 * EXPOSURE), overlap_is_stated=False)
    base = retrieved["cloud_base_range"].to_numpy()
    assert np.all((base > 1700.0) & (base < 2000.0))
    partial = has(retrieved, Quality.INCOMPLETE_OVERLAP)
    assert partial[:, distance < 0.8 * full].all()
    assert not partial[:, between(1.1 * full + 100.0, 5000.0)].any()


@pytest.mark.parametrize("exposure", [0.03, 0.3, 3.0])
def test_a_low_cloud_in_noise_is_no_overlap(exposure):
    signal = light(distance, backscatter=cloud(3500.0 + STATION, 2e-5))
    data = counted(signal, 300, exposure=exposure * EXPOSURE)
    retrieved = solved(data, overlap_is_stated=False)
    assert has(retrieved, ElasticQuality.CLOUD).any(axis=1).all()
    assert not has(retrieved, Quality.INCOMPLETE_OVERLAP).any()


def test_a_thick_cloud_across_the_search_range_is_no_overlap():
    def thick(z):
        return particles(z) + np.where((z > 4000.0) & (z < 6500.0), 8e-6, 0.0)

    signal = light(distance, backscatter=thick, ratio=20.0)
    retrieved = solved(counted(signal, 20, exposure=0.1 * EXPOSURE))
    assert np.isfinite(retrieved["cloud_base_range"]).all()
    assert not has(retrieved, ElasticQuality.UNKNOWN_OVERLAP).any()


def test_a_cloud_at_the_end_of_a_profile_is_no_overlap():
    """Air below it is clean; nothing beyond it shows its top."""
    near = distance < 8100.0
    signal = light(distance, backscatter=cloud(8000.0 + STATION, 2e-5, 200.0))[near]
    data = counted(signal, 10, r=distance[near], exposure=100 * EXPOSURE)
    retrieved = solved(data, reference=Reference(5000.0, 7300.0, 1000.0, 1.0, 0.0))
    assert has(retrieved, ElasticQuality.CLOUD)[:, distance[near] > 7950.0].all()
    assert not has(retrieved, Quality.INCOMPLETE_OVERLAP).any()


def test_noise_is_no_negative_backscatter():
    assert not has(many(), ElasticQuality.NEGATIVE_BACKSCATTER).any()


def test_a_rise_without_clean_air_beyond_is_no_cloud_unless_the_overlap_is_stated():
    signal = light(distance, backscatter=cloud(2500.0, 2e-3, 100.0))
    retrieved = solved(counted(signal, 10), overlap_is_stated=False)
    assert has(retrieved, ElasticQuality.NO_REFERENCE).all()
    doubtful = has(retrieved, ElasticQuality.UNKNOWN_OVERLAP)
    assert doubtful.any(axis=1).all()
    assert (retrieved["cloud_mask"].to_numpy()[doubtful] == UNKNOWN).all()
    assert not has(retrieved, ElasticQuality.CLOUD).any()
    assert np.isnan(retrieved["cloud_base_range"]).all()


def test_an_opaque_cloud_leaves_no_reference():
    signal = light(distance, backscatter=cloud(2500.0, 2e-3, 100.0))
    retrieved = solved(counted(signal, 10))
    assert has(retrieved, ElasticQuality.NO_REFERENCE).all()
    assert has(retrieved, ElasticQuality.CLOUD)[:, between(2500.0, 12_000.0)].all()
    assert np.isnan(retrieved["aerosol_backscatter"]).all()
    for end in ("reference_bottom", "reference_top"):
        assert np.isnan(retrieved[end]).all()


def test_aerosol_in_the_far_range_makes_the_background_uncertain():
    def aloft(z):
        return particles(z) + 3e-7 * np.exp(-0.5 * ((z - 9500.0) / 800.0) ** 2)

    retrieved = solved(counted(light(distance, backscatter=aloft), 10, exposure=300 * EXPOSURE))
    assert has(retrieved, Quality.BACKGROUND_UNCERTAIN).mean() > 0.9
    clean = solved(counted(truth(), 50, exposure=EXPOSURE, seed=9))
    assert has(clean, Quality.BACKGROUND_UNCERTAIN).mean() < 0.05


class TestTailMean:
    def test_the_signal_of_air_biases_the_background(self):
        data = counted(truth(), 50, seed=4)
        tail, shape = solved(data, known_shape=False), solved(data)
        signal_of_air = truth()[-160:].mean()
        excess = float(tail["background"].mean()) - SKY
        assert excess == pytest.approx(signal_of_air, rel=0.1)
        assert abs(float(shape["background"].mean()) - SKY) < 0.1 * signal_of_air

    def test_biased_values_are_flagged(self):
        retrieved = solved(counted(truth(), 100, seed=4), known_shape=False)
        score = (retrieved["aerosol_backscatter"] - particles(STATION + distance)) / retrieved[
            "aerosol_backscatter_standard_error"
        ]
        unflagged = score.where(retrieved["quality_flag"] == 0).to_numpy()[
            :, between(300.0, 2000.0)
        ]
        finite = unflagged[np.isfinite(unflagged)]
        assert finite.size == 0 or np.mean(np.abs(finite) < 3.0) > 0.9


class TestOverlap:
    at = np.where(distance < 150.0, np.nan, np.clip(distance / 800.0, 0.0, 1.0) ** 2)
    seen = np.where(np.isnan(at), 0.0, at)

    def test_dividing_by_the_overlap_removes_the_bias_of_the_near_range(self):
        data = noiseless(truth() * self.seen)
        corrected = solved(data, overlap=self.at)
        plain = solved(data)
        true, inside = particles(STATION + distance), between(160.0, 700.0)
        np.testing.assert_allclose(
            corrected["aerosol_backscatter"].to_numpy()[0, inside], true[inside], rtol=4e-3
        )
        bias = np.abs(plain["aerosol_backscatter"].to_numpy()[0, inside] / true[inside] - 1.0)
        assert not (bias < 0.1).any()

    def test_bins_without_overlap_are_flagged_and_withheld(self):
        retrieved = solved(noiseless(truth() * self.seen), overlap=self.at)
        near = distance < 150.0
        np.testing.assert_array_equal(has(retrieved, Quality.INCOMPLETE_OVERLAP)[0], near)
        assert np.isnan(retrieved["aerosol_backscatter"].to_numpy()[0, near]).all()

    def test_noise_grows_as_the_signal_is_divided(self):
        # The overlap is so small that the noise of a bin exceeds that of the reference.
        at = np.clip(distance / 800.0, 0.0, 1.0) ** 6
        retrieved = solved(counted(truth() * at, 200, seed=5), overlap=at)
        near = from_noise(retrieved)[:, between(180.0, 240.0)]
        assert 0.9 < np.sqrt(np.mean(near**2)) < 1.1

    def test_bins_at_negative_ranges_change_nothing(self):
        whole = noiseless(truth() * self.seen)
        longer = 7.5 * (np.arange(-8, 1600) + 0.5)
        power = np.concatenate([np.full(8, 1e3), whole["power"].to_numpy()[0]])
        variance = np.concatenate([np.ones(8), whole["variance"].to_numpy()[0]])
        at = np.concatenate([np.full(8, np.nan), self.at])
        retrieved = solved(averages(power, variance, longer), overlap=at)
        expected = solved(whole, overlap=self.at)
        np.testing.assert_array_equal(retrieved["range"], distance)
        np.testing.assert_array_equal(
            retrieved["aerosol_backscatter"], expected["aerosol_backscatter"]
        )


BINS = [
    "aerosol_backscatter",
    "aerosol_backscatter_standard_error",
    *(
        f"aerosol_backscatter_error_{c}"
        for c in ("noise", "background", "reference", "lidar_ratio")
    ),
    "aerosol_backscatter_error_molecular",
    "aerosol_extinction",
    "aerosol_extinction_standard_error",
    "scattering_ratio",
    "scattering_ratio_standard_error",
    "attenuated_backscatter",
    "attenuated_backscatter_standard_error",
]


def assert_missing_is_flagged(retrieved):
    flags = retrieved["quality_flag"].to_numpy()
    for name in BINS:
        values = retrieved[name].to_numpy()
        assert not np.isinf(values).any(), name
        assert (flags[np.isnan(values)] != 0).all(), name
    rejected = (flags & int(ElasticQuality.NO_REFERENCE | WITHHELD)) != 0
    assert np.isnan(retrieved["aerosol_backscatter"].to_numpy()[rejected]).all()
    assert not (flags & ~np.int32(sum(FLAGS))).any()


def messy(seed=0):
    """Return profiles with every kind of fault, each marked in ``quality``."""
    data = counted(truth(), 12, seed=seed)
    power, quality = data["power"].to_numpy(), data["quality"].to_numpy()

    def spoil(where, bit, value=np.nan):
        power[where] = value
        quality[where] |= BITS[bit]

    spoil((0, slice(None)), Quality.INPUT_MISSING)
    spoil((1, slice(0, 40)), Quality.SATURATED)
    quality[2, :60] |= BITS[Quality.PILE_UP] | BITS[Quality.SINGLE_RECORD]
    quality[3, :50] |= BITS[Quality.INCOMPLETE_OVERLAP]
    spoil((4, slice(None)), Quality.NO_GLUING)
    spoil((5, slice(300, 310)), Quality.INPUT_MISSING)
    spoil((6, slice(300, 340)), Quality.INPUT_MISSING)
    spoil((7, slice(1400, None)), Quality.INPUT_MISSING)
    power[8] = 0.0
    power[9] = SKY
    power[10] = -truth() + SKY
    quality[11] |= BITS[Quality.OUTLIER]
    return data


@pytest.mark.parametrize("known_shape", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_every_missing_value_carries_a_bit(known_shape, seed):
    retrieved = solved(messy(seed), known_shape=known_shape)
    assert_missing_is_flagged(retrieved)
    both = BITS[Quality.INPUT_MISSING] | BITS[ElasticQuality.NO_REFERENCE]
    assert ((retrieved["quality_flag"].to_numpy()[0] & both) == both).all()
    for k in (4, 8, 9, 10):
        assert has(retrieved, ElasticQuality.NO_REFERENCE)[k].all()
    # Bins withheld for another reason are not marked as unstable.
    assert has(retrieved, Quality.SATURATED)[1, :40].all()
    assert not has(retrieved, ElasticQuality.UNSTABLE_INVERSION)[1, :40].any()
    # The integration continues over a gap of 75 m, and ends at one of 300 m.
    assert np.isfinite(retrieved["aerosol_backscatter"][5, 100:290]).all()
    assert np.isnan(retrieved["aerosol_backscatter"][6, :300]).all()
    assert has(retrieved, ElasticQuality.UNSTABLE_INVERSION)[6, :300].all()
    # Without the last tenth of the bins, only the fit of a shape gives a background.
    assert np.isfinite(retrieved["aerosol_backscatter"][7, 100:1000]).all() == known_shape


def test_a_scene_of_missing_profiles_is_no_error():
    data = counted(truth(), 3)
    data["power"][:] = np.nan
    data["variance"][:] = np.nan
    data["quality"][:] = int(Quality.INPUT_MISSING)
    for known_shape in (True, False):
        retrieved = solved(data, known_shape=known_shape)
        assert_missing_is_flagged(retrieved)
        assert np.isnan(retrieved["aerosol_backscatter"]).all()
        assert np.isnan(retrieved["background"]).all()
        assert np.isnan(retrieved["cloud_base_range"]).all()


def test_every_bit_of_the_product_occurs():
    bits = np.bitwise_or.reduce(solved(messy())["quality_flag"].to_numpy(), axis=None)
    cloudy = light(distance, backscatter=cloud(3600.0, 2e-5))
    bits |= np.bitwise_or.reduce(
        solved(counted(cloudy, exposure=100 * EXPOSURE))["quality_flag"].to_numpy(), axis=None
    )
    far = light(distance, backscatter=cloud(9500.0, 3e-7, 800.0))
    bits |= np.bitwise_or.reduce(
        solved(counted(far, exposure=300 * EXPOSURE))["quality_flag"].to_numpy(), axis=None
    )
    outlying = counted(light(distance))
    outlying["power"][:, 300] *= 2.0
    overlapping = [counted(truth() * seen, 20) for seen in (not_full(), OVERLAPS["late"])]
    for data in (outlying, *overlapping):
        bits |= np.bitwise_or.reduce(solved(data)["quality_flag"].to_numpy(), axis=None)
    # The product step raises the first two of these, means of parts the third, and the counts of a
    # whole scene the last.
    others = (
        Quality.LOW_SIGNAL_TO_NOISE,
        ElasticQuality.STANDARD_AIR,
        ElasticQuality.PARTLY_CLOUDY,
        Quality.NO_SIGNAL,
    )
    raised_here = [bit for bit in FLAGS.bits if bit not in others]
    assert list(FLAGS.raised(int(bits))) == raised_here


def test_an_inversion_away_from_the_reference_stops_where_it_is_unstable():
    """Beyond a dense layer above the window the denominator vanishes."""
    signal = light(distance, backscatter=cloud(6900.0, 3e-4, 80.0))
    window = Reference(5000.0, 6500.0, 1000.0, 1.0, 0.0)
    retrieved = solved(counted(signal, 5, exposure=100 * EXPOSURE), reference=window)
    assert np.isfinite(retrieved["reference_bottom"]).all()
    assert has(retrieved, ElasticQuality.UNSTABLE_INVERSION)[:, distance > 7100.0].all()
    assert has(retrieved, ElasticQuality.CLOUD)[:, distance > 7100.0].all()
    assert_missing_is_flagged(retrieved)


def test_bins_beyond_the_atmosphere_are_left_out():
    r = 7.5 * (np.arange(16_380) + 0.5)
    retrieved = solved(noiseless(light(r), r), reference=Reference(5e3, 9e4, 1e3, 1.0, 0.0))
    assert float(retrieved["range"][-1]) < 84_000.0 < float(retrieved["range"][-1]) + STATION + 7.5
    assert_missing_is_flagged(retrieved)


@pytest.mark.parametrize("fraction", [0.0, 0.999])
def test_the_farthest_window_may_end_with_the_last_bin(fraction):
    """The window ends with the last bin or less than one metre beyond."""
    last = float(distance[-1])
    window = Reference(last - 1000.0 - fraction, last, 1000.0, 1.0, 0.0)
    retrieved = solved(counted(truth(), 2, exposure=1e3 * EXPOSURE), reference=window)
    assert retrieved.sizes["time"] == 2


def test_a_wavelength_without_air_is_refused_by_name():
    with pytest.raises(RetrievalInputError, match="wavelength"):
        solved(counted(truth()), wavelength=5.32e-4)


def test_an_outlying_bin_is_bridged_and_flagged():
    """In the far range, which determines the background, in the window, and below it."""
    data = counted(light(distance), draws=8, seed=9)
    clean = solved(data)
    places = [300, 1000, 1500]
    deviation = np.sqrt(data["variance"].to_numpy())
    power = data["power"].to_numpy().copy()
    for at in places:
        power[:, at] += 1000.0 * deviation[:, at]
    bridged = solved(data.assign(power=(data["power"].dims, power)))
    flagged = (bridged["quality_flag"].to_numpy() & BITS[Quality.OUTLIER]) != 0
    assert flagged[:, places].all()
    assert flagged.sum() == 8 * len(places)
    assert not ((clean["quality_flag"].to_numpy() & BITS[Quality.OUTLIER]) != 0).any()
    for name in ("background", "reference_bottom"):
        error = clean["background_standard_error"].to_numpy()
        moved = np.abs(bridged[name].to_numpy() - clean[name].to_numpy())
        assert np.all(moved <= (2.0 * error if name == "background" else 0.0))
    solved_bins = np.isfinite(clean["aerosol_backscatter"].to_numpy())
    assert np.array_equal(np.isfinite(bridged["aerosol_backscatter"].to_numpy()), solved_bins)
    deviation = bridged["aerosol_backscatter"] - particles(STATION + distance)
    beyond_four_errors = (
        np.abs(deviation / bridged["aerosol_backscatter_standard_error"]).to_numpy()[solved_bins]
        > 4.0
    )
    assert beyond_four_errors.mean() < 1e-3


@pytest.mark.parametrize("known_shape", [True, False])
def test_a_background_of_bins_that_were_saturated_in_some_profiles_is_withheld(known_shape):
    far = distance > 4000.0
    saturated = np.where(far, np.int32(Quality.SATURATED), np.int32(0))
    # The mean of the profiles in which a bin was not saturated is too low.
    rate = truth() + SKY - np.where(far, 0.2, 0.0)
    data = averages(rate, rate / EXPOSURE, quality=saturated[np.newaxis])
    retrieved = solved(data, known_shape=known_shape)
    assert np.isnan(retrieved["background"].to_numpy()).all()
    for name in ("aerosol_backscatter", "attenuated_backscatter"):
        assert np.isnan(retrieved[name].to_numpy()).all()
    assert ((retrieved["quality_flag"].to_numpy() & FLAGS.rejecting) != 0).all()

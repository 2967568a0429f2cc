"""Clouds are detected where they are; aerosol and noise are not mistaken for them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal, stats
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.raw import licel
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.air.reference_window import (
    Rejection,
    candidate_windows,
    choose_reference,
)
from lidarops.retrieve.clouds.labeled import with_margin
from lidarops.retrieve.clouds.layers import find_layers, find_visible_air
from lidarops.retrieve.clouds.thresholds import THRESHOLDS
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.averaging import cloud_contrast

AIR = MolecularProfile.us_standard()
RANGE = 15.0 * (np.arange(900) + 0.5)[20:]
BACKSCATTER = AIR.backscatter(RANGE, 532e-9)
EXTINCTION = AIR.extinction(RANGE, 532e-9)
SHAPE = BACKSCATTER * np.exp(-2.0 * np.cumsum(EXTINCTION) * 15.0) / RANGE**2


def aerosol(count, rng):
    """Mixed layers of all depths and, in most profiles, dust aloft of up to 1.5 times the air."""
    top, soft = rng.uniform(800.0, 2500.0, (2, count, 1)) * np.array([1.0, 0.03])[:, None, None]
    mixed = 10.0 ** rng.uniform(-6.5, -5.2, (count, 1)) / (1.0 + np.exp((RANGE - top) / soft))
    height, width = rng.uniform(2e3, 6e3, (count, 1)), rng.uniform(150.0, 500.0, (count, 1))
    strength = rng.uniform(0.0, 1.5, (count, 1)) * np.interp(height, RANGE, BACKSCATTER)
    return mixed + strength * np.exp(-0.5 * ((RANGE - height) / width) ** 2)


def between(bottom, top):
    return np.logical_and(bottom <= RANGE, top > RANGE)


def attenuated(particles, cloud=None, lidar_ratio=50.0):
    """Return power over the lidar constant; cloud: base, thickness (m), extinction (m-1)."""
    extinction = EXTINCTION + lidar_ratio * particles
    total = BACKSCATTER + particles
    if cloud is not None:
        base, thickness, cloud_extinction = cloud
        inside = np.where(between(base, base + thickness), cloud_extinction, 0.0)
        extinction, total = extinction + inside, total + inside / 20.0
    optical_depth = np.cumsum(extinction, axis=-1) * 15.0 - 0.5 * extinction * 15.0
    return total * np.exp(-2.0 * optical_depth) / RANGE**2


def counted(expected, background, rng):
    """Return photon counts minus their background, and their variance."""
    counts = rng.poisson(expected + background)
    return counts - background, np.broadcast_to(expected + background, counts.shape)


def detected(*arguments, **settings):
    """Return the layers of each profile: their bins, the first one, and whether there are any."""
    mask = find_layers(*arguments, **settings)
    cloudy = mask.any(axis=-1)
    base = np.where(mask, arguments[1], np.inf).min(axis=-1)
    return SimpleNamespace(
        mask=mask, cloudy=cloudy, cloud_base_range=np.where(cloudy, base, np.nan)
    )


def detect(power, variance, **settings):
    return detected(power, RANGE, variance, molecular_attenuated=SHAPE, **settings)


CLOUDS = {
    "stratus": (1200.0, 250.0, 2e-2),
    "cumulus": (2000.0, 400.0, 5e-3),
    "altocumulus": (5000.0, 300.0, 1.5e-3),
    "cirrus": (9000.0, 1200.0, 2e-4),
    "thin cirrus": (10_000.0, 800.0, 5e-5),
}


@each("cloud", CLOUDS)
@each(("scale", "background"), [(1e18, 1.0), (1e18, 100.0), (1e20, 1e3)])
def test_clouds_are_detected_where_they_are(cloud, scale, background):
    rng = np.random.default_rng(1)
    base, depth, _ = CLOUDS[cloud]
    power, variance = counted(scale * attenuated(aerosol(200, rng), CLOUDS[cloud]), background, rng)
    layers = detect(power, variance)
    assert np.mean(layers.cloudy) >= 0.99
    deviation = (layers.cloud_base_range - base)[layers.cloudy]
    assert np.mean(np.abs(deviation) <= 30.0) > 0.95
    # The apparent top is never far above the true one.
    top = np.median([RANGE[mask].max() for mask in layers.mask[layers.cloudy]])
    assert top <= base + depth + 45.0
    if cloud != "stratus":
        assert top >= base + 0.5 * depth
    inside = between(base + 30.0, base + 60.0)
    assert np.mean(layers.mask[layers.cloudy][:, inside]) > 0.95


@pytest.mark.parametrize(("scale", "background"), [(1e16, 10.0), (1e18, 1.0), (1e20, 1e3)])
def test_aerosol_is_not_taken_for_cloud(scale, background):
    rng = np.random.default_rng(2)
    power, variance = counted(scale * attenuated(aerosol(3000, rng)), background, rng)
    layers = detect(power, variance)
    assert np.mean(layers.cloudy) <= 0.01
    empty = ~layers.cloudy
    assert np.all(np.isnan(layers.cloud_base_range[empty]))
    assert not np.any(layers.mask[empty])


@pytest.mark.parametrize("contrast", [1.0, 3.0])
def test_noise_makes_layers_at_most_at_the_stated_rate(contrast):
    rng = np.random.default_rng(3)
    spread = np.sqrt(SHAPE * SHAPE[300])
    power = SHAPE + spread * rng.standard_normal((4000, RANGE.size))
    layers = detect(power, spread**2, contrast=contrast)
    rate = COMMON.false_alarm
    assert np.mean(layers.cloudy) <= rate + 3.0 * np.sqrt(rate / 4000)


def correlated_noise(shape, correlation, rng):
    """Return normal noise of unit variance, each bin correlated with the one before."""
    white = rng.standard_normal(shape)
    white[..., 0] /= np.sqrt(1.0 - correlation**2)
    return signal.lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6])
def test_correlated_noise_makes_no_layers(correlation):
    """The variances are of differences of neighbouring bins, as those of analog channels."""
    rng = np.random.default_rng(5)
    spread = np.sqrt(SHAPE * SHAPE[300])
    power = SHAPE + spread * correlated_noise((10_000, RANGE.size), correlation, rng)
    layers = detect(power, (1.0 - correlation) * spread**2)
    assert np.mean(layers.cloudy) <= COMMON.false_alarm


@pytest.mark.parametrize(("correlation", "ratio"), [(0.0, 1.0), (0.3, 1.5), (0.6, 2.0)])
def test_cirrus_of_optical_depth_0_05_is_detected_in_correlated_noise(correlation, ratio):
    """At the base, a bin of air alone has this signal-to-noise ratio."""
    rng = np.random.default_rng(6)
    true = attenuated(np.zeros(RANGE.size), (9000.0, 1000.0, 5e-5))
    spread = np.full(RANGE.size, np.interp(9000.0, RANGE, attenuated(np.zeros(RANGE.size))))
    spread /= ratio
    power = true + spread * correlated_noise((500, RANGE.size), correlation, rng)
    layers = detect(power, (1.0 - correlation) * spread**2)
    assert np.mean(np.abs(layers.cloud_base_range - 9000.0) < 100.0) >= 0.95


ANALOG = {
    "analog_355p": 355e-9,
    "analog_355s": 355e-9,
    "analog_532p": 532e-9,
    "analog_532s": 532e-9,
}


def test_noise_of_analog_channels_makes_no_layers(data_root):
    """Beyond 22 km, files of 10 s hold noise alone, of which neighbouring bins are correlated."""
    files = sorted((data_root / "pilar/20241002").iterdir())
    counts = [licel.read_counts(file, list(ANALOG))[1] for file in files]
    layers = 0
    for channel, wavelength in ANALOG.items():
        power = np.stack([count[channel] for count in counts]).astype(np.float64)[:, 20:]
        r = 7.5 * (np.arange(20, 20 + power.shape[1]) + 0.5)
        far = power[:, r > 24e3]
        variance = 0.5 * np.mean(np.diff(far, axis=1) ** 2, axis=1, keepdims=True)
        extinction = AIR.extinction(330.0 + r, wavelength)
        found = detected(
            power - far.mean(axis=1, keepdims=True),
            r,
            np.broadcast_to(variance, power.shape),
            molecular_attenuated=AIR.backscatter(330.0 + r, wavelength)
            * np.exp(-15.0 * np.cumsum(extinction))
            / r**2,
            contrast=cloud_contrast(wavelength),
        )
        layers += np.count_nonzero(found.mask[:, r > 22e3].any(axis=-1))
    assert layers == 0


def test_power_of_the_test_is_what_gaussian_noise_allows():
    """A step beyond the factor is detected with the probability of the Gaussian tail."""
    rng = np.random.default_rng(4)
    bins, contrast, noise = round(THRESHOLDS.window_lengths[-1] / 15.0), 2.0, 1.0
    ratio = np.where(RANGE > 5000.0, 2.6, 1.0)
    spread = noise * SHAPE
    power = SHAPE * ratio + spread * rng.standard_normal((2000, RANGE.size))
    layers = detect(power, spread**2, contrast=contrast)
    lengths = len(THRESHOLDS.window_lengths)
    threshold = stats.norm.isf(COMMON.false_alarm / (2.0 * lengths))
    expected = (2.6 - contrast) / (noise * np.sqrt((1.0 + contrast**2) / bins))
    alone = stats.norm.sf(threshold - expected)
    # Bins beside the step may detect it too.
    assert alone <= np.mean(layers.cloudy) < alone + 0.25


@pytest.mark.parametrize("contrast", [1.6, 3.0])
def test_an_edge_of_aerosol_that_rises_by_the_factor_is_no_cloud(contrast):
    """At most at the stated rate, in all noise that may decide it."""
    rng = np.random.default_rng(9)
    power = SHAPE * np.where(between(4000.0, 5500.0), contrast, 1.0)
    cloudy = []
    for noise in (0.05, 0.1, 0.2, 0.4):
        spread = noise * SHAPE * np.sqrt(32.0)
        noisy = power + spread * rng.standard_normal((2000, RANGE.size))
        cloudy.append(detect(noisy, spread**2, contrast=contrast).cloudy)
    rate = COMMON.false_alarm
    assert np.mean(cloudy) <= rate + 3.0 * np.sqrt(rate / np.size(cloudy))


BLUE = 355e-9


def of_wavelength(wavelength, particles, lidar_ratio=50.0):
    """Return backscatter of air, the power of particles, and its shape of clean air."""
    air, extinction = AIR.backscatter(RANGE, wavelength), AIR.extinction(RANGE, wavelength)
    clean = np.exp(-30.0 * np.cumsum(extinction)) / RANGE**2
    dimmed = np.exp(-30.0 * lidar_ratio * np.cumsum(particles, axis=-1))
    return air, (air + particles) * clean * dimmed, air * clean


def test_aerosol_is_no_cloud_at_short_wavelengths_either():
    """The skies of the green beam, of an Angstrom exponent of 1."""
    rng = np.random.default_rng(2)
    _, power, shape = of_wavelength(BLUE, 532.0 / 355.0 * aerosol(3000, rng))
    for scale, background in ((1e17, 1.0), (1e18, 1.0), (1e20, 1e3)):
        counts, variance = counted(scale * power, background, rng)
        layers = detected(
            counts, RANGE, variance, molecular_attenuated=shape, contrast=cloud_contrast(BLUE)
        )
        assert np.mean(layers.cloudy) <= 0.01


@pytest.mark.parametrize("wavelength", [BLUE, 532e-9])
def test_a_cirrus_stands_out_at_each_wavelength(wavelength):
    """Of grey scattering, 26 standard errors above noise in means over 900 m."""
    rng = np.random.default_rng(12)
    cirrus = 1e-5 * np.exp(-0.5 * ((RANGE - 9000.0) / 350.0) ** 2)
    air, power, shape = of_wavelength(wavelength, cirrus, 25.0)
    inside = between(8550.0, 9450.0)
    spread = np.sum(cirrus[inside]) / np.sqrt(np.sum(inside)) / 26.0 / air * shape
    found = detected(
        power + spread * rng.standard_normal((500, RANGE.size)), RANGE, spread**2,
        molecular_attenuated=shape, contrast=cloud_contrast(wavelength),
    )  # fmt: skip
    core = found.mask[:, np.abs(RANGE - 9000.0) < 200.0]
    assert np.mean(core.any(axis=-1)) > 0.9


def edge(distance, scale):
    """Return 1 at negative distances in m from an edge of a scale in m, 0 at positive ones."""
    return 0.5 - 0.5 * np.tanh(distance / scale)


TOPS = {
    "weak cirrus": 1e-5 * np.exp(-0.5 * ((RANGE - 9000.0) / 350.0) ** 2),
    "cirrus": 2e-5 * np.exp(-0.5 * ((RANGE - 9000.0) / 600.0) ** 2),
    "cirrus with a sharp top": 2e-5 * between(8000.0, 9500.0),
    "cirrus that attenuates": 1e-4 * (RANGE >= 8000.0) * edge(RANGE - 9000.0, 160.0),
    "stratocumulus": 1e-3 * (RANGE >= 1500.0) * edge(RANGE - 1800.0, 60.0),
}
"""Backscatter of clouds, m-1 sr-1, of a lidar ratio of 20 sr."""


def found_tops(wavelength, name, ratio):
    """Return scattering ratio, excess of means over 150 m over noise, and masks of noisy profiles.

    With a signal-to-noise ratio of a bin of clean air at 9 km.
    """
    rng = np.random.default_rng(22)
    air, power, shape = of_wavelength(wavelength, TOPS[name], 20.0)
    spread = np.hypot(np.interp(9000.0, RANGE, shape) / ratio, 0.003 * power)
    masks = detected(
        power + spread * rng.standard_normal((100, RANGE.size)), RANGE, spread**2,
        molecular_attenuated=shape, contrast=cloud_contrast(wavelength),
    ).mask  # fmt: skip
    total = 1.0 + TOPS[name] / air
    return total, (1.0 - 1.0 / total) * power / spread * np.sqrt(10.0), masks


@each("wavelength", [BLUE, 532e-9])
@each("cloud", TOPS)
@each("ratio", [1.0, 5.0, 30.0])
def test_a_layer_holds_its_upper_part(wavelength, cloud, ratio):
    """Down to half the least excess, as far as means over 150 m show it, but for 180 m."""
    total, excess, masks = found_tops(wavelength, cloud, ratio)
    half = 1.0 + 0.5 * (cloud_contrast(wavelength) - 1.0)
    above = RANGE[np.argmax(total)] <= RANGE
    true_top = RANGE[above & (total > half) & (excess > 5.0)].max()
    tops = np.where(masks, RANGE, 0.0).max(axis=-1)
    assert true_top - np.median(tops) <= 180.0
    assert np.percentile(tops, 95) <= RANGE[above & (total > 1.02)].max() + 15.0


@each("wavelength", [BLUE, 532e-9])
@each("cloud", ["weak cirrus", "cirrus"])
@each("ratio", [5.0, 30.0])
def test_a_layer_holds_its_lower_part(wavelength, cloud, ratio):
    """As its upper part, but for 90 m: longer windows are needed the farther the air is away."""
    total, excess, masks = found_tops(wavelength, cloud, ratio)
    half = 1.0 + 0.5 * (cloud_contrast(wavelength) - 1.0)
    below = RANGE[np.argmax(total)] >= RANGE
    true_base = RANGE[below & (total > half) & (excess > 5.0)].min()
    bases = RANGE[masks.argmax(axis=-1)]
    assert np.median(bases) - true_base <= 90.0
    assert np.percentile(bases, 5) >= RANGE[below & (total > 1.02)].min() - 15.0


@each("wavelength", [BLUE, 532e-9])
@each("cloud", TOPS)
def test_the_margin_of_a_layer_holds_the_edge_that_noise_hides(wavelength, cloud):
    total, excess, masks = found_tops(wavelength, cloud, 30.0)
    half = 1.0 + 0.5 * (cloud_contrast(wavelength) - 1.0)
    edge_bins = (total > half) & (excess > 5.0)
    assert with_margin(masks, RANGE)[:, edge_bins].mean() > 0.99


@each(("ratio", "found"), [(3.0, False), (8.0, True)])
@each("depth", [300.0, 500.0, 800.0, 1200.0])
def test_a_cirrus_that_rises_slowly_is_found(depth, ratio, found):
    excess = (ratio - 1.0) * np.exp(-0.5 * ((RANGE - 9500.0) / depth) ** 2)
    counts = 1e20 * attenuated(excess * BACKSCATTER, lidar_ratio=20.0)
    layers = detect(counts, counts + 1.0, contrast=cloud_contrast(532e-9))
    bright = excess > 1.0
    assert layers.mask[bright].any() == found
    assert np.mean(layers.mask[bright]) >= (0.9 if found else 0.0)


def test_aerosol_above_a_cloud_is_outside_of_it():
    """In three of four skies; in others the top of the aerosol is close to that of the cloud."""
    rng = np.random.default_rng(23)
    for name in ("stratus", "cumulus"):
        base, depth, _ = CLOUDS[name]
        for scale in (1e18, 1e20, 1e22):
            sky = scale * attenuated(aerosol(200, rng), CLOUDS[name])
            mask = detect(*counted(sky, 100.0, rng)).mask & (RANGE < 4000.0)
            tops = np.where(mask, RANGE, 0.0).max(axis=-1)
            assert np.percentile(tops, 75) <= base + depth + 15.0


@pytest.mark.parametrize("ratio", [1.0, 30.0])
def test_air_between_two_layers_is_outside_of_them(ratio):
    rng = np.random.default_rng(24)
    layers = 2e-5 * (between(8000.0, 8500.0) | between(9000.0, 9500.0))
    _, power, shape = of_wavelength(532e-9, layers, 20.0)
    spread = np.interp(9000.0, RANGE, shape) / ratio
    noisy = power + spread * rng.standard_normal((100, RANGE.size))
    mask = detected(noisy, RANGE, spread**2 + 0.0 * noisy, molecular_attenuated=shape).mask
    assert mask[:, between(8560.0, 8940.0)].mean() < 0.02


def test_a_layer_ends_beyond_an_opaque_cloud_where_the_background_is_too_high():
    """Up to a standard deviation of a bin."""
    rng = np.random.default_rng(25)
    counts, variance = counted(1e20 * attenuated(0.0 * RANGE, CLOUDS["stratus"]), 1e4, rng)
    for too_high in (1.0, 10.0, 100.0):
        top = RANGE[detect(counts - too_high, variance).mask].max()
        assert top < 1600.0


@pytest.mark.parametrize(
    ("wavelength", "ratios", "least", "most"),
    [
        (532e-9, (3.0, 4.0), 0.85, 0.95),
        (BLUE, (3.0, 4.0), 0.0, 0.001),
        (BLUE, (5.0, 6.0), 0.99, 1.0),
    ],
)
def test_a_grey_cirrus_has_to_be_brighter_to_be_a_cloud_at_355_nm(wavelength, ratios, least, most):
    """Of scattering ratios at 532 nm, 480 or 1000 m deep, in little noise."""
    rng = np.random.default_rng(21)
    excess = rng.uniform(*ratios, (1000, 1)) - 1.0
    depth = rng.choice([480.0, 1000.0], (1000, 1))
    inside = between(9000.0, 9000.0 + depth)
    _, power, shape = of_wavelength(wavelength, excess * BACKSCATTER * inside, 25.0)
    spread = np.full(RANGE.size, np.interp(9000.0, RANGE, shape) / 30.0)
    mask = detected(
        power + spread * rng.standard_normal(power.shape), RANGE, spread**2,
        molecular_attenuated=shape, contrast=cloud_contrast(wavelength),
    ).mask  # fmt: skip
    assert least <= (mask & inside).any(axis=-1).mean() <= most


def test_single_counts_of_a_mean_are_no_clouds():
    """Beyond 9 km a window of 60 m holds less than a count, of a very skewed distribution."""
    rng = np.random.default_rng(13)
    expected = 1e12 * attenuated(np.zeros(RANGE.size)) + 0.02
    power, variance = counted(np.broadcast_to(expected, (4000, RANGE.size)), 0.0, rng)
    assert np.mean(detect(power - 0.02, variance, quantum=1.0).cloudy) <= 1.5e-3


@pytest.mark.parametrize("wavelength", [BLUE, 532e-9, 1064e-9])
def test_a_layer_is_found_where_noise_would_not_hide_it(wavelength):
    """480 m deep, of twice the least excess: in half of the cases where its limit lies."""
    rng = np.random.default_rng(14)
    contrast = cloud_contrast(wavelength)
    _, power, shape = of_wavelength(wavelength, np.zeros(RANGE.size))
    of_air = np.broadcast_to(3e15 * power, (300, RANGE.size))
    settings = {"molecular_attenuated": shape, "contrast": contrast, "quantum": 1.0}

    def searched(expected):
        counts, variance = counted(expected, 100.0, rng)
        return counts, RANGE, variance, detected(counts, RANGE, variance, **settings).mask

    *air, cloudy = searched(of_air)
    visible = find_visible_air(*air, cloudy=cloudy, **settings).mean(axis=0)
    assert (visible[RANGE < 3000.0] == 1.0).all()
    limit = RANGE[np.argmax(visible < 0.5)]
    found = []
    for base in (0.75 * limit, limit, 1.33 * limit):
        layer = between(base, base + 480.0)
        mask = searched(of_air * (1.0 + 2.0 * (contrast - 1.0) * layer))[-1]
        found.append(mask[:, layer].any(axis=-1).mean())
    assert found[0] > 0.95
    assert 0.3 < found[1] < 0.75
    assert found[2] < 0.2


def test_bins_beside_a_layer_are_judged_without_it():
    """Beyond a cloud that hides the light, no layer could be seen; beside a gap one could."""
    rng = np.random.default_rng(15)
    counts, variance = counted(3e15 * attenuated(0.0 * RANGE, CLOUDS["stratus"]), 1.0, rng)
    counts[between(600.0, 900.0)] = np.nan
    cloudy = detect(counts, variance).mask
    visible = find_visible_air(counts, RANGE, variance, cloudy=cloudy, molecular_attenuated=SHAPE)
    assert visible[between(300.0, 600.0) | between(900.0, 1200.0)].all()
    assert not visible[RANGE > 2000.0].any()


def test_all_layers_are_masked_and_the_lowest_is_reported():
    particles = np.zeros(RANGE.size)
    power = 1e18 * attenuated(particles, (3000.0, 200.0, 1e-3))
    second = (RANGE >= 8000.0) & (RANGE < 8500.0)
    power[second] *= 10.0
    layers = detect(power, power)
    assert layers.cloud_base_range == pytest.approx(3000.0, abs=16.0)
    first = layers.mask & (RANGE < 7900.0)
    assert RANGE[first].max() == pytest.approx(3200.0, abs=31.0)
    assert np.all(layers.mask[second])
    assert not np.any(layers.mask[(RANGE > 3300.0) & (RANGE < 7900.0)])


def test_noise_free_profiles_are_tested_too():
    assert not detect(attenuated(aerosol(1, np.random.default_rng(0))[0]), 0.0).cloudy
    assert detect(attenuated(np.zeros(RANGE.size), (4000.0, 300.0, 1e-3)), 0.0).cloudy


def test_air_without_noise_has_no_layers_however_sensitive_the_test():
    r = 7.5 * (np.arange(10_000) + 0.5)[20:]
    extinction = AIR.extinction(r, 532e-9)
    shape = AIR.backscatter(r, 532e-9) * np.exp(-15.0 * np.cumsum(extinction)) / r**2
    layers = detected(1e9 * shape, r, 0.0, molecular_attenuated=shape, contrast=1.0)
    assert not layers.cloudy


def test_clouds_are_kept_out_of_the_reference():
    rng = np.random.default_rng(6)
    true = attenuated(aerosol(100, rng), (7000.0, 600.0, 2e-4))
    power, variance = counted(1e18 * true, 5.0, rng)
    layers = detect(power, variance)
    window = choose_reference(
        power, RANGE, variance, molecular_attenuated=SHAPE, exclude=layers.mask,
        candidates=candidate_windows(5e3, 12e3, 1e3, 250.0),
    )  # fmt: skip
    within = (window.top > 7015.0) & (window.bottom < 7500.0)
    assert not np.any(within)
    excluded = (window.rejections & Rejection.EXCLUDED) != 0
    assert np.all(np.any(excluded, axis=-1))


def test_missing_data_hide_layers_and_make_none():
    rng = np.random.default_rng(7)
    power, variance = counted(1e18 * attenuated(np.zeros(RANGE.size), CLOUDS["cirrus"]), 1.0, rng)
    power = np.stack([power, power, power]).astype(float)
    power[0] = np.nan
    power[1, (RANGE > 5000.0) & (RANGE < 5200.0)] = np.nan
    power[2, RANGE > 8000.0] = np.nan
    layers = detect(power, variance)
    assert layers.cloudy.tolist() == [False, True, False]
    assert layers.cloud_base_range[1] == pytest.approx(9000.0, abs=16.0)


@pytest.mark.parametrize("hole", [(5050.0, 5150.0), (5050.0, 5350.0)])
def test_a_layer_goes_on_beyond_its_saturated_bins(hole):
    power = np.where(between(*hole), np.nan, 1e18 * attenuated(0.0, (5000.0, 500.0, 1.5e-3)))
    layers = detect(power, np.abs(power) + 1.0)
    assert layers.mask[between(5000.0, 5450.0)].all()
    assert not layers.mask[between(5600.0, 1e5)].any()


def test_a_layer_ends_where_the_data_end():
    power = np.where(RANGE > 5200.0, np.nan, 1e18 * attenuated(0.0, (5000.0, 500.0, 1.5e-3)))
    layers = detect(power, np.abs(power) + 1.0)
    assert layers.mask[between(5000.0, 5150.0)].all()
    assert not layers.mask[between(5500.0, 1e5)].any()


def test_profiles_are_tested_independently_in_any_layout():
    rng = np.random.default_rng(8)
    true = attenuated(aerosol(12, rng), CLOUDS["cumulus"])
    power, variance = counted(1e17 * true, 5.0, rng)
    whole = detect(power, variance)
    cube = detect(power.reshape(3, 4, -1).astype(np.float32), variance.reshape(3, 4, -1))
    swapped = detect(np.asfortranarray(power.astype(">f8")), variance)
    assert cube.mask.shape == (3, 4, RANGE.size)
    np.testing.assert_array_equal(cube.cloud_base_range.ravel(), whole.cloud_base_range)
    np.testing.assert_array_equal(swapped.mask, whole.mask)
    alone = detect(power[5], variance[5])
    assert alone.cloud_base_range == whole.cloud_base_range[5]
    np.testing.assert_array_equal(alone.mask, whole.mask[5])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"contrast": 0.5}, "contrast"),
        ({"contrast": np.nan}, "contrast"),
        ({"molecular_attenuated": -SHAPE}, "molecular_attenuated"),
        ({"molecular_attenuated": np.nan}, "molecular_attenuated"),
    ],
)
def test_impossible_arguments_are_refused_by_name(change, field):
    with pytest.raises(RetrievalInputError) as caught:
        detected(SHAPE, RANGE, SHAPE**2, **{"molecular_attenuated": SHAPE, **change})
    assert caught.value.field == field

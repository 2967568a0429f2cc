"""Channels of one Raman retrieval with ranges, data and filters of their own, without noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.raman_signals import LASER, along

from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.depth_fit import SignalNoise
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.labeled import WaterVapour, retrieve
from lidarops.retrieve.raman.retrieval import mixing_ratio, particle_transmission
from lidarops.retrieve.raman.scattering import (
    NITROGEN_SHIFT,
    WATER_SHIFT,
    nitrogen_line_share,
    raman_wavelength,
)
from lidarops.retrieve.raman.settings import RamanReference, RamanSettings
from lidarops.retrieve.raman.signals import CellSignal

STEP = 15.0
R = STEP * (np.arange(1000) + 0.5)
RAMAN = raman_wavelength(LASER, NITROGEN_SHIFT)
WATER = raman_wavelength(LASER, WATER_SHIFT)
EXPONENT = 1.2
SURFACE, SCALE_HEIGHT = 1e-4, 800.0
"""m-1 and m: particle extinction at the ground and its scale height."""
HUMIDITY = 0.005
AIR = MolecularProfile.us_standard()


def extinction(r):
    return SURFACE * np.exp(-r / SCALE_HEIGHT)


def transmission(wavelength, r):
    """Return the transmission to `r`, between bins without error."""
    air = np.interp(r, R, along(AIR.extinction(R, wavelength), STEP))
    particles = SURFACE * SCALE_HEIGHT * (1.0 - np.exp(-r / SCALE_HEIGHT))
    return np.exp(-air - (LASER / wavelength) ** EXPONENT * particles)


def averages(power, offset=0.0, **attributes: Any):
    """Return one mean of a channel whose bins are `offset` m beyond."""
    power = np.asarray(power)[np.newaxis]
    plane = ("time", "range")
    return xr.Dataset(
        {
            "power": (plane, power, attributes),
            "variance": (plane, 1e-6 * np.maximum(np.nan_to_num(power), 1e-6)),
            "quality": (plane, np.zeros(power.shape, np.int32)),
            "noise_correlation_length": ("time", np.ones(1)),
            "profiles": ("time", np.array([10], np.int32)),
            "shots": ("time", np.array([1000], np.int32)),
        },
        coords={
            "time": np.array(["2024-09-21"], "M8[ns]"),
            "range": ("range", R + offset),
            "zenith_angle": 0.0,
        },
    )


def raman_power(wavelength, r=R, share=1.0):
    density = AIR.number_density(r) / AIR.number_density(R)[0]
    return 1e13 * density * share / r**2 * transmission(LASER, r) * transmission(wavelength, r)


SETTINGS = RamanSettings(
    highest=12_000.0,
    reference=RamanReference(lowest=7000.0, highest=12_000.0, width=3000.0, relative_error=0.0),
    angstrom_exponent=EXPONENT,
    molecular_slope_error=0.0,
)


FLAGS_OF_OTHERS = "quality_flag", "aerosol_backscatter_quality_flag", "lidar_ratio_quality_flag"


def elastic_power():
    elastic = 1e18 * (AIR.backscatter(R, LASER) + extinction(R) / 50.0) / R**2
    return elastic * transmission(LASER, R) ** 2


def retrieved(
    nitrogen=None, water=None, filter_width=None, seen=1.0, elastic=None, **arguments: Any
):
    """Return the product of these channels; where none are given, of exact ones times `seen`."""
    nitrogen = averages(seen * raman_power(RAMAN)) if nitrogen is None else nitrogen
    return retrieve(
        averages(seen * elastic_power()) if elastic is None else elastic,
        nitrogen,
        station_altitude=0.0,
        wavelengths=(LASER, RAMAN),
        water=None if water is None else WaterVapour(water, WATER, 1.0, 0.03),
        **{
            "molecules": AIR,
            "settings": replace(SETTINGS, filter_width=filter_width),
            **arguments,
        },
    )


@pytest.fixture(scope="module")
def exact():
    return retrieved(water=averages(HUMIDITY * raman_power(WATER)))


def between(product, name, low, high):
    r = product["range"].to_numpy()
    return product[name].to_numpy()[0, (low < r) & (r < high)]


@pytest.mark.parametrize("offset", [3.7, -16.0])
def test_bins_between_those_of_the_elastic_channel_keep_their_range(exact, offset):
    r = R + offset
    power, water = (
        np.where(r > 0.0, raman_power(wavelength, np.maximum(r, 0.1)), np.nan)
        for wavelength in (RAMAN, WATER)
    )
    moved = retrieved(averages(power, offset), averages(HUMIDITY * water, offset))
    # Cells begin with the first bin that all channels have.
    before = exact.interp(range=moved["range"], kwargs={"fill_value": "extrapolate"})
    away = between(moved, "aerosol_extinction", 300.0, 6000.0) - between(
        before, "aerosol_extinction", 300.0, 6000.0
    )
    # Taken as that of the elastic bin, 3.7 m are 26e-6 m-1 at 400 m.
    assert np.abs(away).max() < 2e-7
    for name in ("aerosol_backscatter", "water_vapour_mixing_ratio"):
        values = (between(product, name, 300.0, 6000.0) for product in (moved, before))
        np.testing.assert_allclose(*values, rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize("broken", ["missing", "saturated"])
def test_a_broken_channel_of_water_vapour_concerns_water_vapour_alone(exact, broken):
    water = averages(HUMIDITY * raman_power(WATER))
    if broken == "missing":
        water["power"][:] = np.nan
    else:
        water["quality"][:] = int(Quality.SATURATED)
    product = retrieved(water=water)
    assert np.isnan(product["water_vapour_mixing_ratio"]).all()
    doubtful = np.int32(RamanQuality.DOUBTFUL_WATER_VAPOUR)
    assert np.all(product["water_vapour_mixing_ratio_quality_flag"] & doubtful)
    assert not between(exact, "quality_flag", 300.0, 5000.0).any()
    for name in ("aerosol_extinction", *FLAGS_OF_OTHERS):
        np.testing.assert_array_equal(product[name], exact[name])


@pytest.mark.parametrize("bit", [Quality.SATURATED, Quality.PILE_UP])
def test_extinction_is_not_doubted_for_the_elastic_signal(exact, bit):
    elastic = averages(elastic_power())
    elastic["quality"][:, 40:60] |= int(bit)
    product = retrieved(elastic=elastic, water=averages(HUMIDITY * raman_power(WATER)))
    low, high = R[42], R[58]
    for name in ("aerosol_backscatter", "lidar_ratio"):
        assert np.all(between(product, f"{name}_quality_flag", low, high) & int(bit)), name
    np.testing.assert_array_equal(product["aerosol_extinction"], exact["aerosol_extinction"])
    for name in ("quality_flag", "water_vapour_mixing_ratio_quality_flag"):
        np.testing.assert_array_equal(product[name], exact[name])


def test_bits_of_one_quantity_are_none_of_another(exact):
    no_ratio = np.int32(RamanQuality.NO_LIDAR_RATIO)
    clean = between(exact, "lidar_ratio_quality_flag", 8000.0, 11_000.0)
    assert np.all(clean & no_ratio)
    for name in ("quality_flag", "aerosol_backscatter_quality_flag"):
        assert not np.any(exact[name] & no_ratio), name
    near = retrieved(overlap=np.where(R < 600.0, np.nan, 1.0))
    partial = np.int32(Quality.INCOMPLETE_OVERLAP)
    assert np.all(between(near, "quality_flag", 0.0, 500.0) & partial)
    of_backscatter = between(near, "aerosol_backscatter_quality_flag", 0.0, 500.0)
    assert np.all(of_backscatter == RamanQuality.COMMON_OVERLAP)
    assert np.isfinite(between(near, "aerosol_backscatter", 0.0, 500.0)).all()


def test_an_extinction_below_zero_gives_no_lidar_ratio():
    # A step of 2 % over 300 m, as of a background that is slightly wrong.
    step = 1.0 + 0.02 * np.clip((R - 1500.0) / 300.0, 0.0, 1.0)
    product = retrieved(averages(raman_power(RAMAN) * step))
    below = between(product, "aerosol_extinction", 300.0, 5000.0) <= 0.0
    ratio = between(product, "lidar_ratio", 300.0, 5000.0)
    assert below.sum() > 2
    assert (between(product, "aerosol_backscatter", 300.0, 5000.0)[below] > 0.0).all()
    assert np.isnan(ratio[below]).all()
    assert np.isfinite(ratio[~below]).sum() > 20
    bits = between(product, "lidar_ratio_quality_flag", 300.0, 5000.0)
    assert np.all(bits[below] & np.int32(RamanQuality.NO_LIDAR_RATIO))


@pytest.mark.parametrize("channel", ["nitrogen", "water"])
def test_analog_alone_in_a_glued_channel_has_no_scale_for_water_vapour(exact, channel):
    nitrogen, water = averages(raman_power(RAMAN)), averages(HUMIDITY * raman_power(WATER))
    # In mV instead of MHz.
    concerned = nitrogen if channel == "nitrogen" else water
    scaled = concerned.assign(
        power=concerned["power"] / 20.0,
        variance=concerned["variance"] / 400.0,
        **{f"glue_{end}": ("time", [R[-1] + 1.0]) for end in ("bottom", "top")},
    )
    pair = (scaled, water) if channel == "nitrogen" else (nitrogen, scaled)
    product = retrieved(*pair)
    assert np.isnan(product["water_vapour_mixing_ratio"]).all()
    doubtful = np.int32(RamanQuality.DOUBTFUL_WATER_VAPOUR)
    assert np.all(product["water_vapour_mixing_ratio_quality_flag"] & doubtful)
    for name in ("aerosol_extinction", "aerosol_backscatter"):
        values = (between(one, name, 300.0, 5000.0) for one in (product, exact))
        np.testing.assert_allclose(*values, rtol=1e-6, atol=1e-12)


def test_lines_of_nitrogen_in_a_narrow_filter_do_not_change_water_vapour():
    width, r = 0.3e-9, np.array([600.0, 10_000.0])
    share = nitrogen_line_share(AIR.at(R)[1], LASER, RAMAN, width)
    product = retrieved(
        averages(raman_power(RAMAN, share=share)), averages(HUMIDITY * raman_power(WATER)), width
    )
    near, far = product["water_vapour_mixing_ratio"][0].sel(range=r, method="nearest").to_numpy()
    # Without a correction, as much as the share: 1.4 %.
    assert far / near == pytest.approx(1.0, abs=1e-3)
    systematic = product["water_vapour_mixing_ratio_error_systematic"][0]
    stated = systematic.sel(range=r[1], method="nearest").item() / far
    change = np.interp(r[1], R, share) / share[0] - 1.0
    assert change > 0.013
    # That of the lines of water vapour is not known; with the calibration.
    assert stated > np.hypot(0.03, change)


def test_the_overlap_is_that_of_the_campaign():
    overlap = 1.0 - (1.0 - np.minimum(R / 900.0, 1.0)) ** 2
    product = retrieved(seen=overlap, overlap=overlap)
    r = product["range"].to_numpy()
    cells = np.interp(r, R, overlap)
    np.testing.assert_allclose(product["overlap"].to_numpy()[0], cells, atol=2e-3)
    error = product["overlap_standard_error"].to_numpy()[0]
    np.testing.assert_allclose(error, 0.1 * (1.0 - cells), atol=2e-4)
    assert np.all(error[r < 850.0] > 0.0)


def test_an_overlap_that_nobody_states_is_missing(exact):
    product = retrieved(overlap_is_stated=False)
    assert np.isnan(product["overlap"]).all()
    assert np.isnan(product["overlap_standard_error"]).all()
    np.testing.assert_array_equal(product["aerosol_extinction"], exact["aerosol_extinction"])
    # Full from the first bin, as the range of full overlap says.
    assert np.all(exact["overlap"] == 1.0)


@pytest.mark.parametrize(("standard", "stated"), [(True, 1.6e-5), (False, 2e-6)])
def test_the_slope_of_the_air_is_as_uncertain_as_its_source(standard, stated):
    def error(slope_error):
        settings = replace(SETTINGS, molecular_slope_error=slope_error)
        product = retrieved(molecules=replace(AIR, standard=standard), settings=settings)
        return product["aerosol_extinction_error_molecular"].to_numpy()

    assumed = error(None)
    np.testing.assert_array_equal(assumed, error(stated))
    assert np.nanmax(assumed) > np.nanmax(error(0.0))


CELLS = 60.0 * (np.arange(100) + 0.5)
DEPTH = 1e-4 * CELLS
PARTIAL = CELLS < 300.0


def signal(value, **changes):
    """Return a signal of cells without noise or errors but those given."""
    none = np.zeros(CELLS.size)
    noise = SignalNoise(none, none)
    return replace(CellSignal(np.asarray(value), none, noise, none, none), **changes)


def mixing(nitrogen, water, depth=DEPTH, settings=SETTINGS, relative=0.0):
    return mixing_ratio(
        water,
        nitrogen,
        (depth, np.zeros(CELLS.size)),
        PARTIAL,
        constant=0.2,
        particles=particle_transmission(settings, LASER, RAMAN, WATER),
        relative_errors=(relative,),
    )


def test_errors_of_water_vapour_are_the_change_by_their_cause():
    exact = replace(SETTINGS, angstrom_standard_error=0.0)
    light, damp = np.exp(-DEPTH), 0.02 * np.exp(-DEPTH)
    change = 1e-4 * (1.0 + np.exp(-CELLS / 1000.0))
    value = mixing(signal(light), signal(damp)).value
    less = light - change
    by_nitrogen = mixing(signal(less), signal(damp), np.log(light / less) + DEPTH).value - value
    for name, kind in (("background", "random"), ("dead_time", "systematic")):
        stated = mixing(signal(light, **{name: change}), signal(damp), settings=exact)
        # The change of the fitted depth in the transmission of particles is left out: 1 %.
        np.testing.assert_allclose(getattr(stated, kind), np.abs(by_nitrogen), rtol=0.02)
        stated = mixing(signal(light), signal(damp, **{name: change}), settings=exact)
        by_water = mixing(signal(light), signal(damp + change)).value - value
        np.testing.assert_allclose(getattr(stated, kind), by_water, rtol=1e-9)
    steeper = replace(exact, angstrom_exponent=EXPONENT + 0.5)
    by_exponent = mixing(signal(light), signal(damp), settings=steeper).value - value
    stated = mixing(signal(light), signal(damp))
    np.testing.assert_allclose(stated.systematic, np.abs(by_exponent), rtol=0.1)
    stated = mixing(signal(light), signal(damp), settings=exact, relative=0.03)
    np.testing.assert_allclose(stated.systematic, 0.03 * value, rtol=1e-9)

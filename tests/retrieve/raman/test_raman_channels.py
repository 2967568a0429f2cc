"""Channels of one Raman retrieval with ranges, data and filters of their own, without noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.raman_signals import LASER, along

from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.labeled import Assumptions, WaterVapour, retrieve
from lidarops.retrieve.raman.retrieval import RamanSettings
from lidarops.retrieve.raman.scattering import NITROGEN_SHIFT, WATER_SHIFT, raman_wavelength

STEP = 15.0
R = STEP * (np.arange(1000) + 0.5)
RAMAN = raman_wavelength(LASER, NITROGEN_SHIFT)
WATER = raman_wavelength(LASER, WATER_SHIFT)
EXPONENT = 1.2
SURFACE, SCALE_HEIGHT = 1e-4, 1500.0
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


def retrieved(nitrogen=None, water=None, filter_width=None, **arguments: Any):
    """Return the product of these channels; of exact ones, where none are given."""
    elastic = 1e18 * (AIR.backscatter(R, LASER) + extinction(R) / 50.0) / R**2
    nitrogen = averages(raman_power(RAMAN)) if nitrogen is None else nitrogen
    settings = RamanSettings(
        LASER, RAMAN, EXPONENT, 0.0, 7000.0, 12_000.0, 3000.0, 1.0, 0.0, 0.01, 0.1
    )
    return retrieve(
        averages(elastic * transmission(LASER, R) ** 2),
        nitrogen,
        molecules=AIR,
        station_altitude=0.0,
        assumptions=Assumptions(settings, 60.0, 12_000.0, True, filter_width),
        water=None if water is None else WaterVapour(water, WATER, 1.0, 0.03),
        **arguments,
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
        np.testing.assert_allclose(*values, rtol=5e-4)

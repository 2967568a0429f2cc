"""Standard atmosphere and Rayleigh scattering against published and independent values."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air.molecular import (
    king_factor,
    molecular_lidar_ratio,
    number_density,
    rayleigh_cross_section,
    us_standard,
)


@given(st.floats(-4900.0, 83_000.0))
def test_air_is_in_hydrostatic_balance(altitude):
    # dp/dz = -rho g with g(z) of the spherical Earth of the standard, by central difference.
    step = 1.0
    (low, high), (here, temperature) = (
        us_standard(np.array([altitude - step, altitude + step]))[0],
        us_standard(altitude),
    )
    gravity = 9.80665 * (6_356_766.0 / (6_356_766.0 + altitude)) ** 2
    density = here * 0.0289644 / (8.31432 * temperature)
    assert (high - low) / (2 * step) == pytest.approx(-density * gravity, rel=1e-6)


def test_altitudes_keep_their_shape():
    p, t = us_standard(np.linspace(0, 80e3, 12).reshape(3, 4))
    assert p.shape == t.shape == (3, 4)
    assert np.all(np.diff(p.ravel()) < 0)


@pytest.mark.parametrize("altitude", [np.nan, np.inf, -5001.0, 84_001.0])
def test_an_altitude_outside_the_standard_is_refused(altitude):
    with pytest.raises(RetrievalInputError, match="altitude"):
        us_standard([0.0, altitude])


@given(st.floats(0.25, 0.85))
def test_the_fit_of_bodhaine_agrees(micrometres):
    # bodhaine1999, equation 29 in 1e-28 cm2; stated as within 0.01 % from 250 to 850 nm.
    s2, l2 = micrometres**-2, micrometres**2
    fit = (1.0455996 - 341.29061 * s2 - 0.90230850 * l2) / (
        1.0 + 0.0027059889 * s2 - 85.968563 * l2
    )
    assert rayleigh_cross_section(micrometres * 1e-6) == pytest.approx(fit * 1e-32, rel=2.5e-4)


def test_the_column_follows_from_surface_pressure():
    # Molecules above a square metre = p / (m g), except for the decrease of gravity with height.
    z = np.linspace(0.0, 80e3, 20_001)
    above = np.trapezoid(number_density(*us_standard(z)), z)
    expected = 101_325.0 * 6.02214076e23 / (0.0289644 * 9.80665)
    assert above == pytest.approx(expected, rel=3e-3)
    assert above > expected


@pytest.mark.parametrize("wavelength", [355e-9, 532e-9, 1064e-9])
def test_the_lidar_ratio_follows_from_the_phase_function(wavelength):
    # Integrate the phase function of depolarising molecules numerically (bucholtz1995).
    factor = float(king_factor(wavelength))
    rho = 6 * (factor - 1) / (3 + 7 * factor)
    assert (6 + 3 * rho) / (6 - 7 * rho) == pytest.approx(factor, rel=1e-12)
    gamma = rho / (2 - rho)

    def phase(mu):
        return (1 + 3 * gamma) + (1 - gamma) * mu**2

    total = 2 * mpmath.pi * mpmath.quad(phase, [-1, 1])
    assert molecular_lidar_ratio(wavelength) == pytest.approx(float(total / phase(-1)), rel=1e-12)
    assert molecular_lidar_ratio(532e-9) == pytest.approx(8.497, abs=1e-3)


@pytest.mark.parametrize("wavelength", [532.0, 0.532, 1e-7, np.nan])
def test_a_wavelength_in_another_unit_is_refused(wavelength):
    with pytest.raises(RetrievalInputError, match="532e-9"):
        rayleigh_cross_section(wavelength)

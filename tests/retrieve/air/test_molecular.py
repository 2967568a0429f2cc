"""Molecular atmosphere: published values, an independent source, and wrong units."""

from __future__ import annotations

import numpy as np
import pytest
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air.molecular import (
    HIGHEST,
    VAPOUR_SCATTERING,
    MolecularProfile,
    altitude_of,
    molecular_lidar_ratio,
    number_density,
    rayleigh_cross_section,
    us_standard,
    vapour_share,
)

STANDARD = MolecularProfile.us_standard()
LEVELS = np.array([100.0, 800.0, 1500.0, 3000.0, 5500.0, 9000.0, 12_000.0])


def _sounding(levels=LEVELS):
    """Return a sounding some degrees warmer than the standard, with a ground inversion."""
    pressure, temperature = us_standard(levels)
    return pressure * 1.01, temperature + np.linspace(4.0, 9.0, levels.size)


def _column():
    """Return the column of molecules up to 80 km, m-2."""
    height = np.linspace(0.0, 80e3, 16_001)
    return np.trapezoid(STANDARD.number_density(height), height)


def _profile(**arguments):
    pressure, temperature = _sounding()
    return MolecularProfile.from_profile(LEVELS, pressure, temperature, **arguments)


@pytest.mark.parametrize(
    ("wavelength", "cross_section", "depth"),
    [(532e-9, 5.167e-31, 0.1113), (355e-9, 2.759e-30, 0.5940)],
)
def test_rayleigh_scattering_to_four_digits(wavelength, cross_section, depth):
    assert float(f"{rayleigh_cross_section(wavelength):.3e}") == cross_section
    assert float(f"{_column() * rayleigh_cross_section(wavelength):.4f}") == depth


def test_the_infrared_check_values_are_of_the_fit_beyond_its_range():
    # bodhaine1999, equation 29, holds up to 850 nm; the physics of equation 2 is 0.08 % lower.
    s2, l2 = 1.064**-2, 1.064**2
    fit = (1.0455996 - 341.29061 * s2 - 0.90230850 * l2) / (
        1.0 + 0.0027059889 * s2 - 85.968563 * l2
    )
    assert float(f"{fit * 1e-32:.3e}") == 3.130e-32
    assert rayleigh_cross_section(1064e-9) == pytest.approx(fit * 1e-32, rel=1e-3)
    assert float(f"{_column() * fit * 1e-32:.5f}") == 0.00674


@each("wavelength", np.array([308, 355, 387, 408, 532, 607, 694, 1064]) * 1e-9)
def test_cross_sections_agree_with_bucholtz(wavelength):
    # bucholtz1995, table 3, from memory: an independent refractive index and depolarisation.
    um = wavelength * 1e6
    a, b, c, d = (
        (3.01577e-28, 3.55212, 1.35579, 0.11563)
        if um < 0.5
        else (4.01061e-28, 3.99668, 1.10298e-3, 2.71393e-2)
    )
    expected = a * um ** -(b + c * um + d / um) * 1e-4
    assert rayleigh_cross_section(wavelength) == pytest.approx(expected, rel=0.01)


def test_the_lidar_ratio_of_air():
    assert molecular_lidar_ratio(532e-9) == pytest.approx(8.497, abs=5e-4)
    ratio = STANDARD.extinction(3e3, 355e-9) / STANDARD.backscatter(3e3, 355e-9)
    assert ratio == pytest.approx(molecular_lidar_ratio(355e-9), rel=1e-14)


@pytest.mark.parametrize(
    ("altitude", "pressure", "temperature"),
    [(11e3, 22_699.96, 216.774), (20e3, 5529.31, 216.65), (50e3, 79.78, 270.65)],
)
def test_the_standard_profile_is_the_standard(altitude, pressure, temperature):
    p, t = STANDARD.at(altitude)
    assert p == pytest.approx(pressure, rel=5e-5)
    assert t == pytest.approx(temperature, abs=6e-4)
    everywhere = np.linspace(-5e3, HIGHEST, 30_001)
    np.testing.assert_allclose(
        STANDARD.number_density(everywhere), number_density(*us_standard(everywhere)), rtol=7e-6
    )
    assert not STANDARD.number_density([84_001.0, 1e6]).any()


def test_between_levels_temperature_and_log_pressure_are_linear():
    profile = _profile()
    pressure, temperature = _sounding()
    p, t = profile.at(LEVELS)
    np.testing.assert_allclose(p, pressure, rtol=1e-14)
    np.testing.assert_allclose(t, temperature, rtol=1e-14)
    p, t = profile.at(0.5 * (LEVELS[1:] + LEVELS[:-1]))
    np.testing.assert_allclose(p, np.sqrt(pressure[1:] * pressure[:-1]), rtol=1e-13)
    np.testing.assert_allclose(t, 0.5 * (temperature[1:] + temperature[:-1]), rtol=1e-14)
    np.testing.assert_allclose(profile.number_density(4e3), number_density(*profile.at(4e3)))


@pytest.mark.parametrize("edge", [LEVELS[0], LEVELS[-1]])
def test_beyond_the_levels_the_standard_is_scaled(edge):
    profile = _profile()
    inside, outside = profile.at([edge - 1e-6, edge + 1e-6]), profile.at(edge)
    np.testing.assert_allclose(inside, np.stack([outside, outside], axis=-1), rtol=1e-8)
    away = edge + np.sign(edge - 5e3) * np.array([50.0, 100.0])
    far, standard = profile.at(away), us_standard(away)
    np.testing.assert_allclose(far[0] / standard[0], outside[0] / us_standard(edge)[0])
    np.testing.assert_allclose(far[1] / standard[1], outside[1] / us_standard(edge)[1])


@pytest.mark.parametrize("altitude", [np.nan, -np.inf, -6e3])
def test_altitudes_outside_the_standard_are_refused(altitude):
    for call in (STANDARD.at, STANDARD.number_density):
        with pytest.raises(RetrievalInputError):
            call(altitude)


@each("station", [-300.0, 0.0, 850.0, 2400.0])
@each("weather", [0.92, 1.0, 1.06])
def test_pressure_units_are_detected(station, weather):
    levels = station + np.array([0.0, 1e3, 4e3])
    pressure, temperature = us_standard(levels)
    pascal, unit, hecto = (
        MolecularProfile.from_profile(
            levels, pressure * weather * factor, temperature, pressure_unit=unit_name
        )
        for factor, unit_name in ((1.0, None), (0.01, "hPa"), (0.01, None))
    )
    np.testing.assert_allclose(hecto.pressure, pascal.pressure, rtol=1e-14)
    np.testing.assert_array_equal(hecto.pressure, unit.pressure)


@each("factor", [1e-3, 0.1, 0.03, 7.5e-3, 0.5, 10.0, 1e3])
def test_other_pressures_are_refused(factor):
    pressure, temperature = _sounding()
    with pytest.raises(RetrievalInputError, match="neither Pa nor hPa") as caught:
        MolecularProfile.from_profile(LEVELS, pressure * factor, temperature)
    assert caught.value.field == "pressure"


@pytest.mark.parametrize(("unit", "factor"), [("hPa", 1.0), ("Pa", 0.01)])
def test_a_unit_that_contradicts_the_values_is_refused(unit, factor):
    pressure, temperature = _sounding()
    other = {"hPa": "Pa", "Pa": "hPa"}[unit]
    with pytest.raises(RetrievalInputError, match=f"is {other}, not {unit}"):
        MolecularProfile.from_profile(LEVELS, pressure * factor, temperature, pressure_unit=unit)


def _with(name, change):
    pressure, temperature = _sounding()
    arguments = {"altitude": LEVELS, "pressure": pressure, "temperature": temperature}
    return arguments | {name: change(arguments[name])}


@each(
    ("name", "change", "field", "message"),
    [
        ("altitude", lambda z: z / 1e3, "altitude", "looks like km"),
        ("altitude", lambda z: z / 0.3048, "altitude", "feet"),
        ("altitude", lambda z: z[::-1], "altitude", "sort"),
        ("altitude", lambda z: z * 10, "altitude", "metres"),
        ("altitude", lambda z: z[:-1], "pressure", "altitude has 6"),
        ("temperature", lambda t: t - 273.15, "temperature", "Celsius"),
        ("temperature", lambda t: t * 1.8, "temperature", "give K"),
        ("temperature", lambda t: np.where(t < 250, np.nan, t), "temperature", "finite"),
        ("temperature", lambda t: t[:, None], "temperature", "one axis"),
        ("pressure", lambda p: p[[0, 2, 1, 3, 4, 5, 6]], "pressure", "decrease"),
        ("pressure", lambda p: p - p[-1], "pressure", "positive"),
        ("pressure", lambda p: ["?"] * p.size, "pressure", "numbers"),
        ("pressure_unit", lambda _: "mbar", "pressure_unit", "Pa, hPa"),
    ],
)
def test_an_invalid_sounding_is_refused_by_field(name, change, field, message):
    arguments = _with(name, change) if name != "pressure_unit" else _with("altitude", lambda z: z)
    if name == "pressure_unit":
        arguments["pressure_unit"] = change(None)
    with pytest.raises(RetrievalInputError, match=message) as caught:
        MolecularProfile.from_profile(**arguments)
    assert caught.value.field == field


def test_a_profile_does_not_change_with_its_input():
    pressure, temperature = _sounding()
    profile = MolecularProfile.from_profile(LEVELS, pressure, temperature)
    before = profile.number_density(5e3)
    pressure *= 2.0
    assert profile.number_density(5e3) == before
    with pytest.raises(ValueError, match="read-only"):
        profile.temperature[0] = 1.0


@each("wavelength", [355e-9, 532e-9, 1064e-9])
def test_water_vapour_scatters_as_its_refractivity_says(wavelength):
    """`ciddor1996`, equation 3, at 20 degC and 1333 Pa; its King factor is 1."""
    s2 = (wavelength * 1e6) ** -2
    of_vapour = 1.022e-8 * (295.235 + 2.6422 * s2 - 0.03238 * s2**2 + 0.004028 * s2**3)
    own = of_vapour / number_density(1333.0, 293.15)
    cross_section = 8.0 * np.pi**3 / 3.0 * (2.0 * own) ** 2 / wavelength**4
    ratio = cross_section / rayleigh_cross_section(wavelength)
    assert ratio == pytest.approx(VAPOUR_SCATTERING, abs=0.02)


def test_humid_air_scatters_less_and_holds_less_nitrogen():
    dry, humid = _profile(), _profile(water_vapour=np.array([0.03, 0.02, 0.01, 0, 0, 0, 0]))
    z = np.array([0.0, 100.0, 1150.0, 20_000.0])
    share = np.array([0.03, 0.03, 0.015, 0.0])
    np.testing.assert_allclose(humid.vapour(z), share)
    np.testing.assert_array_equal(humid.number_density(z), dry.number_density(z))
    np.testing.assert_allclose(humid.dry_density(z), dry.number_density(z) * (1.0 - share))
    ratio = humid.extinction(z, 532e-9) / dry.extinction(z, 532e-9)
    np.testing.assert_allclose(ratio, 1.0 - 0.29 * share)


@pytest.mark.parametrize(
    "humidity",
    [
        {"dew_point": np.array([293.15])},
        {"relative_humidity": np.array([0.7379])},
        {"mixing_ratio": np.array([0.01472])},
        {"specific_humidity": np.array([0.01451])},
    ],
)
def test_humidities_mean_one_mole_fraction(humidity):
    """2339 Pa of water at 20 degC, in air of 298.15 K: tables of the WMO."""
    share = vapour_share(np.array([101_325.0]), np.array([298.15]), **humidity)
    assert share[0] == pytest.approx(2339.0 / 101_325.0, rel=4e-3)


def test_geopotential_height_of_the_standard_at_its_latitude():
    """Of `us1976` gravity is 9.80665 m s-2, that of 45.5 degrees: 11 km are 11019 m."""
    assert altitude_of(11_000.0, 45.5) == pytest.approx(11_019.1, abs=1.0)
    assert altitude_of(11_000.0, 0.0) - altitude_of(11_000.0, 90.0) == pytest.approx(58.0, abs=3.0)


def test_air_between_two_times_is_a_geometric_mean_of_pressures():
    first, second = _profile(), MolecularProfile.us_standard()
    z = np.linspace(100.0, 12_000.0, 57)
    mixed = first.mixed(second, 0.25)
    pressures, temperatures = zip(first.at(z), second.at(z), strict=True)
    pressure, temperature = mixed.at(z)
    expected = pressures[0] ** 0.75 * pressures[1] ** 0.25
    np.testing.assert_allclose(pressure, expected, rtol=1e-5)
    expected = 0.75 * temperatures[0] + 0.25 * temperatures[1]
    np.testing.assert_allclose(temperature, expected, atol=0.05)
    assert not mixed.standard


def test_humidity_that_one_of_two_profiles_states_is_that_of_the_air_between():
    """Not a share of it: the other one is not dry."""
    humid = _profile(water_vapour=np.array([0.03, 0.02, 0.01, 0, 0, 0, 0]))
    z = humid.altitude
    for mixed in (humid.mixed(_profile(), 0.25), _profile().mixed(humid, 0.25)):
        np.testing.assert_allclose(mixed.vapour(z), humid.vapour(z))
    wetter = _profile(water_vapour=3.0 * humid.vapour(z))
    np.testing.assert_allclose(humid.mixed(wetter, 0.25).vapour(z), 1.5 * humid.vapour(z))
    assert _profile().mixed(_profile(), 0.25).water_vapour is None

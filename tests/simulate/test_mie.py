"""Mie scattering against an independent series, published fractions and the study's figures."""

import numpy as np
import pytest
from scipy.special import spherical_jn, spherical_yn

from lidarops.errors import RetrievalInputError
from lidarops.simulate import aerosol
from lidarops.simulate.mie import Lognormal, default_angles, lognormal_scattering, mixed


def series(index, x):
    """Extinction, scattering and backscatter efficiency of one sphere, `bohren1983` 4.56-4.62.

    With spherical Bessel functions of complex argument from scipy, where the package recurs.
    """
    terms = int(x + 4.0 * x ** (1 / 3) + 10)
    n = np.arange(1, terms + 1)
    m = np.conj(index)  # absorption is positive in the convention of the series

    def riccati(function, z):
        value = z * function(n, z)
        slope = function(n, z) + z * function(n, z, derivative=True)
        return value, slope

    psi, dpsi = riccati(spherical_jn, x)
    chi, dchi = riccati(spherical_yn, x)
    xi, dxi = psi + 1j * chi, dpsi + 1j * dchi
    inner, dinner = riccati(spherical_jn, m * x)
    a = (m * inner * dpsi - psi * dinner) / (m * inner * dxi - xi * dinner)
    b = (inner * dpsi - m * psi * dinner) / (inner * dxi - m * xi * dinner)
    weight = 2 * n + 1
    extinction = 2 / x**2 * np.sum(weight * (a + b).real)
    scattering = 2 / x**2 * np.sum(weight * (np.abs(a) ** 2 + np.abs(b) ** 2))
    back = np.abs(np.sum(weight * (-1.0) ** n * (a - b))) ** 2 / x**2
    return extinction, scattering, back


@pytest.mark.parametrize("index", [1.33 - 0j, 1.5 - 0.01j, 1.75 - 0.44j])
@pytest.mark.parametrize("x", [0.3, 3.0, 20.0])
def test_narrow_distribution_is_a_sphere(index, x):
    radius = 0.5e-6
    wavelength = 2.0 * np.pi * radius / x
    width = 1.0 + 1e-6
    found = lognormal_scattering(Lognormal(radius, width), index, wavelength)
    extinction, scattering, back = series(index, x)
    area = np.pi * radius**2
    assert found.extinction == pytest.approx(area * extinction, rel=1e-4)
    assert found.scattering == pytest.approx(area * scattering, rel=1e-4)
    expected = 4.0 * np.pi * extinction / back
    assert found.lidar_ratio == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("radius", "index", "asymmetry", "albedo", "back", "ratio"),
    [
        (0.5e-6, 1.45 - 0.005j, 0.719, 0.924, 0.475, 28.7),
        (1.0e-6, 1.45 - 0.005j, 0.794, 0.858, 0.425, 34.5),
        (0.5e-6, 1.53 - 0.008j, 0.695, 0.876, 1.22, 11.7),
    ],
)
def test_lognormal_aerosol_at_532_nm(radius, index, asymmetry, albedo, back, ratio):
    found = lognormal_scattering(Lognormal(radius, 1.5), index, 532e-9)
    assert found.asymmetry == pytest.approx(asymmetry, abs=1e-3)
    assert found.single_scattering_albedo == pytest.approx(albedo, abs=1e-3)
    assert found.phase_function[-1] == pytest.approx(back, rel=0.03)
    assert found.lidar_ratio == pytest.approx(ratio, rel=0.03)
    cosine = np.cos(found.angle)
    whole = -0.5 * np.trapezoid(found.phase_function, cosine)
    assert whole == pytest.approx(1.0, abs=1e-3)
    mean = -0.5 * np.trapezoid(found.phase_function * cosine, cosine)
    assert mean == pytest.approx(found.asymmetry, abs=2e-3)


def test_number_fractions_are_the_published_ones():
    expected = {
        "continental": {"water_soluble": 0.937437, "soot": 0.0625607},
        "urban": {"soot": 0.411069, "dust_like": 1.64128e-7},
        "maritime": {"water_soluble": 0.999573},
    }
    for mixture, parts in expected.items():
        found = aerosol.number_fractions(mixture)
        assert sum(found.values()) == pytest.approx(1.0, rel=1e-14)
        for part, fraction in parts.items():
            assert found[aerosol.Component(part)] == pytest.approx(fraction, rel=5e-6)


def test_urban_aerosol_absorbs_and_maritime_does_not():
    urban = aerosol.mixture_scattering("urban", 550e-9)
    assert urban.single_scattering_albedo == pytest.approx(0.66, abs=0.02)
    assert urban.asymmetry == pytest.approx(0.593, abs=0.01)
    assert urban.lidar_ratio == pytest.approx(47.0, rel=0.04)


def test_mixing_weighs_by_what_is_scattered():
    one = aerosol.tropospheric_scattering(532e-9)
    other = lognormal_scattering(Lognormal(0.1e-6, 1.5), 1.5 - 0.1j, 532e-9)
    both = mixed([(1.0, one), (3.0, other)])
    assert both.extinction == pytest.approx((one.extinction + 3.0 * other.extinction) / 4.0)
    back = (
        one.scattering * one.phase_function[-1]
        + 3.0 * other.scattering * (other.phase_function[-1])
    )
    ratio = 4.0 * np.pi * (one.extinction + 3.0 * other.extinction) / back
    assert both.lidar_ratio == pytest.approx(ratio)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((Lognormal(0.5e-6, 1.5), 1.45 - 0.005j, 532.0), "wavelength"),
        ((Lognormal(0.5e-6, 1.5), 1.45 + 0.005j, 532e-9), "refractive_index"),
    ],
)
def test_absurd_input_is_refused(arguments, field):
    with pytest.raises(RetrievalInputError) as caught:
        lognormal_scattering(*arguments)
    assert caught.value.field == field


def test_absurd_sizes_and_names_are_refused():
    with pytest.raises(RetrievalInputError, match="metres"):
        Lognormal(0.5, 1.5)
    with pytest.raises(RetrievalInputError, match="between 1 and 5"):
        Lognormal(0.5e-6, 0.5)
    with pytest.raises(RetrievalInputError, match="continental"):
        aerosol.number_fractions("rural")
    with pytest.raises(RetrievalInputError, match="0 to pi"):
        lognormal_scattering(
            Lognormal(0.5e-6, 1.5), 1.4 - 0j, 532e-9, angle=np.degrees(default_angles())
        )

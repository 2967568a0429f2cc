"""Mie scattering against an independent series."""

import numpy as np
import pytest
from scipy.special import spherical_jn, spherical_yn

from lidarops.simulate._checks import SimulationInputError
from lidarops.simulate.mie import Lognormal, lognormal_scattering, tropospheric_scattering


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
    # Few angles, because the cross sections do not depend on them.
    angle = np.array([0.0, 0.5 * np.pi, np.pi])
    sphere = lognormal_scattering(Lognormal(radius, width), index, wavelength, angle=angle)
    extinction, scattering, back = series(index, x)
    area = np.pi * radius**2
    assert sphere.extinction == pytest.approx(area * extinction, rel=1e-4)
    assert sphere.scattering == pytest.approx(area * scattering, rel=1e-4)
    expected = 4.0 * np.pi * extinction / back
    assert sphere.lidar_ratio == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("radius", "index", "asymmetry", "albedo", "back", "ratio"),
    [
        (0.5e-6, 1.45 - 0.005j, 0.719, 0.924, 0.475, 28.7),
        (1.0e-6, 1.45 - 0.005j, 0.794, 0.858, 0.425, 34.5),
        (0.5e-6, 1.53 - 0.008j, 0.695, 0.876, 1.22, 11.7),
    ],
)
def test_lognormal_aerosol_at_532_nm(radius, index, asymmetry, albedo, back, ratio):
    # Few angles, because the values do not depend on the others.
    angle = np.array([0.0, 0.5 * np.pi, np.pi])
    scattering = lognormal_scattering(Lognormal(radius, 1.5), index, 532e-9, angle=angle)
    assert scattering.asymmetry == pytest.approx(asymmetry, abs=1e-3)
    assert scattering.single_scattering_albedo == pytest.approx(albedo, abs=1e-3)
    assert scattering.phase_function[-1] == pytest.approx(back, rel=0.03)
    assert scattering.lidar_ratio == pytest.approx(ratio, rel=0.03)


def test_tropospheric_aerosol_of_one_micrometre():
    scattering = tropospheric_scattering(532e-9)
    # Median diameter 1 micrometre: forward peak, and the values of the first case above.
    assert scattering.asymmetry == pytest.approx(0.719, abs=1e-3)
    assert scattering.lidar_ratio == pytest.approx(28.7, rel=0.03)
    assert scattering.phase_function[0] > 100 * scattering.phase_function[-1]
    cosine = np.cos(scattering.angle)
    whole = -0.5 * np.trapezoid(scattering.phase_function, cosine)
    assert whole == pytest.approx(1.0, abs=1e-3)
    mean = -0.5 * np.trapezoid(scattering.phase_function * cosine, cosine)
    assert mean == pytest.approx(scattering.asymmetry, abs=2e-3)
    with pytest.raises(SimulationInputError, match="wavelength"):
        tropospheric_scattering(532.0)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((Lognormal(0.5e-6, 1.5), 1.45 - 0.005j, 532.0), "wavelength"),
        ((Lognormal(0.5e-6, 1.5), 1.45 + 0.005j, 532e-9), "refractive_index"),
    ],
)
def test_impossible_input_is_refused(arguments, field):
    with pytest.raises(SimulationInputError) as caught:
        lognormal_scattering(*arguments)
    assert caught.value.field == field


def test_impossible_sizes_and_angles_are_refused():
    with pytest.raises(SimulationInputError, match="metres"):
        Lognormal(0.5, 1.5)
    with pytest.raises(SimulationInputError, match="between 1 and 5"):
        Lognormal(0.5e-6, 0.5)
    with pytest.raises(SimulationInputError, match="0 to pi"):
        lognormal_scattering(
            Lognormal(0.5e-6, 1.5), 1.4 - 0j, 532e-9, angle=np.linspace(0.0, 180.0, 181)
        )

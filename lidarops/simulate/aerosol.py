"""Aerosol models: the components of the standard radiation atmosphere and their mixtures.

Sizes and volume shares are those of `sra1984`; they give the number fractions that `wmo1986`
prints. The refractive indices are the usual ones at 550 nm, from memory and not verified against
a source: take lidar ratios that follow from them as examples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RetrievalInputError
from lidarops.simulate.mie import Lognormal, Scattering, lognormal_scattering, mixed

Array = NDArray[np.float64]


class Component(StrEnum):
    """Basic components."""

    DUST_LIKE = "dust_like"
    WATER_SOLUBLE = "water_soluble"
    OCEANIC = "oceanic"
    SOOT = "soot"


class Mixture(StrEnum):
    """Aerosol types that are mixed of the components."""

    CONTINENTAL = "continental"
    URBAN = "urban"
    MARITIME = "maritime"


@dataclass(frozen=True, slots=True)
class Properties:
    """What a component is made of."""

    sizes: Lognormal
    refractive_index: complex
    """At 550 nm; not verified."""


PROPERTIES: Final = {
    Component.DUST_LIKE: Properties(Lognormal(0.5e-6, 2.99), 1.53 - 0.008j),
    Component.WATER_SOLUBLE: Properties(Lognormal(0.005e-6, 2.99), 1.53 - 0.006j),
    Component.OCEANIC: Properties(Lognormal(0.3e-6, 2.51), 1.381 - 4.3e-9j),
    Component.SOOT: Properties(Lognormal(0.0118e-6, 2.0), 1.75 - 0.44j),
}

VOLUME_PERCENT: Final = {
    Mixture.CONTINENTAL: {
        Component.DUST_LIKE: 70.0,
        Component.WATER_SOLUBLE: 29.0,
        Component.SOOT: 1.0,
    },
    Mixture.URBAN: {
        Component.DUST_LIKE: 17.0,
        Component.WATER_SOLUBLE: 61.0,
        Component.SOOT: 22.0,
    },
    Mixture.MARITIME: {Component.WATER_SOLUBLE: 5.0, Component.OCEANIC: 95.0},
}

TROPOSPHERIC: Final = Properties(Lognormal(0.5e-6, 1.5), 1.45 - 0.005j)
"""Particles with a median diameter of 1 um, as the paper on the lidar equation shows them
(`vasylkivskyi2022`; the width and the refractive index are not printed there, and are ours)."""


def number_fractions(mixture: str) -> dict[Component, float]:
    r"""Return the number fractions of the components of a mixture, 1.

    Parameters
    ----------
    mixture : {"continental", "urban", "maritime"}

    Raises
    ------
    RetrievalInputError
        For another name.

    Notes
    -----
    :math:`n_i \\propto v_i / V_i` with the volume shares v and the mean volume V of a particle.

    References
    ----------
    `sra1984`; the fractions agree with the table of `wmo1986` to all digits.
    """
    try:
        shares = VOLUME_PERCENT[Mixture(mixture)]
    except ValueError:
        raise RetrievalInputError(
            f"is {mixture!r}", field="mixture", remedy=f"choose one of {', '.join(Mixture)}"
        ) from None
    numbers = {part: share / PROPERTIES[part].sizes.volume for part, share in shares.items()}
    total = math.fsum(numbers.values())
    return {part: number / total for part, number in numbers.items()}


def mixture_scattering(mixture: str, wavelength: float) -> Scattering:
    """Return how a mixture scatters, with the refractive indices of 550 nm.

    Parameters
    ----------
    mixture : {"continental", "urban", "maritime"}
    wavelength : float, m

    Raises
    ------
    RetrievalInputError
        For another name, or a wavelength that is not in m.
    """
    return mixed(
        [
            (
                fraction,
                lognormal_scattering(
                    PROPERTIES[part].sizes, PROPERTIES[part].refractive_index, wavelength
                ),
            )
            for part, fraction in number_fractions(mixture).items()
        ]
    )


def tropospheric_scattering(wavelength: float) -> Scattering:
    """Return how tropospheric aerosol of 1 um scatters; see `TROPOSPHERIC`.

    Parameters
    ----------
    wavelength : float, m

    Raises
    ------
    RetrievalInputError
        For a wavelength that is not in m.
    """
    return lognormal_scattering(TROPOSPHERIC.sizes, TROPOSPHERIC.refractive_index, wavelength)

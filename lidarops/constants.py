"""Physical and format constants, each with its unit and source."""

from __future__ import annotations

from datetime import timedelta
from typing import Final

SPEED_OF_LIGHT: Final = 299_792_458.0
"""m s-1, exact (SI)."""

PLANCK: Final = 6.62607015e-34
"""J s, exact (SI)."""
EARTH_RADIUS: Final = 6_371_008.8
"""m, mean radius of the ellipsoid WGS 84."""
BEAM_CURVATURE: Final = 0.17
"""Curvature of a near-horizontal beam by refraction over that of the Earth: minus the radius times
the vertical gradient of the refractive index, -2.67e-8 m-1 at 532 nm and sea level in the standard
atmosphere (`us1976`, `bodhaine1999`)."""
EFFECTIVE_RADIUS: Final = EARTH_RADIUS / (1.0 - BEAM_CURVATURE)
"""m, radius of an Earth over which bent beams are straight."""

LICEL_RANGE_PER_MICROSECOND: Final = 150.0
"""m. Licel converts counts to MHz with this nominal value, not with c / 2 (`licel2023`)."""

DEFAULT_DEAD_TIME: Final = 4.0e-9
"""s. Assumed for noise and flags where the campaign gives no dead time; never used to correct."""
DEAD_TIME_UNCERTAINTY: Final = 0.2
"""Relative standard error of a dead time whose campaign gives none."""

CUBIC_PAPER: Final = (
    "Bobrovsky, A. P. et al. (2024): Transparent measurement of low turbidity atmosphere using"
    " lidar systems (in Russian)."
)
"""The papers whose methods products use, as the products cite them; `docs/papers`."""
LEAST_SQUARES_PAPER: Final = (
    "Potapova, I. A. et al. (2021), J. Instrum. Eng. 64, 384-391 (in Russian),"
    " doi:10.17586/0021-3454-2021-64-5-384-391."
)
MULTIANGLE_PAPER: Final = (
    "Gobrusenko, K. I. and Ivanenko, B. P. (1989): Restoring the optical depth of the atmosphere"
    " from multiangle lidar sensing (in Russian), Optika Atmosfery 2 (8); Atmos. Opt. 2, 741-743."
)
MULTIPOSITION_PAPER: Final = (
    "Drabenko, Vad. A. et al. (2021): Reducing the systematic error in measuring the meteorological"
    " visibility range with multiposition lidar sounding (in Russian),"
    " doi:10.54092/25421085_2021_10_60."
)
LIDAR_EQUATION_PAPER: Final = (
    "Vasylkivskyi, I. V. et al. (2009): Analysis of the equation of laser sensing of the atmosphere"
    " with lidar (in Ukrainian), Visnyk of Vinnytsia Polytechnic Institute."
)
KNOWN_SHAPE_PAPERS: Final = f"{LEAST_SQUARES_PAPER}\n{LIDAR_EQUATION_PAPER}"
"""Of a background fitted with the shape of clean air, for the products in which that runs."""
STEEPEST: Final = 80.0
"""degree; largest zenith angle at which a beam reaches aerosol-free air."""
HIGHEST_CLOUD: Final = 20_000.0
"""m; clouds of the tropics end below."""
DARK_REACH: Final = timedelta(hours=24)
"""Longest time between a scene and the dark files that it uses."""
FIXED: Final = 0.05
"""degree; largest difference between the zenith angles of the files of a fixed beam."""
LEAST_SPREAD: Final = 5.0
"""degree; smallest span of zenith angles of a scan."""

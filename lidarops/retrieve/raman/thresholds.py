"""Thresholds of the Raman retrieval, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Limits of fit, smoothing and ratios."""

    rougher_share: float = 0.1
    """Share of the likelihood of all weights of smoothness below the one that is used. Simulations
    with 30 counts a bin at 1 km (`tests/retrieve/raman/test_raman_coverage.py`): 95 % intervals
    cover 95 %; with the most likely weight, 85 %."""
    walk_share: float = 0.2
    """The same for the weight from which the errors by resolution follow. In the same simulations,
    intervals cover 95 to 96 %; with the weight that is used, up to 96.1 %, with a share of 0.3 down
    to 94.0 %."""
    typical_lidar_ratio: float = 50.0
    """sr, by which extinction helps to decide whether backscatter is certain enough for a lidar
    ratio. Decided by backscatter alone, lidar ratios of few counts are too small on average: those
    are kept whose backscatter is too high by noise."""
    plausible_lidar_ratios: tuple[float, float] = (20.0, 120.0)
    """sr, least and greatest of the profile, by which extinction is weighted in that decision; 120
    where its backscatter is not above zero. Assumed. With 50 sr for all profiles, selection makes
    lidar ratios of 90 sr of few counts too small by 10 %, instead of 3 %
    (`tests/retrieve/raman/test_raman_coverage.py`)."""
    lidar_ratio_spread: float = 0.45
    """Standard deviation of the logarithm of true lidar ratios about the typical one, by which the
    errors of uncertain ones are stated: 95 percent from 21 to 121 sr, the plausible ones. In 1,200
    skies of ``benchmarks stability``, 95 and 68 percent intervals cover 96.4(4) and 73.2(9)
    percent, and 0.01(6) percent are off by more than 4 errors; with errors of the first order,
    93.5(5), 77.0(8) and 0.30(6). With 0.4, 95 percent intervals cover 86 instead of 89 percent of
    lidar ratios above 80 sr; with 0.5, 68 percent intervals cover 75 percent of all."""
    overlap_scales: tuple[float, ...] = (0.3, 1.0)
    """Scales over which what overlap lacks falls, over the range where it is stated to be full. Of
    5 percent that fall over 50 m or more, .01 percent of extinctions are off by more than 4 errors,
    with one of the scales .03 and .07 percent (skies of ``benchmarks stability``)."""
    standard_slope_error: float = 1.6e-5
    """m-1, of the derivative of the logarithm of the density of the standard atmosphere: root mean
    square from 0.1 to 12 km of its deviation from the sounding of Manaus
    (`tests/end_to_end/test_raman.py`), 16 K warmer."""
    sounding_slope_error: float = 2e-6
    """m-1, the same of a sounding or model: 0.5 K over 1 km. Assumed."""
    many_counts: float = 1000.0
    """Counts of a cell from which on the stated variance tells more than that of counts: it then
    shows the effect of the dead time beyond its own scatter of 3 %."""


THRESHOLDS: Final = Thresholds()

"""Measured shares of false values, as `docs/_extensions/measured_shares.py` writes them.

By quantity and class of simulated scenes: percent of the values that differ by more than 4 stated
errors, and the standard error of that. `false_shares` puts them into words.
"""

from __future__ import annotations

from typing import Final

SHARES: Final[dict[tuple[str, str], tuple[float, float]]] = {
    ("background", "outliers"): (0, 0.0075),
    ("background", "slope of the backscatter along the section"): (0.52, 0.055),
    ("background", "bent backscatter"): (5.09, 0.47),
    ("background", "plume"): (1.06, 0.13),
    ("background", "overlap error"): (0.014, 0.021),
    ("background", "eddies"): (0.277, 0.075),
    ("background", "afterpulse"): (2.66, 0.24),
    ("background", "saturated"): (0.0688, 0.1),
    ("background", "detector not linear"): (0.0172, 0.013),
    ("extinction", "outliers"): (0, 0.0075),
    ("extinction", "slope of the backscatter along the section"): (5.54, 0.76),
    ("extinction", "bent backscatter"): (2.67, 0.28),
    ("extinction", "plume"): (9.68, 0.4),
    ("extinction", "overlap error"): (0.407, 0.09),
    ("extinction", "eddies"): (0.101, 0.033),
    ("extinction", "afterpulse"): (0.674, 0.13),
    ("extinction", "saturated"): (9.02, 0.85),
    ("extinction", "detector not linear"): (0.0915, 0.026),
    ("background, known shape", "shape of hazy air"): (10.7, 2),
    ("background, mean of the tail", "mean of a tail with signal in it"): (0.0315, 0.074),
    ("count rate", "dead time off by 10 %"): (0.0154, 0.039),
    ("count rate", "paralyzable counter"): (0, 0.044),
    ("voltage", "analog noise below half a step"): (57.4, 4),
    ("voltage", "analog near full scale"): (0.023, 0.034),
    ("voltage of a bin", "analog noise below half a step, a single bin"): (0.0267, 0.048),
    ("background", "near the cut"): (0.292, 0.047),
    ("backscatter", "more haze than stated"): (5.61, 2.2),
    ("network", "plume, blocks of 1"): (0.345, 0.22),
    ("network", "layered, blocks of 1"): (0.612, 0.77),
    ("network", "lidar ratio, 2 % declared"): (2.76, 1.5),
    ("network", "lidar ratio, 10 % declared"): (1.24, 1.2),
}

"""Measured shares of false values, as `docs/_extensions/measured_shares.py` writes them.

By quantity and class of simulated scenes: percent of the values that differ by more than 4 stated
errors, and the standard error of that. `false_shares` puts them into words.
"""

from __future__ import annotations

from typing import Final

SHARES: Final[dict[tuple[str, str], tuple[float, float]]] = {
    ("background", "outliers"): (0, 0.028),
    ("background", "slope of the backscatter along the section"): (0.633, 0.13),
    ("background", "bent backscatter"): (5.28, 1.3),
    ("background", "plume"): (0.922, 0.21),
    ("background", "overlap error"): (0, 0.073),
    ("background", "eddies"): (0.532, 0.24),
    ("background", "afterpulse"): (2.85, 0.68),
    ("background", "saturated"): (0.374, 0.38),
    ("background", "detector not linear"): (0, 0.031),
    ("extinction", "outliers"): (0, 0.028),
    ("extinction", "slope of the backscatter along the section"): (6.13, 1.6),
    ("extinction", "bent backscatter"): (2.69, 0.72),
    ("extinction", "plume"): (11.5, 0.9),
    ("extinction", "overlap error"): (0.514, 0.25),
    ("extinction", "eddies"): (0.0665, 0.066),
    ("extinction", "afterpulse"): (0.81, 0.37),
    ("extinction", "saturated"): (7.87, 1.8),
    ("extinction", "detector not linear"): (0.0942, 0.048),
    ("background, known shape", "shape of hazy air"): (9.9, 1.2),
    ("background, mean of the tail", "mean of a tail with signal in it"): (0.0348, 0.02),
    ("count rate", "dead time off by 10 %"): (0.0173, 0.0099),
    ("count rate", "paralyzable counter"): (0, 0.0057),
    ("voltage", "analog noise below half a step"): (61.5, 2.4),
    ("voltage", "analog near full scale"): (0.0266, 0.015),
    ("voltage of a bin", "analog noise below half a step, a single bin"): (0.01, 0.0071),
    ("background", "near the cut"): (0.257, 0.054),
    ("network", "plume, blocks of 1"): (0.326, 0.14),
    ("network", "layered, blocks of 1"): (0.365, 0.21),
    ("network", "lidar ratio, 2 % declared"): (4.55, 1.5),
    ("network", "lidar ratio, 10 % declared"): (0.441, 0.31),
}

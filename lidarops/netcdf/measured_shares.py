"""Measured shares of false values, as `docs/_extensions/measured_shares.py` writes them.

By quantity and class of simulated scenes: percent of the values that differ by more than 4 stated
errors, and the standard error of that. `false_shares` puts them into words.
"""

from __future__ import annotations

from typing import Final

SHARES: Final[dict[tuple[str, str], tuple[float, float]]] = {
    ("background", "outliers"): (0.0125, 0.0035),
    ("background", "slope of the backscatter along the section"): (0.483, 0.025),
    ("background", "bent backscatter"): (4.81, 0.19),
    ("background", "plume"): (1.02, 0.048),
    ("background", "overlap error"): (0.0107, 0.0053),
    ("background", "eddies"): (0.269, 0.031),
    ("background", "afterpulse"): (2.32, 0.099),
    ("background", "saturated"): (0.0395, 0.023),
    ("background", "detector not linear"): (0.00922, 0.0032),
    ("extinction", "outliers"): (0.00626, 0.0025),
    ("extinction", "slope of the backscatter along the section"): (6.87, 0.38),
    ("extinction", "bent backscatter"): (2.52, 0.12),
    ("extinction", "plume"): (9.71, 0.16),
    ("extinction", "overlap error"): (0.432, 0.039),
    ("extinction", "eddies"): (0.107, 0.018),
    ("extinction", "afterpulse"): (0.455, 0.046),
    ("extinction", "saturated"): (7.96, 0.35),
    ("extinction", "detector not linear"): (0.0887, 0.011),
    ("background, known shape", "shape of hazy air"): (9.05, 1),
    ("voltage", "analog noise below half a step"): (62.4, 2.1),
    ("background", "near the cut"): (0.256, 0.054),
    ("backscatter", "more haze than stated"): (9.2, 1.4),
    ("lidar ratio", "model holds"): (0.0901, 0.16),
    ("scans", "layer"): (0.282, 0.049),
    ("scans", "layer, blocks of 2"): (0.124, 0.027),
    ("network", "plume, blocks of 1"): (0.471, 0.16),
    ("network", "layered, blocks of 1"): (0.449, 0.18),
    ("network", "lidar ratio, 2 % declared"): (3.9, 1.3),
    ("network", "lidar ratio, 10 % declared"): (0.508, 0.33),
}

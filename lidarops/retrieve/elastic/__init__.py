"""Particle backscatter and extinction from an elastic lidar, in four steps.

1. `bridge_outliers` replaces isolated outlying bins.
2. `find_layers` detects clouds.
3. `choose_reference` selects the window where a profile has the shape of particle-free air, among
   `candidate_windows`.
4. `invert_elastic` solves the lidar equation from that window (Fernald, Sasano), with an error
   budget.

`labeled.invert_elastic` subtracts the background and runs these steps on `xarray` data; import
it from its module, so that the numerics stay free of xarray.
"""

from lidarops.retrieve.air.reference_window import (
    ReferenceWindow,
    Rejection,
    candidate_windows,
    choose_reference,
)
from lidarops.retrieve.elastic.inversion import (
    ElasticResult,
    ErrorBudget,
    invert_elastic,
)
from lidarops.retrieve.elastic.layers import Layers, find_layers
from lidarops.retrieve.elastic.outlying_bins import BridgedProfiles, bridge_outliers

__all__ = [
    "BridgedProfiles",
    "ElasticResult",
    "ErrorBudget",
    "Layers",
    "ReferenceWindow",
    "Rejection",
    "bridge_outliers",
    "candidate_windows",
    "choose_reference",
    "find_layers",
    "invert_elastic",
]

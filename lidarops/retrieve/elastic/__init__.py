"""Particle backscatter and extinction from an elastic lidar, in three steps.

1. `lidarops.retrieve.clouds` replaces isolated outlying bins and detects clouds.
2. `choose_reference` selects the window where a profile has the shape of particle-free air, among
   `candidate_windows`.
3. `invert_elastic` solves the lidar equation from that window (Fernald, Sasano), with an error
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

__all__ = [
    "ElasticResult",
    "ErrorBudget",
    "ReferenceWindow",
    "Rejection",
    "candidate_windows",
    "choose_reference",
    "invert_elastic",
]

"""Particle backscatter and extinction from an elastic lidar, in three steps.

1. `lidarops.retrieve.clouds` replaces isolated outlying bins and detects clouds.
2. `lidarops.retrieve.air.reference_window` selects the window where a profile has the shape of
   particle-free air.
3. `invert_elastic` solves the lidar equation from that window (Fernald, Sasano), with an error
   budget.

`labeled.invert_elastic` subtracts the background and runs these steps on `xarray` data; import
it from its module, so that the numerics stay free of xarray.
"""

from lidarops.retrieve.elastic.inversion import ElasticResult, invert_elastic

__all__ = ["ElasticResult", "invert_elastic"]

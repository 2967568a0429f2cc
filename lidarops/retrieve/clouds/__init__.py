"""Outlying bins and clouds of elastic signals, which several retrievals share.

1. `bridge_outliers` replaces isolated outlying bins.
2. `find_layers` detects clouds.
3. `find_visible_air` finds where noise would hide one.

`labeled.signal_and_clouds` subtracts the background of mean profiles and finds the clouds of the
means and of their parts; import it from its module, so that the numerics stay free of xarray.
"""

from lidarops.retrieve.clouds.layers import find_layers, find_visible_air
from lidarops.retrieve.clouds.outlying_bins import BridgedProfiles, bridge_outliers

__all__ = ["BridgedProfiles", "bridge_outliers", "find_layers", "find_visible_air"]

"""Numerics of the retrievals: arrays in, arrays out, with numpy, scipy and numba only.

`homogeneous`, `elastic`, `raman`, `multiangle` and `network` are retrievals, independent of each
other. They share `signal` (raw counts to signals), `background`, `clouds`, `air` (molecules,
visibility) and `common` (input checks). The modules `labeled*` do the same on `xarray` data.
"""

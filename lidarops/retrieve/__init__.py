"""Numerics of the retrievals: arrays in, arrays out, with numpy, scipy and numba only.

Each package is one retrieval, independent of the others: `homogeneous`, `elastic`, `multiangle`,
`network`. They share `signal` (raw counts to signals), `background`, `air` (molecules, visibility)
and `common` (input checks). The modules named `labeled` do the same on `xarray` data.
"""

from lidarops.retrieve.common.compiled_code import keep_apart

# Before any function is compiled.
keep_apart()

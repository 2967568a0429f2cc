"""Numerics: arrays in, arrays out; numpy, scipy and numba only (but `labeled`)."""

from lidarops.retrieve.common.compiled_code import keep_apart

# Before any function is compiled.
keep_apart()

"""Numerics: arrays in, arrays out; numpy, scipy and numba only (but `labeled`)."""

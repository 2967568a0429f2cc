"""Kinds of product, one folder each: the table of their NetCDF variables and texts."""

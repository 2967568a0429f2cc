"""NetCDF products: what they hold, how they are built, written and traced."""

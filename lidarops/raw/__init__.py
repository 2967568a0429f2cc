"""Raw formats: one module each, and the xarray engine over them."""

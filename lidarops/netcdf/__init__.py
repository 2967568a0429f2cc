"""NetCDF product files: describe variables, build, write and read.

`variables` holds rows and layouts that all kinds share, `build` makes the encoded dataset, `write`
is the only writer, `read` reads fast, and `provenance` records the origin of a product.
"""

"""NetCDF product files: describe variables, build, write and read.

`variables` holds rows and layouts that all kinds share, `build` encodes profiles, `product_file`
writes a product some profiles at a time, `write` is the only writer of files, `read` reads fast,
and `provenance` records the origin of a product.
"""

"""NetCDF product files: describe variables, encode, write, read and compare.

`variables` and `quantities` hold rows and layouts, `context` what a product states besides numbers
and its provenance, `product_file` encodes and writes a product some profiles at a time, `write` is
the only writer of files, and `read` opens them.
"""

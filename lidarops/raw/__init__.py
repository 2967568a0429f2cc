"""Raw formats: from the bytes of a file to an xarray Dataset.

The modules in reading order. For every format:

1. `header`: header and channels of a file of any format.
2. `formats`: the one place where raw files are opened; what a raw format is, and the registry that
   finds it by entry point.
3. `archive`: many files as one dask-backed Dataset, `open_archive`: names, attributes and
   coordinates of raw data in xarray.

For Licel files:

4. `licel_header`: bytes to `Header` and `Dataset`.
5. `licel_format`: header to counts, the format ``licel`` of the registry.
6. `licel`: header and counts of a file, and both to bytes. The public functions of the format.
7. `backend`: one file as a lazy Dataset, the xarray engine ``licel``.
"""

"""Raw formats: from the bytes of a file to an xarray Dataset.

The modules in reading order, for Licel files:

1. `licel_header`: bytes to `Header` and `Dataset` records.
2. `licel`: header to counts, counts to physical arrays (mV and MHz). The public functions of the
   format.
3. `licel_write`: numbers to header text, counts to bytes.
4. `model`: names, attributes and coordinates of raw data in xarray.
5. `backend`: one file as a lazy Dataset, the xarray engine ``licel``.
6. `archive`: many files as one dask-backed Dataset, `open_archive`.
"""

"""The catalog of raw files and the ledger of products, in one SQL database per campaign.

- `scan`: lists an archive, reads the headers of new files into rows (`raw_files`) and updates the
  catalog.
- `store`: the database that the other packages use: the ledger of runs, products and their inputs,
  on top of `granules` (raw files) and `database` (tables, connection and transactions).
- `lock`: one writer at a time.
- `product_files`: keeps replaced versions of products, removes temporary files, compares products
  and inputs with the digests in the ledger, and copies products to an object store.
"""

"""The catalog of raw files and the ledger of products, in one SQL database per campaign.

- `scan`: lists an archive (`sources`), reads the headers of new files (`headers`) and updates the
  catalog.
- `store`: the database that the other packages use, made of `database` (connection and
  transactions), `granules` (raw files) and `ledger` (runs, products and their inputs).
- `schema`: the tables; `rows`: granules as rows of a table.
- `lock`: one writer at a time.
- `versions`: keeps replaced versions of products.
- `verify`: compares products and inputs with the digests in the ledger.
"""

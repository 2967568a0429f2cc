"""The catalog of raw files and the ledger of products."""

"""Error against run time of every retrieval, beside peers."""

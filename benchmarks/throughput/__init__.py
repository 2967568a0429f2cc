"""Time of retrievals (`retrievals`), and peak memory of processes (`memory`)."""

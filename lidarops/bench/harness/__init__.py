"""Shared by all benchmarks: `benchmark` (arguments and output), `timing`, `results` (JSON)."""

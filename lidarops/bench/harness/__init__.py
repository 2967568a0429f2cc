"""Shared by all benchmarks: `terms` (arguments and output), `timing`, `results` (JSON)."""

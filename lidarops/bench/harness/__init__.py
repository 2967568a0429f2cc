"""Shared by all benchmarks: `benchmark` (effort, page), `rows` (tables, charts), `timing`, JSON."""

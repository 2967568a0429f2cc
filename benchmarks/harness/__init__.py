"""Shared by all benchmarks: `results` (tables, JSON, page), `plots`, `statistics`, `timing`."""

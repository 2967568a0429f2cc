"""Shared by all benchmarks: `rows` (results, tables, page), `statistics`, `costs`, `timing`."""

"""Shared by all benchmarks: `figure` (numbers), `plots`, `results` (tables, JSON, page)."""

"""Shared by all benchmarks: `figure` (numbers), `rates`, `plots`, `results` (tables, JSON)."""

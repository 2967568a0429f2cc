"""Benchmarks: error against run time, stability, throughput."""

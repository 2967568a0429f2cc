"""Benchmarks, ``python -m benchmarks``: accuracy, stability and throughput.

A benchmark is a function that returns a `Study`: rows of (case, method, quantity, value) in tables
with notes and charts. `accuracy` compares retrievals with a known truth, `stability` counts false
values without a flag, `throughput` measures time and memory, all of the scenes in `scenes`.
"""

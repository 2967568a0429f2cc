"""Benchmarks, ``python -m benchmarks``: accuracy, stability and throughput.

A benchmark is a function that returns a `Study`: rows of (case, method, quantity, value) in
chapters with texts and charts, of which `harness` makes page and JSON. `registry` maps names to
benchmarks. `accuracy` compares retrievals with a known truth, `stability` counts false values
without a flag, `throughput` measures time. `all_retrievals` puts error against run time of all
retrievals on one page.
"""

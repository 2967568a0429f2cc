"""Benchmarks of ``lidarops bench``: accuracy, stability and throughput.

`registry` maps names to benchmarks and writes their results. `accuracy` compares retrievals with
a known truth, `stability` counts crashes and false values without a flag, `throughput` measures
time. `harness` holds what they share. `all_retrievals` and `overview` put error against run time
of all retrievals on one page.
"""

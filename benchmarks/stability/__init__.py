"""The stability benchmark: false values without a flag in random scenes.

`random_scenes` counts them; the scenes of each retrieval are in ``random_*``. `random_light` counts
profiles whose light is told wrongly, `flag_rates` flags that are needless or decide alone, and
`reproducibility` how far order and machine change values.
`study` runs all, with targets. Stiff cases are tests.
"""

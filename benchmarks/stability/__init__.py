"""The stability benchmark: false values without a flag in random scenes.

`study` runs all, with targets. `flag_rates` counts flags that are needless or decide alone, and
`reproducibility` how far order and machine change values. Stiff cases are tests.
"""

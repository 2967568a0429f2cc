"""The stability benchmark: false values without a flag in random scenes.

`random_scenes` counts them; the scenes of each retrieval are in ``random_*``. `study` runs all.
Stiff cases are tests.
"""

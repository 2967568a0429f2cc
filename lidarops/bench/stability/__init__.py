"""The stability benchmark of the retrievals.

It has two halves. `stiff_cases` defines cases with difficult input and known answers; the cases
of each retrieval are in ``stiff_*``. `random_scenes` counts false values without a flag in random
scenes; the scenes of each retrieval are in ``random_*``. `study` runs both, `stability_report`
makes the page.
"""

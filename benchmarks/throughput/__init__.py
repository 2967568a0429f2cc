"""Time and memory of retrievals, readers, archives and whole campaigns.

`retrievals` and `readers` time single functions. `archives` times runs over
archives of many scenes, most of them stand-ins (`stand_in_archives`). `campaigns` times all stages
of simulated campaigns, and `memory` measures the peak of processes.
"""

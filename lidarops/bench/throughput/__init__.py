"""Time and memory of kernels, readers, archives and whole campaigns.

`retrievals`, `scan_kernels` and `readers` time single functions. `archives` times runs over
archives of many scenes, most of them stand-ins (`stand_in_archives`). `campaigns` times all
stages of simulated campaigns, and `orchestration` workers and flows. `cost_calibration` fits the
cost model of ``lidarops plan``.
"""

"""Time and memory of retrievals, readers and whole campaigns.

`retrievals`, `raman_night` and `readers` time single functions. `campaigns` times all stages of
simulated campaigns, and `memory` measures the peak of processes.
"""

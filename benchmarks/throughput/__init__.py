"""Time and memory of retrievals and whole campaigns.

`retrievals` times single functions. `campaigns` times all stages of processing and their growth
with the size of a campaign, `memory` measures peaks of processes.
"""

"""Time and memory of kernels, readers, archives and whole campaigns.

`retrievals`, `scan_kernels`, `networks` and `readers` time single functions; their pages are in
`retrieval_reports`. `archives` times runs over archives of many scenes, most of them stand-ins
(`stand_in_archives`). `campaigns` times all stages of simulated campaigns, `memory` measures the
peak of processes, and `orchestration` workers and flows.
"""

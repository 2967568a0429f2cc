"""Bring the archive of a campaign up to date.

- `scenes` cuts granules into scenes, without what `outlying_headers` finds, and names the refused
  files of each; `day_states` knows what has changed on a day, and the names of channels.
- `archive`: catalog, plan, process and report; what the command line and the flows call.
- `options`: how to run and which part of the campaign, and what a run returns.
- `staleness`: decides which products are stale, and why; `leftovers`: scenes without product, and
  products that the campaign no longer requests.
- `executor`: processes scenes, in this process or on dask workers; `clusters` starts or reaches
  such workers on this machine, Slurm or Kubernetes.
- `ledger_run`: enters one run in the ledger, scene by scene, and products that the ledger lacks.
- `reproduction`: makes one product again from its provenance.
"""

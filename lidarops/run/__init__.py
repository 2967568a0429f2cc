"""An archive brought up to date: what is stale, runs, clusters, reproduction, publication."""

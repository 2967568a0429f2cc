"""Prefect flows over lidarops: thin, no logic of their own.

Importing this package sets what an ephemeral Prefect server needs on a machine without any
set-up, and what the reaper of dead runs relies on; a value in the environment wins.
"""

from __future__ import annotations

import os
from typing import Final

WITH_FAILURES: Final = "Completed with failures"
"""Name of the state of a run that did all it could, of an archive in which not all is well.

Its event is ``prefect.flow-run.Completed with failures``: Prefect names events after states.
"""

# Prefect gives its own server 20 s to start, which a busy machine exceeds.
os.environ.setdefault("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "120")
# A station may have no network, and reprocessing is nobody else's business.
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
os.environ.setdefault("DO_NOT_TRACK", "1")
# s; what `flows.maintenance` judges a run by. Prefect's own 180 would block a schedule for longer.
os.environ.setdefault("PREFECT_FLOWS_HEARTBEAT_FREQUENCY", "30")
# What a server for the time of one run, without deployments, does not need to look after.
for _service in (
    "CANCELLATION_CLEANUP",
    "CLEANUP_RECONCILER",
    "FOREMAN",
    "LATE_RUNS",
    "PAUSE_EXPIRATIONS",
    "REPOSSESSOR",
    "SCHEDULER",
    "TRIGGERS",
):
    os.environ.setdefault(f"PREFECT_SERVER_SERVICES_{_service}_ENABLED", "false")

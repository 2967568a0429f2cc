"""Prefect flows that call lidarops and add no logic of their own.

- `reprocess`: bring the products of a campaign up to date.
- `catalog`: update the catalog only.
- `maintenance`: end runs whose process is dead, without a flow.
- `start`: what a flow does before its work.
- `notifications`: set up automations that report failed or missing runs.

Importing this package sets the environment variables that a temporary Prefect server needs and that
`maintenance` relies on; variables that are already set are kept. Where no server is configured, it
also gives the temporary one a password. Numerical libraries use one thread, as in the command line.
"""

from __future__ import annotations

import importlib.util
import os
import secrets
from typing import Final

from lidarops.system import use_one_thread

if importlib.util.find_spec("prefect") is None:
    raise ImportError(
        "flows need Prefect: pip install lidarops[prefect], or use lidarops reprocess"
    )

WITH_FAILURES: Final = "Completed with failures"
"""State of a run that ended, but with refused files, failed scenes or the like.

Its event is ``prefect.flow-run.Completed with failures``: Prefect names events after states.
"""

NO_FILES: Final = "lidarops.archive.no-files"
"""Event of an instrument whose expected files did not come, e.g. of a missing night."""

use_one_thread()
# By default Prefect waits 20 s for its server to start, too short on a busy machine.
os.environ.setdefault("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "120")
# A station may have no network, and usage data should not leave it.
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
os.environ.setdefault("DO_NOT_TRACK", "1")
# Warnings of the library are part of the log of a run.
os.environ.setdefault("PREFECT_LOGGING_EXTRA_LOGGERS", "lidarops")
# s; `flows.maintenance` ends runs without heartbeat. The default of 180 s would block schedules.
os.environ.setdefault("PREFECT_FLOWS_HEARTBEAT_FREQUENCY", "30")
# Services that a temporary server without deployments does not need.
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


def _lock_temporary_server() -> None:
    """Give a temporary server a random password; any user of the machine reaches its loopback."""
    # After the settings above, which Prefect reads when it is imported.
    from prefect.context import refresh_global_settings_context  # noqa: PLC0415
    from prefect.settings import get_current_settings  # noqa: PLC0415

    settings = get_current_settings()
    if settings.api.url or settings.api.auth_string or settings.server.api.auth_string:
        return
    password = f"lidarops:{secrets.token_urlsafe()}"
    os.environ["PREFECT_API_AUTH_STRING"] = password
    os.environ["PREFECT_SERVER_API_AUTH_STRING"] = password
    refresh_global_settings_context()


_lock_temporary_server()

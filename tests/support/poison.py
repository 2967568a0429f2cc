"""A scene that takes its worker down, on every worker of a cluster, restarted ones too."""

from __future__ import annotations

import os
import signal
from typing import Any

from distributed import WorkerPlugin

from lidarops.run import executor

_attempt = executor.attempt


class Poison(WorkerPlugin):
    """Lets a worker die of one scene."""

    name = "poison"

    def __init__(self, scene: str) -> None:
        self.scene = scene

    def setup(self, worker: Any) -> None:
        """Put the poison into the engine of a worker."""

        def attempt(job: Any) -> Any:
            if job.scene.id == self.scene:
                os.kill(os.getpid(), signal.SIGKILL)
            return _attempt(job)

        executor.attempt = attempt

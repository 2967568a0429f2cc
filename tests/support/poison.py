"""A scene that kills its worker, on every worker of a cluster and on restarted ones."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

from distributed import WorkerPlugin

from lidarops.run import executor

_attempt = executor.attempt
HALF = ".half.nc.0123.tmp"
"""The file that it leaves among the products."""


class Poison(WorkerPlugin):
    """Makes one scene kill its worker."""

    name = "poison"

    def __init__(self, scene: str) -> None:
        self.scene = scene

    def setup(self, worker: Any) -> None:
        """Replace the processing of scenes on a worker."""

        def attempt(job: Any) -> Any:
            if job.scene.id == self.scene:
                half = job.campaign.products_root / HALF
                half.parent.mkdir(parents=True, exist_ok=True)
                half.write_bytes(b"half of a product")
                os.kill(os.getpid(), signal.SIGKILL)
            return _attempt(job)

        executor.attempt = attempt


class Sleep(Poison):
    """Makes one scene hang."""

    name = "sleep"

    def setup(self, worker: Any) -> None:
        """Replace the processing of scenes on a worker."""

        def attempt(job: Any) -> Any:
            if job.scene.id == self.scene:
                time.sleep(3600.0)
            return _attempt(job)

        executor.attempt = attempt

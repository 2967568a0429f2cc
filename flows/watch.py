"""Kill a process when standard input ends: ``python watch.py PROCESS``."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress

if __name__ == "__main__":
    with suppress(ProcessLookupError):
        # Not its number, which another process may have by then.
        watched = os.pidfd_open(int(sys.argv[1]))
        sys.stdin.buffer.read()
        signal.pidfd_send_signal(watched, signal.SIGKILL)

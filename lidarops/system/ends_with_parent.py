"""Loaded first by the server process of `preload_modules`: it ends when its parent is killed.

While that process loads modules, for seconds, it does not see that its parent has gone.
"""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Final

from lidarops.system.processes import PARENT

_PR_SET_PDEATHSIG: Final = 1
"""Of prctl on Linux: the signal that a process gets when its parent dies."""

# Who imports this module has no parent to end with.
_parent = os.environ.pop(PARENT, None)
if _parent is not None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(_parent):
        # It was killed before, for which no signal comes.
        os._exit(1)

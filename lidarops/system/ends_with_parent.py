"""Loaded first by the server process of `preload_modules`: it ends when its parent is killed.

While that process loads modules, for seconds, it does not see that its parent has gone.
"""

from __future__ import annotations

import ctypes
import signal
from typing import Final

_PR_SET_PDEATHSIG: Final = 1
"""Of prctl on Linux: the signal that a process gets when its parent dies."""

ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

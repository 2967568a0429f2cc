"""Lets calls of the system fail now and then: loaded by every Python process whose path names it.

``LIDAROPS_TEST_FAULTS`` is ``SEED RATE FOLDER``: calls on files below the folder fail at that rate,
as disks and networks fail. Without it nothing is changed. ``LIDAROPS_TEST_FAULTS_LOG`` names a file
to which the error of each call that failed is appended.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import random
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

VARIABLE = "LIDAROPS_TEST_FAULTS"
LOG = "LIDAROPS_TEST_FAULTS_LOG"
READING = (errno.EIO, errno.ESTALE, errno.EACCES)
WRITING = (errno.ENOSPC, errno.EIO, errno.ESTALE, errno.EACCES)
_READERS = ("open", "pread", "preadv", "read", "stat", "fstat", "scandir", "listdir")
_WRITERS = ("fsync", "replace", "rename", "mkdir", "unlink", "link", "write")


def install(seed: int, rate: float, root: str) -> None:
    """Let calls of this process on files below a folder fail at a rate."""
    rng = random.Random(f"{seed} {os.getpid()}")
    below = os.path.realpath(root) + os.sep
    active = True

    def concerned(target: Any) -> bool:
        with suppress(OSError, TypeError, ValueError):
            if isinstance(target, int):
                return os.readlink(f"/proc/self/fd/{target}").startswith(below)  # noqa: PTH115
            return os.path.abspath(os.fsdecode(target)).startswith(below)  # noqa: PTH100
        return False

    def failing(function: Callable[..., Any], numbers: tuple[int, ...]) -> Callable[..., Any]:
        def called(*arguments: Any, **options: Any) -> Any:
            nonlocal active
            if active and arguments and rng.random() < rate:
                active = False
                try:
                    hit = concerned(arguments[0])
                    number = rng.choice(numbers)
                    if hit:
                        _note(number)
                finally:
                    active = True
                if hit:
                    raise OSError(number, os.strerror(number), str(arguments[0]))
            return function(*arguments, **options)

        return called

    for name in _READERS:
        setattr(os, name, failing(getattr(os, name), READING))
    for name in _WRITERS:
        setattr(os, name, failing(getattr(os, name), WRITING))
    opened = failing(io.open, READING)
    io.open = builtins.open = opened  # type: ignore[assignment]


def _note(number: int) -> None:
    if log := os.environ.get(LOG):
        with Path(log).open("a") as file:
            file.write(f"{errno.errorcode[number]}\n")


def install_from_environment() -> None:
    """Let calls fail as the variable of the environment says, if there is one."""
    if os.environ.get(VARIABLE):
        seed, rate, root = os.environ[VARIABLE].split(" ", 2)
        install(int(seed), float(rate), root)


install_from_environment()

"""Numerical libraries use one thread, because more of them wait for each other."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidarops.system import ONE_THREAD

THREADS = """
import os, {package}, numpy
numpy.linalg.inv(numpy.eye(500))
print(len(os.listdir("/proc/self/task")))
"""


def threads(package: str, **variables: str) -> int:
    """Return the number of threads of a process that loads a package and solves."""
    others = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    command = [sys.executable, "-c", THREADS.format(package=package)]
    return int(subprocess.check_output(command, env=others | variables, text=True))


@pytest.mark.skipif(
    (os.cpu_count() or 1) < 2 or not Path("/proc/self/task").exists(),
    reason="needs two processors and the files of Linux on threads",
)
@pytest.mark.parametrize("package", ["lidarops.cli", pytest.param("flows", marks=pytest.mark.slow)])
def test_commands_and_flows_solve_in_one_thread_unless_the_environment_says_more(
    package: str,
) -> None:
    if package == "flows":
        pytest.importorskip("prefect")
    assert threads(package) == 1
    assert threads(package, OPENBLAS_NUM_THREADS="2") == 2

"""The command line: each command calls one function of the library.

Exit codes: 0 success, 1 something was refused or failed, 2 wrong use, 3 something does not serve.
"""

# ruff: noqa: E402 - the number of threads is set before numpy is loaded
from lidarops.system import use_one_thread

use_one_thread()

from lidarops.cli import archive, files, many, plan, preparation
from lidarops.cli.app import app

__all__ = ["app", "archive", "files", "many", "plan", "preparation"]

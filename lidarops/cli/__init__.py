"""The command line: each command calls one function of the library.

Exit codes: 0 success, 1 something was refused or failed, 2 wrong use.
"""

# ruff: noqa: E402 - the number of threads is set before numpy is loaded
from lidarops.system import use_one_thread

use_one_thread()

from lidarops.cli import aggregate, archive, files, init, ledger, plan, preparation, site
from lidarops.cli.app import app

__all__ = [
    "aggregate",
    "app",
    "archive",
    "files",
    "init",
    "ledger",
    "plan",
    "preparation",
    "site",
]

"""Commands that are killed and disturbed at random moments lose nothing and write nothing wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

KILLS = int(os.environ.get("LIDAROPS_TEST_KILLS", "12"))
"""1000 take about an hour of CPU time."""


@pytest.mark.slow
@pytest.mark.timeout(86_400)
@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="needs Linux")
def test_kills_and_faults_lose_nothing(tmp_path: Path) -> None:
    # A process of its own: it forks, which one with threads must not.
    command = [sys.executable, str(Path(__file__).with_name("soak.py")), "--folder", str(tmp_path)]
    soaked = subprocess.run(
        [*command, "--kills", str(KILLS)], capture_output=True, text=True, check=False
    )
    assert soaked.returncode == 0, soaked.stderr
    assert sum(json.loads(soaked.stdout.splitlines()[-1])["kills"].values()) == KILLS

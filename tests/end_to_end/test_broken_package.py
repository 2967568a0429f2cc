"""An installed package that cannot be imported costs one line, with its name and the remedy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("group", "command"),
    [
        ("product_kinds", ["--help"]),
        ("product_kinds", ["plan", "campaign.yaml"]),
        ("raw_formats", ["inspect", "file"]),
    ],
)
def test_a_package_that_cannot_be_imported_costs_one_line(
    tmp_path: Path, group: str, command: list[str]
) -> None:
    information = tmp_path / "broken_lidar-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: broken-lidar\nVersion: 1.0\n"
    )
    (information / "entry_points.txt").write_text(f"[lidarops.{group}]\nnovel = broken.part:PART\n")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/__init__.py").touch()
    (tmp_path / "broken/part.py").write_text("PART = 1 / 0\n")
    (tmp_path / "file").write_bytes(b"raw")
    ended = subprocess.run(
        [sys.executable, "-m", "lidarops", *command],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert ended.stdout == ""
    [line] = ended.stderr.splitlines()
    assert line.startswith("error: ")
    assert "'novel' cannot be loaded from broken.part:PART: ZeroDivisionError" in line
    assert line.endswith(
        "(repair or remove the package broken-lidar; python -c 'import broken.part' shows where it"
        " fails)"
    )

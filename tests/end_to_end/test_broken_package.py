"""An installed package that cannot be imported costs one line; a bug of lidarops its traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

GROUPS = pytest.mark.parametrize(
    ("group", "command"),
    [
        ("product_kinds", ["schema"]),
        ("raw_formats", ["inspect", "file"]),
    ],
)


def _run(folder: Path, group: str, entry: str, command: list[str]) -> tuple[int, str]:
    """Return exit code and stderr where an entry point is installed; nothing is on stdout."""
    information = folder / "broken_lidar-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: broken-lidar\nVersion: 1.0\n"
    )
    (information / "entry_points.txt").write_text(f"[lidarops.{group}]\nnovel = {entry}\n")
    (folder / "file").write_bytes(b"raw")
    ended = subprocess.run(
        [sys.executable, "-m", "lidarops", *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.stdout == ""
    return ended.returncode, ended.stderr


@GROUPS
def test_a_package_that_cannot_be_imported_costs_one_line(
    tmp_path: Path, group: str, command: list[str]
) -> None:
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/__init__.py").touch()
    (tmp_path / "broken/part.py").write_text("PART = 1 / 0\n")
    code, stderr = _run(tmp_path, group, "broken.part:PART", command)
    assert code == 1
    [line] = stderr.splitlines()
    assert line.startswith("error: ")
    assert "'novel' cannot be loaded from broken.part:PART: ZeroDivisionError" in line
    assert line.endswith(
        "(repair or remove the package broken-lidar; python -c 'import broken.part' shows where it"
        " fails)"
    )


@GROUPS
def test_a_part_of_lidarops_that_cannot_be_imported_shows_its_traceback(
    tmp_path: Path, group: str, command: list[str]
) -> None:
    code, stderr = _run(tmp_path, group, "lidarops.broken_part:PART", command)
    assert code == 1
    assert "Traceback" in stderr
    assert "No module named 'lidarops.broken_part'" in stderr
    assert "repair or remove" not in stderr

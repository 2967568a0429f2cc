"""What commands say while they work: files, per cent, elapsed and remaining time, compilation."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

import numba
import pytest

import lidarops.retrieve.common.compiled_code  # noqa: F401 - its functions are counted
from lidarops.cli.app import Bar, progress_bar

# The package has the application under the name of the module.
MODULE = sys.modules["lidarops.cli.app"]


def test_progress_is_a_line_now_and_then_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MODULE, "PROGRESS_INTERVAL", 0.05)
    with progress_bar("reprocess") as bar:
        time.sleep(0.2)
        bar.grow(1600)
        bar.advance(400)
        time.sleep(0.2)
    shown = capsys.readouterr()
    assert shown.out == ""
    first, *_, last = shown.err.splitlines()
    assert re.fullmatch(r"reprocess: 0 files, elapsed \d+ ms, remaining unknown", first)
    words = r"reprocess: 400 of 1,600 files, 25%, elapsed \d+ ms, remaining \d+(\.\d+)? m?s"
    assert re.fullmatch(words, last)


def test_a_terminal_counts_compiled_functions_rarely(monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[float] = []
    monkeypatch.setattr(MODULE, "compiled_functions", lambda: counts.append(0.0))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_bar("site", "product"):
        begun = len(counts)
        time.sleep(1.0)
        assert len(counts) <= begun + 1


def test_compilation_is_told_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(vars(numba.config), "CACHE_DIR", str(tmp_path))
    (tmp_path / "before.nbi").touch()
    with progress_bar("site", "product") as bar:
        assert "compiled" not in str(bar)
        for name in "ab":
            (tmp_path / f"{name}.nbi").touch()
        assert str(bar).endswith("; 2 functions compiled, once for this installation")
    assert "site: 2 functions compiled" in capsys.readouterr().err
    assert Bar("site", "product").compiled() == ""

"""Compiled code is that of the sources as they are."""

from __future__ import annotations

from pathlib import Path

import pytest
from numba import config

from lidarops.retrieve.common.compiled_code import keep_apart
from lidarops.retrieve.signal._signal_kernels import photon_profiles


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(config, "CACHE_DIR", "")
    (tmp_path / "caller.py").write_text("import numba")
    (tmp_path / "called.py").write_text("import numba  # 1")
    (tmp_path / "plain.py").write_text("1")
    return tmp_path


def test_a_change_of_any_compiled_module_gives_another_folder(sources: Path):
    first = keep_apart(sources)
    assert Path(first).parent == sources / "__pycache__"
    (sources / "plain.py").write_text("2")
    assert keep_apart(sources) == first
    (sources / "called.py").write_text("import numba  # 2")
    assert keep_apart(sources) != first
    assert Path(config.CACHE_DIR).parent == sources / "__pycache__"


def test_the_folder_that_a_user_names_is_kept_to(sources: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(config, "CACHE_DIR", str(sources / "mine"))
    assert Path(keep_apart(sources)).parent == sources / "mine"


def test_the_functions_of_the_package_keep_to_it():
    assert keep_apart() in str(photon_profiles._cache.cache_path)

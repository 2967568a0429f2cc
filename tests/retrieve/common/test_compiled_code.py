"""Compiled code is that of the present sources, and gives the same bits fresh and cached."""

from __future__ import annotations

import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
from numba import config
from numba.core.registry import CPUDispatcher

from lidarops.retrieve import background, homogeneous, signal
from lidarops.retrieve.common.compiled_code import keep_apart
from lidarops.retrieve.signal._signal_kernels import photon_profiles


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(config, "CACHE_DIR", "")
    folder = tmp_path / "retrieve"
    folder.mkdir()
    (folder / "caller.py").write_text("import numba")
    (folder / "thresholds.py").write_text("1")
    (tmp_path / "flags.py").write_text("1")
    return folder


@pytest.mark.parametrize("name", ["caller.py", "thresholds.py", "../flags.py"])
def test_a_change_of_any_source_gives_another_folder(name: str, sources: Path):
    first = keep_apart(sources)
    assert Path(first).parent == sources / "__pycache__"
    (sources / name).write_text("import numba  # changed")
    assert keep_apart(sources) != first
    assert Path(config.CACHE_DIR).parent == sources / "__pycache__"


def test_a_cache_folder_set_by_the_user_is_respected(
    sources: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(config, "CACHE_DIR", str(sources / "cache"))
    assert Path(keep_apart(sources)).parent == sources / "cache"


@pytest.mark.parametrize("name", ["analog", "counting", "pulse"])
def test_simulations_keep_compiled_code_where_retrievals_do(name: str):
    # In a process that has not imported the retrievals.
    program = f"import lidarops.simulate.{name}; from numba import config; print(config.CACHE_DIR)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert Path(done.stdout.strip()).name.startswith("lidarops-"), done.stderr


def test_code_compiled_at_installation_is_shared(
    sources: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
):
    installed = Path(keep_apart(sources))
    installed.mkdir(parents=True)
    (installed / "kernel.nbc").write_text("compiled")
    of_user = tmp_path_factory.mktemp("user")
    monkeypatch.setattr(config, "CACHE_DIR", str(of_user))
    copied = Path(keep_apart(sources)) / "kernel.nbc"
    assert copied.is_relative_to(of_user)
    copied.write_text("compiled by the user")
    keep_apart(sources)
    assert copied.read_text() == "compiled by the user"
    assert (installed / "kernel.nbc").read_text() == "compiled"


def test_a_read_only_installation_uses_the_cache_of_the_user(
    sources: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
):
    home = tmp_path_factory.mktemp("home")
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert Path(keep_apart(sources)).parent == home / "lidarops"


def test_the_functions_of_the_package_use_that_folder():
    assert keep_apart() in str(photon_profiles._cache.cache_path)


# The same bits, fresh and cached -------------------------------------------------------------

REWRITING = {"reassoc", "contract", "arcp", "afn", "fast"}
"""Fast-math flags with which the bits of a result depend on the optimisation."""


def compiled_functions(package: ModuleType) -> Iterator[CPUDispatcher]:
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        for function in vars(import_module(info.name)).values():
            if isinstance(function, CPUDispatcher):
                yield function


def callees(function: CPUDispatcher) -> list[CPUDispatcher]:
    code, names = function.py_func.__code__, function.py_func.__globals__
    values = (names.get(name) for name in code.co_names)
    return [value for value in values if isinstance(value, CPUDispatcher)]


@cache
def depends_on_optimisation(function: CPUDispatcher) -> bool:
    flags = function.targetoptions.get("fastmath") or set()
    if flags is True or REWRITING & set(flags):
        return True
    return any(depends_on_optimisation(callee) for callee in callees(function))


@pytest.mark.parametrize("package", [background, homogeneous, signal])
def test_called_functions_that_are_reassociated_are_inlined(package: ModuleType):
    """A symbol of its own has other bits when compiled in this process than from the cache."""
    called = {callee for function in compiled_functions(package) for callee in callees(function)}
    fast = {function for function in called if depends_on_optimisation(function)}
    assert fast
    assert {f.py_func.__name__ for f in fast if not f.targetoptions.get("forceinline")} == set()

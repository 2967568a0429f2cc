"""The examples of docs/products.md."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import netCDF4
import pytest

pytestmark = pytest.mark.slow

TEXT = (Path(__file__).parents[2] / "docs/products.md").read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
SHELL = re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def files(made: Callable[[str, str], Path], tmp_path: Path) -> dict[str, str]:
    """A product, and one of the next day."""
    product = made("homogeneous", "horizontal")
    later = Path(shutil.copy(product, tmp_path / "later.nc"))
    with netCDF4.Dataset(later, "a") as file:
        for name in ("time", "time_bnds"):
            file[name][:] = file[name][:] + 86400.0
    return {"PRODUCT": str(product), "LATER": str(later)}


@pytest.mark.parametrize("code", PYTHON, ids=lambda code: code.split()[1].rstrip(","))
def test_the_python_lines_run(code: str, files: dict[str, str], capsys: pytest.CaptureFixture[str]):
    pytest.importorskip(code.split()[1].rstrip(","))
    assert sum(bool(line) for line in code.splitlines()) <= 5
    exec(code, dict(files))
    assert capsys.readouterr().out


@pytest.mark.parametrize("code", SHELL, ids=lambda code: code.split()[0])
def test_the_shell_lines_run(code: str, files: dict[str, str], tmp_path: Path):
    tools = {line.split()[0] for line in code.splitlines()}
    if any(shutil.which(tool) is None for tool in tools):
        pytest.skip(f"needs {', '.join(sorted(tools))}")
    assert len(code.splitlines()) <= 5
    environment = {**os.environ, **files}
    subprocess.run(
        ["bash", "-euc", code], cwd=tmp_path, env=environment, check=True, capture_output=True
    )
    if "days.nc" in code:
        with netCDF4.Dataset(tmp_path / "days.nc") as file:
            assert file.dimensions["time"].size == 10

"""The scripts in examples/ run and draw a figure."""

from __future__ import annotations

import ast
import re
import runpy
from pathlib import Path

import pytest
import python_api
from matplotlib import image


def test_what_would_my_lidar_see(repository, tmp_path, monkeypatch):
    script = str(repository / "examples/what_would_my_lidar_see.py")
    figure = tmp_path / "figure.png"
    monkeypatch.setattr("sys.argv", [script, str(figure)])
    runpy.run_path(script, run_name="__main__")
    pixels = image.imread(figure)
    assert pixels.shape[0] > 500
    # Neither blank nor black.
    assert 0.5 < pixels[..., :3].mean() < 0.99

    monkeypatch.setattr("sys.argv", [script])
    with pytest.raises(SystemExit, match=r"figure\.png"):
        runpy.run_path(script, run_name="__main__")


def test_examples_and_the_forward_model_name_modules_that_users_may_call(repository: Path):
    named = {
        node.module
        for script in (repository / "examples").glob("*.py")
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lidarops")
    }
    page = (repository / "docs/papers/forward_model.md").read_text(encoding="utf-8")
    rows = "\n".join(line.split("|")[3] for line in page.splitlines() if line.count("|") == 5)
    modules = {f"lidarops.simulate.{name}" for name in re.findall(r"`([a-z_]+)(?:\.\w+)*`", rows)}
    known = {name for name in modules if (repository / f"{name.replace('.', '/')}.py").exists()}
    assert "lidarops.simulate.pulse" in known
    assert named | known <= set(python_api.MODULES)

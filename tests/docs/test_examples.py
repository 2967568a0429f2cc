"""The scripts in examples/ run and draw a figure."""

from __future__ import annotations

import runpy

import pytest
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

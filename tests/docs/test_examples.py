"""The scripts in examples/ run, and draw what they say."""

from __future__ import annotations

import runpy

import pytest
from matplotlib import image


def test_what_would_my_lidar_see(repository, tmp_path, monkeypatch):
    script = str(repository / "examples/what_would_my_lidar_see.py")
    figure = tmp_path / "figure.png"
    monkeypatch.setattr("sys.argv", [script, str(figure)])
    runpy.run_path(script, run_name="__main__")
    drawn = image.imread(figure)
    assert drawn.shape[0] > 500
    # Neither blank nor black.
    assert 0.5 < drawn[..., :3].mean() < 0.99

    monkeypatch.setattr("sys.argv", [script])
    with pytest.raises(SystemExit, match=r"figure\.png"):
        runpy.run_path(script, run_name="__main__")

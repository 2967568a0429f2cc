"""Products are the same bytes from a cold and from a warm cache of compiled code."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from lidarops.campaign.model import load_campaign
from lidarops.kinds import kinds
from lidarops.simulate.campaign import simulate_campaign


def _written(path: Path, tree: dict[str, Any], folder: Path) -> Path:
    tree |= {"archive": str(folder / "raw" / path.stem)}
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    # By this process, so that the compared ones compile nothing but what products need.
    simulate_campaign(load_campaign(path))
    return path


@pytest.fixture
def campaigns(repository: Path, tmp_path: Path) -> list[Path]:
    """Campaigns that give products of all kinds."""
    short = yaml.safe_load((repository / "lidarops/run/compile.yaml").read_text("utf-8"))
    raman = yaml.safe_load((repository / "catalogs/raman.yaml").read_text("utf-8"))
    raman["simulation"]["duration"] = 7200
    return [
        _written(tmp_path / "short.yaml", short, tmp_path),
        _written(tmp_path / "raman.yaml", raman, tmp_path),
    ]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_products_of_all_kinds_are_the_same_from_a_cold_and_a_warm_cache(
    campaigns: list[Path], repository: Path, tmp_path: Path
) -> None:
    # A copy without caches: a cache folder elsewhere begins as a copy of the one beside the code.
    code, cache = tmp_path / "code", tmp_path / "cache"
    without = shutil.ignore_patterns("__pycache__")
    shutil.copytree(repository / "lidarops", code / "lidarops", ignore=without)
    environment = os.environ | {"PYTHONPATH": str(code), "NUMBA_CACHE_DIR": str(cache)}

    def products(name: str) -> dict[str, str]:
        for campaign in campaigns:
            out = tmp_path / name / campaign.stem
            command = [sys.executable, "-m", "lidarops", "reprocess", str(campaign), "--out", out]
            done = subprocess.run(
                command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stdout + done.stderr
        return {
            str(path.relative_to(tmp_path / name)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted((tmp_path / name).rglob("*.nc"))
        }

    def compiled() -> int:
        return len(list(cache.rglob("*.nbc")))

    assert compiled() == 0
    cold = products("cold")
    after_cold = compiled()
    assert after_cold > 50
    warm = products("warm")
    assert compiled() == after_cold
    own = {kind.name for kind in kinds().values() if kind.package.startswith("lidarops.")}
    assert {kind for kind in own if any(f"/{kind}/" in path for path in cold)} == own
    assert warm == cold

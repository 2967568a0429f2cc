"""The size of the house and the way of one file through it.

Limits fall with every repair. They rise with a capability alone, in the commit that says which.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import yaml
from support import shape
from typer.testing import CliRunner

from lidarops.cli import app

MOST = {
    "lines": 71_157,
    "lines of code alone": 46_576,
    "modules": 270,
    "dataclasses": 220,
    "lines of dataclasses": 6_191,
    "tuning numbers": 166,
    "tuning numbers that are assumed": 44,
    "copied thresholds": 0,
    "most parameters": 10,
    "lines of the largest package": 5_978,
}
MOST_OF_ONE_FILE = {
    "homogeneous": {"modules": 61, "functions": 582, "changes": 243},
    "elastic": {"modules": 71, "functions": 717, "changes": 253},
}


def test_the_library_does_not_grow():
    figures = shape.figures()
    assert figures.keys() == MOST.keys()
    above = {name: (figures[name], most) for name, most in MOST.items() if figures[name] > most}
    assert above == {}


def test_one_file_passes_few_modules_and_functions_without_prefect(
    repository: Path, tmp_path: Path
):
    campaigns = [write_campaign(repository, tmp_path / kind, kind) for kind in MOST_OF_ONE_FILE]
    places = os.pathsep.join([str(repository), str(repository / "tests")])
    done = subprocess.run(
        [sys.executable, "-m", "support.trace", *campaigns],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": places},
    )
    assert done.returncode == 0, done.stderr
    for kind, line in zip(MOST_OF_ONE_FILE, done.stdout.splitlines(), strict=True):
        figures, most = json.loads(line), MOST_OF_ONE_FILE[kind]
        assert figures.pop("products") == [kind]
        assert {name: (n, most[name]) for name, n in figures.items() if n > most[name]} == {}


def write_campaign(repository: Path, folder: Path, kind: str) -> Path:
    """Write the campaign of the one instrument with a kind of product, and its one raw file."""
    whole = yaml.safe_load((repository / "tests/architecture/campaigns/one_file.yaml").read_text())
    for section in (whole["instruments"], whole["simulation"]["instruments"]):
        for name in section.keys() - {kind}:
            del section[name]
    folder.mkdir()
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(whole))
    result = CliRunner().invoke(app, ["simulate", str(path)])
    assert result.exit_code == 0, result.output
    return path

"""The commands and code of the README work."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
import xarray as xr
import yaml
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign
from lidarops.cli import app


@pytest.fixture(scope="module")
def readme(repository: Path) -> str:
    """Return the text of the README."""
    return (repository / "README.md").read_text(encoding="utf-8")


def _block(readme: str, language: str) -> str:
    match = re.search(rf"```{language}\n(.*?)```", readme, re.DOTALL)
    assert match
    return match[1]


def test_it_is_short(readme: str) -> None:
    assert len(readme.splitlines()) <= 150


def test_the_campaign_file_is_valid(readme: str) -> None:
    campaign = Campaign.model_validate(yaml.safe_load(_block(readme, "yaml")))
    assert len(campaign.instruments["pier-lidar"].facts) == 2


def test_the_python_lines_run(readme: str, demo_archive: Path) -> None:
    code = _block(readme, "python").replace("demo/raw", str(demo_archive))
    names: dict[str, object] = {}
    exec(code, names)
    fit = names["fit"]
    assert isinstance(fit, xr.Dataset)
    assert fit["total_extinction"].sizes["time"] > 50


def test_every_command_exists(readme: str) -> None:
    commands = set(re.findall(r"^    lidarops (\w+)", readme, re.MULTILINE))
    shown = CliRunner().invoke(app, ["--help"]).output
    assert {"simulate", "catalog", "plan", "reprocess", "report", "inspect", "bench"} < commands
    for command in commands:
        assert command in shown
        assert "Example" in CliRunner().invoke(app, [command, "--help"]).output


def test_named_files_exist(readme: str, repository: Path) -> None:
    for name in re.findall(r"`([\w./-]+\.(?:py|toml|bib|md|yaml))`|\]\(([\w./-]+)\)", readme):
        path = next(text for text in name if text)
        assert (repository / path).exists(), path


def test_the_accuracy_table_is_that_of_a_result_of_the_benchmark(repository: Path) -> None:
    script = spec_from_file_location("accuracy_table", repository / "docs/accuracy_table.py")
    assert script is not None
    assert script.loader is not None
    generator = module_from_spec(script)
    script.loader.exec_module(generator)
    row = {"case": "path", "method": "ours", "error": 0.0}
    result = {
        "date": "2026-01-01",
        "machine": {"processor": "one"},
        "tables": {
            generator.BEST: [
                {
                    **row,
                    "case": "scan",
                    "method": "peer",
                    "quantity": "RMSE",
                    "value": 2.0,
                    "unit": "",
                },
                {**row, "quantity": "RMSE", "value": 1.25, "error": 0.01, "unit": ""},
                {**row, "quantity": "95 %", "value": 0.951, "unit": "1"},
                {**row, "quantity": "CPU time", "value": 2500.0, "unit": "ns"},
            ]
        },
    }
    lines = generator.page(result).splitlines()
    assert lines[-4] == "| RMSE of | method | RMSE | 95 % | CPU time |"
    assert lines[-1] == "| path | ours | 1.25(1) | 95.1 % | 2.5 µs |"
    assert "(one, shared), of one run (2026-01-01)" in " ".join(lines)
    assert lines[-4] in generator.PAGE.read_text(encoding="utf-8")

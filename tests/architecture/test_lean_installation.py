"""Only flows need Prefect; `support.trace` runs without it, with all modules of lidarops."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

from setuptools import find_packages


def test_flows_say_what_they_need() -> None:
    code = "import importlib.util as u; u.find_spec = lambda name: None; import flows"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "pip install lidarops[prefect]" in done.stderr


def test_the_command_line_installs_what_draws_but_nothing_of_the_documentation(
    repository: Path,
) -> None:
    for lock in ("requirements.lock", "deploy/requirements.lock"):
        text = (repository / lock).read_text("utf-8")
        assert all(f"\n{name}==" in text for name in ("matplotlib", "pillow"))
        assert not [name for name in ("miepython", "sphinx") if f"\n{name}==" in text]


def test_only_the_extra_names_prefect_and_the_demo_installs_it(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))["project"]
    assert not [name for name in project["dependencies"] if name.startswith("prefect")]
    assert any(name.startswith("prefect") for name in project["optional-dependencies"]["prefect"])
    for lock in ("requirements.lock", "deploy/requirements.lock"):
        assert "\nprefect==" in (repository / lock).read_text("utf-8")


def test_the_wheel_takes_no_top_level_name_but_that_of_the_package(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))
    included = project["tool"]["setuptools"]["packages"]["find"]["include"]
    found = find_packages(str(repository), include=included)
    assert {name.partition(".")[0] for name in found} == {"lidarops"}

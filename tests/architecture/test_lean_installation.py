"""The command line works without Prefect, which only flows need."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

from support.archives.small_archive import Archive

WITHOUT_PREFECT = """
import importlib.abc, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "prefect":
            raise ModuleNotFoundError(name)

    def find_distributions(self, context):
        return ()

sys.meta_path.insert(0, Absent())
"""


def _run(code: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT_PREFECT + code, *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_commands_work_without_prefect(tmp_path: Path) -> None:
    archive = Archive(tmp_path, days=1)
    del archive.tree["instruments"]["rich"]
    archive.write()
    done = _run("from lidarops.cli import app; app()", "reprocess", str(archive.file))
    assert done.returncode == 0, done.stderr


def test_flows_say_what_they_need() -> None:
    done = _run("import importlib.util as u; u.find_spec = lambda name: None; import flows")
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

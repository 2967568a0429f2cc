"""Every code block of README and documentation runs, but for those that the build executes.

Benchmarks take minutes: their arguments are parsed here, and tests/benchmarks runs them.

The blocks of a page run one after another in a folder of its own, with the campaign of
`docs/howto/campaign.md`, its raw files and its products. Commands of lidarops run in this process.
Tools that install, or need a server, a cluster or a container engine, are stand-ins here that do
nothing: only the files of the repository, modules, targets and options that they are given must
exist. `tests/deploy` runs most of them in earnest, and `.ci/run` the installation.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import command_line
import pytest
import typer
import xarray as xr
import yaml
from support.pages import REPOSITORY, Block, blocks, name_of, pages
from typer.testing import CliRunner

from benchmarks.__main__ import BENCHMARKS
from benchmarks.__main__ import app as benchmarks
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.cli import app
from lidarops.run.clusters import Scheduler

# Executed elsewhere: the tools named on the page of products by tests/tools, and the functions of
# the papers, with arrays of their own, by test_papers.py.
ELSEWHERE = {
    "docs/products.md": {"python", "sh"},
    **{name_of(page): {"python"} for page in (REPOSITORY / "docs/papers").glob("*.md")},
}
# Directives that show code which nothing runs.
SHOWN_ONLY = ("{code-block}", "{code}", "{literalinclude}")
STAND_INS = (
    "dask", "docker", "kubectl", "make", "pip", "pre-commit", "prefect", "python", "sbatch",
)  # fmt: skip
FOLDERS = ("catalogs/", "deploy/", "docs/", "examples/", "flows/", "tests/")
"""Of the repository, whose files commands on pages name."""
MODULES = ("benchmarks", "flows")
"""Beginnings of names of modules that commands on pages run."""
IN_SHELL = re.compile(r"[>|&;*]")
DEMO = "catalogs/demo.yaml"
"""Processed by `tests/end_to_end/test_archives.py`: here, commands on it are parsed."""
SIMULATION = """
simulation:
  seed: 1
  start: 2024-09-21T11:40:00Z
  duration: 2400
  instruments:
    pier-lidar:
      atmosphere:
        homogeneous:
          extinction: {minimum: 5.0e-5, maximum: 3.0e-4, hour_of_maximum: 18}
          aerosol: {lidar_ratio: 50}
      acquisition: {interval: 120, shots: 3000, repetition_rate: 50, bins: 1200, dark_files: 2}
      detectors:
        - {wavelength: 532, signal_rate: 2.0, background: {night: 0.05, day: 5}, photon: {}}
"""

BLOCKS = [block for page in pages() for block in blocks(page)]
OURS = [block for block in BLOCKS if block.page not in ELSEWHERE]


def lidarops(*arguments: str) -> None:
    """Run a command, which ends with 0."""
    if DEMO in arguments:
        check_arguments("lidarops", list(arguments))
        return
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 0, (arguments, result.output)
    if arguments[0] == "reprocess":
        assert list(Path(load_campaign(arguments[1]).output).glob("products/**/*.nc")), arguments


def harbour() -> str:
    """Return the campaign file of the page on campaigns."""
    return next(
        block.text
        for block in OURS
        if block.page == "docs/howto/campaign.md" and block.language == "yaml"
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with all that commands on the pages name."""
    folder = tmp_path_factory.mktemp("made")
    for name in ("catalogs", "deploy", "flows", "docs"):
        (folder / name).symlink_to(REPOSITORY / name)
    tools = folder / ".venv" / "bin"
    tools.mkdir(parents=True)
    for name in (*STAND_INS, "lidarops"):
        tool = tools / name
        tool.write_text(f'#!/bin/sh\nprintf "%s\\n" "$*" >> "$WORLD/{name}.calls"\n')
        tool.chmod(0o755)
    shared = folder / "lidar/share/lidarops"
    shared.mkdir(parents=True)
    (shared / "catalogs").symlink_to(REPOSITORY / "catalogs")
    (folder / "lidar/bin").mkdir()
    (folder / "lidar/bin/activate").touch()
    (folder / "dist").mkdir()
    for version in (0, 1):
        (folder / f"dist/lidarops-{version}-py3-none-any.whl").touch()
    campaign = folder / "harbour.yaml"
    campaign.write_text(harbour() + SIMULATION)
    lidarops("simulate", str(campaign))
    lidarops("reprocess", str(campaign))
    lidarops("aggregate", str(folder / "out"), "--store")
    campaign.write_text(harbour())
    return folder


@pytest.fixture
def world(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of that folder, with the variables that the pages use."""
    world = shutil.copytree(made, tmp_path / "world", symlinks=True)
    product = next(world.glob("out/products/**/*_homogeneous_*.nc"))
    monkeypatch.chdir(world)
    monkeypatch.setenv("WORLD", str(world))
    monkeypatch.setenv("PATH", f"{world}/.venv/bin{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("VIRTUAL_ENV", str(world / "lidar"))
    monkeypatch.setenv("PRODUCT", str(product))
    return world


def commands(text: str) -> Iterator[str]:
    """Give the commands of a block, continued lines joined, without comments."""
    for line in text.replace("\\\n", " ").splitlines():
        command = re.sub(r"(^|\s+)# .*$", "", line).strip()
        if command:
            yield command


def run(command: str, world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run one command of a page."""
    name, *arguments = shlex.split(command)
    if name == "export":
        for assignment in arguments:
            monkeypatch.setenv(*assignment.split("=", 1))
    elif name == "lidarops" and not IN_SHELL.search(command) and arguments != ["compile"]:
        # A store that is a folder.
        stored = [
            os.path.expandvars(text).replace("s3://", f"{world}/stores/") for text in arguments
        ]
        lidarops(*stored)
    else:
        done = subprocess.run(
            ["bash", "-euc", command], cwd=world, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, (command, done.stderr)


PAGES = sorted({block.page for block in OURS if block.language == "sh"})


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_shell_blocks_run(page: str, world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for block in OURS:
        if block.page == page and block.language == "sh":
            for command in commands(block.text):
                run(command, world, monkeypatch)
    for calls in world.glob("*.calls"):
        for line in calls.read_text().splitlines():
            check_arguments(calls.stem, line.split())


@pytest.mark.parametrize(
    "page", sorted({block.page for block in OURS if block.language == "python"})
)
@pytest.mark.usefixtures("world")
def test_python_blocks_run(page: str) -> None:
    names: dict[str, object] = {}
    for block in OURS:
        if block.page == page and block.language == "python":
            exec(block.text, names)
    shown = [value for value in names.values() if isinstance(value, xr.Dataset)]
    assert shown
    # 2,400 s of raw files of 120 s.
    assert all(data.sizes["time"] == 20 for data in shown)


def check_arguments(tool: str, arguments: list[str]) -> None:
    """Fail if a tool is given a file of the repository, a module or an option that is not there."""
    for argument in arguments:
        if argument.startswith(FOLDERS) and argument != "deploy/.env":
            in_cluster = argument == "deploy/lidarops-prefect-worker"
            assert in_cluster or (REPOSITORY / argument).exists(), argument
    if tool == "python" and arguments[0] == "-m" and arguments[1].startswith(MODULES):
        assert find_spec(arguments[1])
    if tool == "python" and arguments[:2] == ["-m", "benchmarks"]:
        words = typer.main.get_command(benchmarks).make_context("benchmarks", arguments[2:]).params
        assert words["case"] in [*BENCHMARKS[words["what"]], None]
    if tool == "pip":
        # One wheel, or a checkout: a name alone is that of any package of the index.
        assert arguments[0] == "install", arguments
        assert sum(".whl" in argument for argument in arguments) <= 1, arguments
    if tool == "make":
        makefile = (REPOSITORY / "Makefile").read_text()
        assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in arguments)
    if tool == "lidarops":
        command = typer.main.get_command(app).commands[arguments[0]]
        options = {option for parameter in command.params for option in parameter.opts}
        assert {text for text in arguments if text.startswith("--")} <= options


@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if block.language == "yaml"], ids=lambda block: block.page
)
def test_yaml_blocks_are_valid(block: Block) -> None:
    part = yaml.safe_load(block.text)
    if block.page == "docs/howto/cluster.md":
        assert Scheduler.model_validate(part).tls
        return
    campaign = Campaign.model_validate(merged(yaml.safe_load(harbour()), part))
    assert len(campaign.instruments["pier-lidar"].facts) == 2


def merged(whole: Any, part: Any) -> Any:
    """Return a mapping with the values of a part of it."""
    if not isinstance(whole, dict) or not isinstance(part, dict):
        return part
    return whole | {key: merged(whole.get(key), value) for key, value in part.items()}


def test_every_block_is_of_a_kind_that_runs() -> None:
    for block in BLOCKS:
        directive = block.language.startswith("{") and not block.language.startswith(SHOWN_ONLY)
        runs = block.language in ELSEWHERE.get(block.page, {"python", "sh", "yaml"})
        assert directive or runs or block.language == "text", block


def test_no_page_installs_lidarops_by_its_name() -> None:
    """It is on no index, where the name may be that of another package."""
    for page in pages():
        by_name = re.findall(r"pip install [\"']?lidarops\b", page.read_text("utf-8"))
        assert not by_name, name_of(page)


def test_no_block_is_indented_only() -> None:
    for page in pages():
        lines = re.sub(r"^(`{3,}).*?^\1", "", page.read_text("utf-8"), flags=re.M | re.S)
        assert not re.search(r"\n\n    \S", lines), name_of(page)


def test_examples_of_the_help_fit_their_commands() -> None:
    for name, command in command_line.commands().items():
        examples = re.findall(r"^Example: lidarops (.+)$", command.help or "", re.MULTILINE)
        assert examples, name
        for example in examples:
            first, *arguments = shlex.split(example)
            assert first == name
            check_arguments("lidarops", [first, *arguments])

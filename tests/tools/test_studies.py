"""The studies that the pages of the algorithms name start as these state."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.studies import path_guards
from benchmarks.studies.ablation import BASE, PAGES

pytestmark = pytest.mark.slow

STUDIES = sorted(
    path.stem
    for path in (Path(__file__).resolve().parents[2] / "benchmarks/studies").glob("*.py")
    if "__main__" in path.read_text(encoding="utf-8")
)


# All in one process, which loads what they import once.
HELP = """
import contextlib, io, json, runpy, sys
studies, ends = sys.argv[1:], {}
for study in studies:
    sys.argv = [study, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as output:
        try:
            runpy.run_module(f"benchmarks.studies.{study}", run_name="__main__")
        except SystemExit as end:
            ends[study] = [end.code, "usage" in output.getvalue()]
print(json.dumps(ends))
"""


def test_a_study_states_its_arguments(repository: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", HELP, *STUDIES],
        cwd=repository,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {study: [0, True] for study in STUDIES}


@pytest.mark.parametrize("mark", path_guards.TABLES)
def test_the_page_of_the_homogeneous_path_holds_the_tables_of_its_study(mark: str) -> None:
    text = (PAGES / "homogeneous.md").read_text(encoding="utf-8")
    table = text.partition(f"<!-- {mark} -->\n")[2].partition(f"<!-- end of {mark} -->")[0]
    names = {line.split(" | ")[0].removeprefix("| ") for line in table.splitlines()[2:]}
    _, guards = path_guards.TABLES[mark]
    assert names - {BASE} == {guard.name for guard in guards}

"""The study of guards starts as pages state, and holds the guards of their tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.studies.guards import BASE, PAGES, STUDIES

pytestmark = pytest.mark.slow


def test_the_study_states_its_arguments(repository: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.studies.guards", "--help"],
        cwd=repository,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in STUDIES)


@pytest.mark.parametrize(
    ("page", "study"),
    [(page, study) for page, studies in STUDIES.items() for study in studies],
    ids=lambda part: part if isinstance(part, str) else part.mark,
)
def test_pages_hold_the_tables_of_the_study(page: str, study) -> None:
    text = (PAGES / f"{page}.md").read_text(encoding="utf-8")
    before, _, rest = text.partition(f"<!-- {study.mark} -->\n")
    assert f"`python -m benchmarks.studies.guards {page}`" in before.replace("\n", " ")
    table = rest.partition(f"<!-- end of {study.mark} -->")[0]
    names = {line.split(" | ")[0].removeprefix("| ") for line in table.splitlines()[2:]}
    assert names - {BASE} == {guard.name for guard in study.guards}

"""One version: of the package, the citation, the changelog and the tag of a release."""

from __future__ import annotations

import re
import subprocess
import tomllib
from datetime import date
from pathlib import Path

import pytest
import yaml


@pytest.fixture
def version(repository: Path) -> str:
    settings = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))
    number: str = settings["project"]["version"]
    return number


def test_the_citation_and_the_changelog_name_the_version(repository: Path, version: str) -> None:
    citation = yaml.safe_load((repository / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version
    changelog = (repository / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## (\S+)", changelog, re.MULTILINE)
    assert newest
    assert newest[1] == version


def test_images_have_the_version(repository: Path, version: str) -> None:
    pages = [path for name in ("deploy", "docs") for path in (repository / name).rglob("*.[my]*")]
    named = [
        number
        for path in pages
        if path.is_file() and not {"_build", "made"} & set(path.parts)
        for number in re.findall(
            r"(?:lidarops:|newTag: )(\d+\.\d+\.\d+)", path.read_text(encoding="utf-8")
        )
    ]
    # deploy/kubernetes/kustomization.yaml and docs/howto/cluster.md.
    assert len(named) >= 2
    assert set(named) == {version}


def test_a_tagged_commit_has_the_version_of_its_tag(repository: Path, version: str) -> None:
    command = ["git", "tag", "--points-at", "HEAD", "--list", "v*"]
    tags = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    if tags.returncode or not tags.stdout.split():
        pytest.skip("this commit has no tag of a release")
    assert tags.stdout.split() == [f"v{version}"]
    changelog = (repository / "CHANGELOG.md").read_text(encoding="utf-8")
    heading = re.search(rf"^## {re.escape(version)} - (\S+)$", changelog, re.MULTILINE)
    assert heading
    assert date.fromisoformat(heading[1])


def test_upper_bounds_of_packages_have_their_reason(repository: Path) -> None:
    lines = (repository / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    bounded = [re.search(r'"[\w\[\]-]+[^"]*<\d', line) is not None for line in lines]
    assert sum(bounded) > 5
    for number, line in enumerate(lines):
        if bounded[number] and "#" not in line:
            # One comment may be the reason of the bounds below it.
            above = next(n for n in range(number, 0, -1) if not bounded[n])
            assert lines[above].lstrip().startswith("#"), line

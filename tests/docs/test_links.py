"""No link of a page is dead, on the site and on a plain forge: files and headings exist."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

import pytest
from support.pages import REPOSITORY, name_of, pages, prose

# Pages whose headings are generated when the documentation is built.
GENERATED = {"docs/reference/variables.md", "docs/reference/campaign_keys.md"}

_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def _anchors(page: Path) -> set[str]:
    """Return the anchors that a forge and MyST give to headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for target in _LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        assert linked.is_relative_to(REPOSITORY), target
        if anchor and name_of(linked) not in GENERATED:
            assert anchor in _anchors(linked), target


def _tracked() -> list[str]:
    """Return the files of the repository."""
    done = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, check=True)
    return done.stdout.decode().splitlines()


def _exists(name: str, tracked: Sequence[str]) -> bool:
    """Return whether a path of the repository exists, or a file of a name without folder.

    KIND and NAME stand for any word.
    """
    pattern = re.sub("KIND|NAME", "*", name)
    places = (pattern, f"lidarops/{pattern}") if "/" in name else (pattern, f"*/{pattern}")
    return any(fnmatch(file, place) for file in tracked for place in places)


def test_files_named_in_code_exist() -> None:
    tracked = _tracked()
    for page in pages():
        for name in re.findall(
            r"`([\w./-]+\.(?:py|toml|bib|md|cff|lock))`", page.read_text("utf-8")
        ):
            assert _exists(name, tracked), (name_of(page), name)


def _defined() -> set[str]:
    """Return the names of packages, modules, functions, classes and variables."""
    paths = [path for root in ("lidarops", "flows") for path in (REPOSITORY / root).rglob("*.py")]
    names = {part for path in paths for part in path.relative_to(REPOSITORY).with_suffix("").parts}
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
    return names


def test_names_of_code_in_the_architecture_exist() -> None:
    text = (REPOSITORY / "docs/architecture.md").read_text("utf-8")
    named = {
        name for name in re.findall(r"`([\w.]+)`", text) if not re.search(r"\.(py|toml|md)$", name)
    }
    assert len(named) > 40
    last = {name.rpartition(".")[2] for name in named - {"prefect"}}
    assert last - _defined() == set()


def test_a_wrong_folder_or_a_built_file_is_no_file() -> None:
    tracked = _tracked()
    assert _exists("run/staleness.py", tracked)
    assert _exists("retrieve/NAME/flags.py", tracked)
    assert not _exists("plan/staleness.py", tracked)
    assert not _exists("docs/_build/staleness.py", tracked)


def test_every_page_is_reachable_from_the_readme_and_the_front_page() -> None:
    reached: set[Path] = set()
    waiting = [REPOSITORY / "README.md", REPOSITORY / "docs/index.md"]
    while waiting:
        page = waiting.pop()
        if page in reached:
            continue
        reached.add(page)
        text = page.read_text(encoding="utf-8")
        linked = [target.partition("#")[0] for target in _LINK.findall(prose(page))]
        for entries in re.findall(r"```\{toctree\}\n(.*?)```", text, re.DOTALL):
            linked += [
                f"{entry}.md" for entry in entries.split() if not entry.startswith((":", "made"))
            ]
        for target in linked:
            path = (page.parent / target).resolve()
            if path.suffix == ".md" and path.is_file():
                waiting.append(path)
    apart = {REPOSITORY / "deploy/README.md"}
    assert set(pages()) - apart <= reached

"""The README is short, and leads to the five places."""

from __future__ import annotations

import re
from pathlib import Path


def test_it_is_short_with_a_figure_its_commands_and_five_links(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    pictures = re.findall(r'(?:src|srcset)="([^"]+)"', text)
    assert len(pictures) == 2
    assert all(0 < (repository / name).stat().st_size < 150_000 for name in pictures)
    commands = ["make install", "make demo", "make test", "make docs"]
    assert re.findall(r"^(make \w+)", text, re.MULTILINE) == commands
    links = text.partition("## Five links")[2].partition("\n## ")[0]
    assert re.findall(r"^(\d)\. ", links, re.MULTILINE) == list("12345")


def test_its_commands_set_themselves_up_and_the_documentation_tells_of_the_others(
    repository: Path,
) -> None:
    makefile = (repository / "Makefile").read_text(encoding="utf-8")
    targets = dict(re.findall(r"^([\w-]+): (\S+)$", makefile, re.MULTILINE))
    assert targets["install"] == targets["demo"] == ".venv/.runtime"
    assert targets["test"] == targets["docs"] == ".venv/.dev"
    page = (repository / "docs" / "contributing.md").read_text(encoding="utf-8")
    assert "../CONTRIBUTING.md" in page
    assert "`make docs`" in (repository / "CONTRIBUTING.md").read_text(encoding="utf-8")

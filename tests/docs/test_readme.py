"""The README is short, and leads to the five places."""

from __future__ import annotations

import re
from pathlib import Path


def test_it_is_short_with_a_figure_two_commands_and_five_links(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    assert len(re.findall(r"^!\[", text, re.MULTILINE)) == 1
    assert re.findall(r"^(make \w+)", text, re.MULTILINE) == ["make demo", "make docs"]
    links = text.partition("## Five links")[2].partition("\n## ")[0]
    assert re.findall(r"^(\d)\. ", links, re.MULTILINE) == list("12345")

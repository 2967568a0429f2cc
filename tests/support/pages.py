"""The pages of the project as text, code blocks and links."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[2]

_BLOCK = re.compile(
    r"^(?P<fence>`{3,}|:{3,})(?P<language>[^\n]*)\n(?P<text>.*?)^(?P=fence)\s*$", re.M | re.S
)


class Block(NamedTuple):
    """One fenced block."""

    page: str
    language: str
    text: str


def pages() -> list[Path]:
    """Return all pages, without those that the build of the documentation writes."""
    found = [*REPOSITORY.glob("*.md"), *(REPOSITORY / "deploy").glob("*.md")]
    found += [
        path
        for path in (REPOSITORY / "docs").rglob("*.md")
        if not {"_build", "made"} & set(path.parts)
    ]
    return sorted(found)


def name_of(page: Path) -> str:
    """Return the path of a page in the repository."""
    return page.relative_to(REPOSITORY).as_posix()


def blocks(page: Path) -> Iterator[Block]:
    """Give the fenced blocks of a page."""
    for match in _BLOCK.finditer(page.read_text(encoding="utf-8")):
        yield Block(name_of(page), match["language"].strip(), match["text"])


def prose(page: Path) -> str:
    """Return the text of a page without code."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    return re.sub(r"`[^`\n]+`", "", text)

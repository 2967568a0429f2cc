"""Reasons for targets that are not met, as `docs/results/reasons.json` states them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from benchmarks.harness.verdicts import Judgement

FILE: Final = Path(__file__).parents[2] / "docs/results/reasons.json"


@dataclass(frozen=True, slots=True)
class Unmet:
    """A target that is missed, or for which the scenes do not decide."""

    part: str
    quantity: str
    name: str
    """Class."""
    target: str
    judgement: Judgement

    @property
    def place(self) -> str:
        """Class and quantity."""
        return f"{self.name} ({self.quantity})" if self.quantity else self.name

    def __str__(self) -> str:
        return f"{self.part}: {self.place}, {self.target} {self.judgement}"


@dataclass(frozen=True, slots=True)
class Reason:
    """Why targets are not met, with patterns of what it is for."""

    why: str
    part: str = "*"
    quantity: str = "*"
    name: str = "*"
    target: str = "*"
    verdict: str = "*"

    def matches(self, one: Unmet) -> bool:
        """Return whether the reason is for this target."""
        pairs = (
            (one.part, self.part), (one.quantity, self.quantity), (one.name, self.name),
            (one.target, self.target), (one.judgement.verdict, self.verdict),
        )  # fmt: skip
        return all(fnmatchcase(text, pattern) for text, pattern in pairs)


def read_reasons(file: Path = FILE) -> list[Reason]:
    """Return the reasons of a file, the most special ones first; none without the file."""
    if not file.is_file():
        return []
    rows: list[dict[str, str]] = json.loads(file.read_text(encoding="utf-8"))
    return [Reason(**{_KEYS.get(key, key): text for key, text in row.items()}) for row in rows]


_KEYS: Final = {"class": "name"}


def why(one: Unmet, reasons: Sequence[Reason]) -> str:
    """Return the reason of a target that is not met; empty if none is stated."""
    return next((reason.why for reason in reasons if reason.matches(one)), "")

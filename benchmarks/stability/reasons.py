"""Reasons for targets that are not met, as `docs/results/reasons.json` states them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from benchmarks.harness.figure import Judgement

FILE: Final = Path(__file__).parents[2] / "docs/results/reasons.json"
Reason = dict[str, str]
"""``why``, and patterns of the part, quantity, class, target and verdict that it is for."""


@dataclass(frozen=True, slots=True)
class Unmet:
    """A target that is missed, or for which the scenes do not decide."""

    part: str
    quantity: str
    name: str
    """Class."""
    target: str
    judgement: Judgement

    def __str__(self) -> str:
        place = f"{self.name} ({self.quantity})" if self.quantity else self.name
        return f"{self.part}: {place}, {self.target} {self.judgement}"


def read_reasons(file: Path = FILE) -> list[Reason]:
    """Return the reasons of a file, the most special ones first; none without the file."""
    return list(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else []


def why(one: Unmet, reasons: Sequence[Reason]) -> str:
    """Return the reason of a target that is not met; empty if none is stated."""
    texts = {"part": one.part, "quantity": one.quantity, "class": one.name, "target": one.target,
             "verdict": one.judgement.verdict}  # fmt: skip
    return next(
        (
            reason["why"]
            for reason in reasons
            if all(fnmatchcase(text, reason.get(key, "*")) for key, text in texts.items())
        ),
        "",
    )

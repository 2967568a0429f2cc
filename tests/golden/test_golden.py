"""Products of every kind match their golden text, to the last attribute."""

from __future__ import annotations

import difflib
from pathlib import Path

import pytest
from golden.regenerate import FOLDER, texts


@pytest.fixture(scope="module")
def now(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return dict(texts(tmp_path_factory.mktemp("golden")))


def test_every_kind_has_a_golden_text(now: dict[str, str]):
    assert sorted(now) == sorted(path.name for path in FOLDER.glob("*.cdl"))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.cdl")), ids=lambda path: path.stem)
def test_a_product_matches_its_golden_text(path: Path, now: dict[str, str]):
    before = path.read_text(encoding="utf-8").splitlines()
    after = now[path.name].splitlines()
    changes = "\n".join(difflib.unified_diff(before, after, "was", "is", lineterm="", n=1))
    assert not changes, f"{path.name} changed (make golden, if that is meant):\n{changes}"

"""The example of the page on scaling follows from its assumed values and formulas."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

UNITS = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "bytes": 1.0, "GB": 1e9, "": 1}
GRANULES, PER_SCENE, PRODUCTS, WORKERS = 1e8, 1440, 2, 8 * 0.85


@pytest.fixture
def stated(repository: Path) -> dict[str, tuple[float, float]]:
    """Return values of the tables in SI units, with the size of their last digit."""
    text = (repository / "docs/scaling.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| ([\d.]+) ?([a-zA-Z]*) \|", text, re.MULTILINE)
    return {
        name: (
            float(number) * UNITS[unit],
            UNITS[unit] * 10.0 ** -len(number.partition(".")[2]),
        )
        for name, number, unit in rows
    }


def test_the_example_follows_from_the_formulas(stated: dict[str, tuple[float, float]]) -> None:
    t_list, t_same, t_new, t_gran, t_scene, t_ledger, b_row = (
        stated[f"`{name}`"][0]
        for name in ("t_list", "t_same", "t_head + t_row", "t_gran", "t_scene", "t_ledger", "B_row")
    )
    scenes = 7e4
    first, second = GRANULES * (t_list + t_new), GRANULES * (t_list + t_same)
    scene = PER_SCENE * t_gran + t_scene
    all_scenes, ledger = GRANULES * t_gran + scenes * t_scene, PRODUCTS * scenes * t_ledger
    night = second + 1e5 * t_new + 1e5 * t_gran + 70 * t_scene + PRODUCTS * 70 * t_ledger
    expected = {
        "first scan": first,
        "second scan": second,
        "catalog": GRANULES * b_row,
        "a scene": scene,
        "all scenes, one core": all_scenes,
        "ledger": ledger,
        "`W_max`": scene / (PRODUCTS * t_ledger),
        "everything, `T_full`": first + all_scenes / WORKERS + ledger,
        "a night of n = 1e5 files in s = 70 scenes, one worker": night,
    }
    for name, value in expected.items():
        number, digit = stated[name]
        assert number == pytest.approx(value, abs=0.51 * digit), name

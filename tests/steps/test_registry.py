"""A package that adds a kind of product is refused where it is incomplete, and its bugs show."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lidarops import kinds as all_kinds
from lidarops.errors import LidarOpsError
from lidarops.kinds import Kind
from lidarops.products.signal.settings import SignalSettings
from lidarops.steps import registry

CLASHING = """
from lidarops.products.signal.steps import Signal
from lidarops.steps.conditioning import Noise

class Step(Signal):
    name = "odd"
    parts = (Noise(),)

STEP = Step()
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of a kind ``odd`` without modules."""
    folder = tmp_path / "odd_kind"
    folder.mkdir()
    (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    kind = Kind("odd", "Odd", "odd_kind", SignalSettings, rank=99)
    known = {**all_kinds.kinds(), "odd": kind}
    monkeypatch.setattr(all_kinds, "kinds", lambda: known)
    registry._definitions.cache_clear()
    yield folder
    registry._definitions.cache_clear()
    for name in [name for name in sys.modules if name.startswith("odd_kind")]:
        del sys.modules[name]


def test_a_kind_without_steps_is_incomplete(package: Path) -> None:
    with pytest.raises(LidarOpsError, match=r"incomplete: odd_kind\.steps has no STEP"):
        registry.making_step("odd")
    (package / "steps.py").write_text("OTHER = 1\n")
    with pytest.raises(LidarOpsError, match="incomplete"):
        registry.making_step("odd")


def test_an_error_in_a_module_of_a_kind_is_not_hidden(package: Path) -> None:
    (package / "steps.py").write_text("import no_such_package\n")
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        registry.making_step("odd")


def test_the_step_of_a_kind_has_its_name(package: Path) -> None:
    (package / "steps.py").write_text("from lidarops.products.signal.steps import STEP\n")
    with pytest.raises(LidarOpsError, match="'odd'"):
        registry.making_step("odd")


def test_steps_have_names_of_their_own(package: Path) -> None:
    (package / "steps.py").write_text(CLASHING)
    with pytest.raises(LidarOpsError, match="have one name"):
        registry.needed_steps("odd")

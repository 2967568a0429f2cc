"""A package that adds a kind of product is refused where it is incomplete, and its bugs show."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.cases import each

from lidarops import kinds as all_kinds
from lidarops.errors import LidarOpsError
from lidarops.kinds import Kind
from lidarops.products.signal import SignalSettings
from lidarops.scene.pipe import Stages
from lidarops.scene.retrieval import Making, Retrieval, making


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of a kind ``odd`` without modules."""
    folder = tmp_path / "odd_kind"
    folder.mkdir()
    (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    kind = Kind("odd", "Odd", "odd_kind", SignalSettings, rank=99)
    known = {**all_kinds.kinds(), "odd": kind}
    monkeypatch.setattr("lidarops.scene.retrieval.kinds", lambda: known)
    yield folder
    for name in [name for name in sys.modules if name.startswith("odd_kind")]:
        del sys.modules[name]


def test_a_kind_without_steps_is_incomplete(package: Path) -> None:
    with pytest.raises(LidarOpsError, match=r"incomplete: odd_kind\.retrieval has no RETRIEVAL"):
        making("odd", Retrieval)
    (package / "retrieval.py").write_text("OTHER = 1\n")
    with pytest.raises(LidarOpsError, match="incomplete"):
        making("odd", Retrieval)


def test_an_error_in_a_module_of_a_kind_is_not_hidden(package: Path) -> None:
    (package / "retrieval.py").write_text("import no_such_package\n")
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        making("odd", Retrieval)


def test_the_settings_of_a_kind_have_its_name(package: Path) -> None:
    words = "from lidarops.products.signal.retrieval import RETRIEVAL\n"
    (package / "retrieval.py").write_text(words)
    with pytest.raises(LidarOpsError, match="'odd'"):
        making("odd", Retrieval)


def test_a_kind_of_channels_is_no_kind_of_networks(package: Path) -> None:
    words = "from lidarops.products.visibility.retrieval import RETRIEVAL\n"
    (package / "retrieval.py").write_text(words)
    with pytest.raises(LidarOpsError, match="is no Retrieval"):
        making("odd", Retrieval)


@each("kind", all_kinds.kinds())
def test_entries_of_a_kind_have_names_of_their_own(kind: str) -> None:
    assert not set(making(kind, Making).settings.model_fields) & set(Stages.model_fields)


def test_a_kind_reads_only_kinds_that_are_made_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = Kind("odd", "Odd", "odd_kind", SignalSettings, rank=1, reads=("signal",))
    known = {**all_kinds.kinds(), "odd": odd}
    monkeypatch.setattr(all_kinds, "registered", lambda *_: known)
    with pytest.raises(LidarOpsError, match="'odd' reads 'signal', which is no"):
        all_kinds.kinds.__wrapped__()

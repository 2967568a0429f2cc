"""Digests of modules with all that they import, and the cache of facts about sources."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest

from lidarops.errors import LidarOpsError
from lidarops.system import source_closure
from lidarops.system.source_closure import Sources

PACKAGE: Mapping[str, str] = {
    "__init__.py": "",
    "start.py": "from package.near import near\nimport numpy\nfrom package import space\n",
    "near/__init__.py": "from . import near\n",
    "near/near.py": "from ..far import away\nimport package.apart.words\n",
    "far.py": "away = 1\n",
    "apart/__init__.py": "import package.unseen\n",
    "apart/words.py": "",
    "unseen.py": "",
    "space/inside.py": "",
    "near.py": "hidden = 'by the package of the same name'\n",
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Folder of a small package."""
    root = tmp_path / "package"
    for name, text in PACKAGE.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def sources(root: Path, cache: Path | None = None) -> Sources:
    """Return the sources of the package as they are now."""
    return Sources({"package": (root,)}, apart=["package.apart"], cache=cache)


def digest(root: Path, cache: Path | None = None) -> str:
    """Return the digest of what one module imports."""
    return sources(root, cache).digest(["package.start"])


def test_a_closure_holds_modules_and_the_packages_around_them(root: Path):
    assert set(sources(root).closure(["package.start"])) == {
        "package", "package.start", "package.near", "package.near.near", "package.far",
    }  # fmt: skip


def test_a_package_may_lie_in_several_folders(root: Path, tmp_path: Path):
    other = tmp_path / "elsewhere" / "package"
    other.mkdir(parents=True)
    shutil.move(root / "far.py", other)
    split = Sources({"package": (root, other)}, apart=["package.apart"])
    assert split.closure(["package.start"])["package.far"] == other / "far.py"
    (root / "far.py").write_text(PACKAGE["far.py"])
    assert split.digest(["package.start"]) == digest(root)


def test_the_name_of_a_module_counts(root: Path):
    before = digest(root)
    (root / "near/near.py").write_text("import package.apart.words\nfrom package.off import away\n")
    first = digest(root)
    shutil.move(root / "far.py", root / "off.py")
    assert len({before, first, digest(root)}) == 3


def test_a_source_is_parsed_once(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    parsed: list[bytes] = []
    parse = source_closure.source_facts
    monkeypatch.setattr(
        source_closure, "source_facts", lambda source: parsed.append(source) or parse(source)
    )
    before = digest(root, tmp_path / "cache")
    parsed.clear()
    assert digest(root, tmp_path / "cache") == before
    assert parsed == []
    (root / "far.py").write_text("away = 2\n")
    assert digest(root, tmp_path / "cache") != before
    assert parsed == [b"away = 2\n"]


def test_facts_that_are_no_longer_used_are_given_up(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(source_closure, "_MOST_KEPT", 6)
    for number in range(20):
        (root / "far.py").write_text(f"away = {number}\n" + "a = 1\n" * 100)
        digest(root, tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    assert file.read_text().count("[") <= 7


@pytest.mark.parametrize("content", ["", "[1, 2]", '[["a"]]', '{"a": 1}', "[[["])
def test_a_damaged_cache_is_written_anew(root: Path, tmp_path: Path, content: str):
    before = digest(root, tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    good = file.read_bytes()
    file.write_text(content)
    assert digest(root, tmp_path / "cache") == before
    assert file.read_bytes() == good


def test_without_a_cache_folder_digests_are_the_same(root: Path, tmp_path: Path):
    # A folder cannot be made below a file.
    (tmp_path / "file").write_text("")
    assert digest(root, tmp_path / "file") == digest(root) == digest(root, tmp_path / "cache")


def test_a_source_that_is_no_python_is_an_error(root: Path):
    (root / "far.py").write_text("def (:\n")
    with pytest.raises(LidarOpsError, match=r"far\.py: is not a source that Python can read"):
        digest(root)


def test_a_module_that_does_not_exist_cannot_be_asked_for(root: Path):
    with pytest.raises(LidarOpsError, match=r"package\.nowhere is missing"):
        sources(root).digest(["package.nowhere"])

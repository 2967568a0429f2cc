"""Digests of modules with all that they import."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest

from lidarops.errors import LidarOpsError
from lidarops.system.code_version import Sources, imported_modules

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


def sources(root: Path) -> Sources:
    """Return the sources of the package as they are now."""
    return Sources({"package": (root,)}, apart=["package.apart"])


def digest(root: Path) -> str:
    """Return the digest of what one module imports."""
    return sources(root).digest(["package.start"])


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


def parsed_imports(tree: ast.AST) -> set[str]:
    """Return the modules of all import statements but those for types, by the syntax tree."""
    found: set[str] = set()
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            dot = "" if module.endswith(".") else "."
            found |= {module, *(f"{module}{dot}{alias.name}" for alias in node.names)}
        found |= parsed_imports(node)
    return found


def test_no_import_of_any_source_is_missed(repository: Path):
    for path in sorted((repository / "lidarops").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert parsed_imports(ast.parse(text)) <= set(imported_modules(text)), path


@pytest.mark.parametrize(
    ("statement", "modules"),
    [
        ("import a.b, c as d", {"a.b", "c"}),
        ("from a import (  # words (of two\n    b,\n    c as d,\n)", {"a", "a.b", "a.c"}),
        ("from a import b, \\\n    c", {"a", "a.b", "a.c"}),
        ("from .. import a", {"..", "..a"}),
        ("from .a import b", {".a", ".a.b"}),
        ("try: import a; import b\nexcept ImportError: pass", {"a", "b"}),
        ("def late():\n    from a import *", {"a", "a.*"}),
        ("if typing.TYPE_CHECKING:\n    import a\n\n    import b\nimport c", {"c"}),
        ("if TYPE_CHECKING:\n    import a\nelse:\n    import b", {"b"}),
        ("# import a\nimported = from_a", set()),
    ],
)
def test_every_form_of_import_is_found(statement: str, modules: set[str]):
    ast.parse(statement)
    assert set(imported_modules(statement)) == modules


def test_a_source_that_cannot_be_read_is_an_error(root: Path, monkeypatch: pytest.MonkeyPatch):
    read = Path.read_bytes

    def fail(path: Path) -> bytes:
        if path.name == "far.py":
            raise PermissionError(13, "Permission denied")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", fail)
    with pytest.raises(LidarOpsError, match=r"far\.py: cannot be read: Permission denied"):
        digest(root)


def test_a_module_that_does_not_exist_cannot_be_asked_for(root: Path):
    with pytest.raises(LidarOpsError, match=r"package\.nowhere is missing"):
        sources(root).digest(["package.nowhere"])

"""A copy of the sources of lidarops that a test may change."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

from lidarops.kinds import kinds
from lidarops.system import code_version
from lidarops.system.code_version import Sources, source_roots, version_of

# By their text, of which a test changes that of few modules.
code_version.imported_modules = cache(code_version.imported_modules)


class Copy:
    """A copy of the package.

    Parameters
    ----------
    repository : Path
        Root of the checkout.
    folder : Path
        Folder for the copy.
    """

    def __init__(self, repository: Path, folder: Path) -> None:
        self.root = folder / "lidarops"
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(repository / "lidarops", self.root, ignore=ignored)
        self._last: dict[str, str] | None = None

    def sources(self) -> Sources:
        """Return the sources as they are now."""
        return Sources({**source_roots(), "lidarops": (self.root,)})

    def versions(self) -> dict[str, str]:
        """Return the code version of every kind."""
        sources = self.sources()
        return {name: version_of(kind, sources) for name, kind in kinds().items()}

    def changed(self, *modules: str) -> set[str]:
        """Return the kinds whose version changes with a statement more in some modules."""
        before = self._last or self.versions()
        for module in modules:
            self.change(module)
        self._last = self.versions()
        return {kind for kind, version in self._last.items() if version != before[kind]}

    def write(self, module: str, text: str) -> None:
        """Write a module, or another file of the package."""
        self._last = None
        (self.root / module).write_text(text, encoding="utf-8")

    def change(self, module: str, statement: str = "_UNHEARD_OF = 1") -> None:
        """Append a statement to a module."""
        self._last = None
        with (self.root / module).open("a", encoding="utf-8") as file:
            file.write(f"\n{statement}\n")

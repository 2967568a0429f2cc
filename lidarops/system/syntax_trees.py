"""Digest of a Python source by its syntax tree, and the modules that it imports."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

_WITHOUT_MEANING: Final = frozenset({"ctx", "kind", "type_comment", "type_ignores"})
"""Fields of nodes that follow from others or change nothing."""


@dataclass(frozen=True, slots=True)
class SourceFacts:
    """What one source says."""

    digest: str
    """Digest of its syntax tree: equal for sources that differ in comments, docstrings, layout or
    line endings."""
    imports: tuple[str, ...]
    """Modules that it may import, also within functions. ``from a import b`` gives ``a`` and
    ``a.b``, because ``b`` may be a module; a relative import begins with its dots. Imports for type
    checking are left out."""


def source_facts(source: bytes) -> SourceFacts:
    """Return the digest and the imports of a source.

    Parameters
    ----------
    source : bytes
        Content of the file.

    Raises
    ------
    SyntaxError, ValueError
        If it is not valid Python.
    """
    tree = ast.parse(source)
    digest = hashlib.sha256()
    imports: set[str] = set()
    waiting: list[str | ast.AST] = [tree]
    # A stack, because a long expression is nested more deeply than functions may be.
    while waiting:
        item = waiting.pop()
        if isinstance(item, str):
            digest.update(item.encode())
            continue
        imports.update(_imports(item))
        waiting.extend(reversed(list(_content(item))))
    return SourceFacts(digest.hexdigest(), tuple(sorted(imports)))


def _content(node: ast.AST) -> Iterator[str | ast.AST]:
    """Yield texts and nodes that a node consists of.

    `ast.dump` writes other text in other versions of Python.
    """
    yield f"{type(node).__name__}("
    for name in node._fields:
        field = getattr(node, name, None)
        if isinstance(field, list):
            items = _effective(node, field)
            if items:
                yield f"{name}=["
                for item in items:
                    yield from _value(item)
                yield "]"
        elif field is not None and name not in _WITHOUT_MEANING:
            yield f"{name}="
            yield from _value(field)
    yield ")"


def _value(value: Any) -> Iterator[str | ast.AST]:
    if isinstance(value, ast.AST):
        yield value
    else:
        # `repr` writes letters in the way of the version's Unicode.
        yield f"{value!a},"


def _effective(node: ast.AST, items: Sequence[Any]) -> list[Any]:
    """Return the items of a list without those that change nothing."""
    if isinstance(node, ast.JoinedStr):
        return _joined(items)
    effective = []
    for item in items:
        if _is_for_type_checking(item):
            effective += _effective(item, item.orelse)
        elif not (
            isinstance(item, ast.Pass | ast.TypeIgnore)
            or (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))
        ):
            effective.append(item)
    return effective


def _joined(items: Sequence[ast.expr]) -> list[ast.expr]:
    """Return the parts of an f-string with neighbouring texts as one, and without empty ones."""
    joined: list[ast.expr] = []
    for item in items:
        if not isinstance(item, ast.Constant):
            joined.append(item)
        elif joined and isinstance(previous := joined[-1], ast.Constant):
            joined[-1] = ast.Constant(str(previous.value) + str(item.value))
        elif item.value:
            joined.append(item)
    return joined


def _is_for_type_checking(node: object) -> bool:
    if not isinstance(node, ast.If):
        return False
    test = node.test
    name = test.attr if isinstance(test, ast.Attribute) else getattr(test, "id", "")
    return name == "TYPE_CHECKING"


def _imports(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        module = "." * node.level + (node.module or "")
        yield module
        dot = "" if module.endswith(".") else "."
        yield from (f"{module}{dot}{alias.name}" for alias in node.names)

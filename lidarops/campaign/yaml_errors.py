"""What is wrong in a YAML file that a person wrote: where, and what would be right there."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

_MERGE = "tag:yaml.org,2002:merge"
_KEY = "[key]"
"""What pydantic puts behind a key of a mapping that is itself wrong."""


def duplicate_keys(tree: yaml.Node | None) -> list[str]:
    """Name the keys that stand twice in a mapping: YAML's own reader takes the last one silently.

    Parameters
    ----------
    tree : yaml.Node or None
        As composed.

    Returns
    -------
    list of str
        A key and both its lines each, by line.
    """
    found: list[tuple[int, str]] = []
    seen: set[int] = set()
    # No recursion, as an anchor may hold itself.
    due: list[tuple[str, yaml.Node]] = [] if tree is None else [("", tree)]
    while due:
        place, node = due.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        due += [(f"{place}{name}.", value) for name, _, value in _children(node)]
        if not isinstance(node, yaml.MappingNode):
            continue
        lines: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if key.tag == _MERGE or not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in lines:
                told = f"{place}{key.value}: stands twice, in lines {lines[key.value]} and {line}"
                found.append((line, told))
            lines[key.value] = line
    return [told for _, told in sorted(found)]


def explain_yaml_error(
    error: ValidationError, tree: yaml.Node | None, model: type[BaseModel], words: Mapping[str, str]
) -> list[str]:
    """Say of every mistake in what line it is, and what would be right there.

    Parameters
    ----------
    error : ValidationError
    tree : yaml.Node or None
        Of the file.
    model : type
        What the file was validated as.
    words : mapping of str to str
        What texts of a pattern may be, by the pattern.

    Returns
    -------
    list of str
        A line each.
    """
    lines = []
    for problem in error.errors():
        keys = [str(key) for key in problem["loc"] if key != _KEY]
        line = _line_of(tree, keys)
        place = ".".join(keys) or "top level"
        said = _message(problem, keys, model, words)
        lines.append(f"{f'line {line}: ' if line else ''}{place}: {said}")
    return lines


def _message(
    problem: ErrorDetails, keys: list[str], model: type[BaseModel], words: Mapping[str, str]
) -> str:
    pattern = str(problem.get("ctx", {}).get("pattern"))
    if problem["type"] == "string_pattern_mismatch" and pattern in words:
        return f"must be {words[pattern]}, not {problem['input']!r}"
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, keys[:-1])
        if known:
            near = difflib.get_close_matches(keys[-1], known, n=3)
            others = [name for name in known if name not in near]
            return f"is no key that is known here; known: {', '.join([*near, *others])}"
    return problem["msg"]


def _known_keys(model: type[BaseModel], keys: Sequence[str]) -> list[str]:
    """Return the keys that a part of a file may have, by name."""
    there: list[Any] = [model]
    for key in keys:
        below = [inner for kind in there for inner in _below(kind, key)]
        # Where there is no such part, the key tells which of several kinds a part was taken for.
        there = below or [kind for kind in there if _is_kind(kind, key)] or there
    return sorted({name for kind in there for name in kind.model_fields if _is_model(kind)})


def _below(kind: Any, key: str) -> list[Any]:
    if _is_model(kind):
        field = kind.model_fields.get(key)
        return [] if field is None else _models(field.annotation)
    origin, held = get_origin(kind), get_args(kind)
    if origin is dict:
        return _models(held[1])
    if origin in (list, tuple) and key.isdecimal():
        return [inner for each in held for inner in _models(each)]
    return []


def _models(annotation: Any) -> list[Any]:
    """Return the models, lists and mappings that an annotation allows."""
    if _is_model(annotation) or get_origin(annotation) in (dict, list, tuple):
        return [annotation]
    return [inner for each in get_args(annotation) for inner in _models(each)]


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _is_kind(kind: Any, tag: str) -> bool:
    if not _is_model(kind):
        return False
    return kind.__name__ == tag or any(
        tag in get_args(field.annotation) for field in kind.model_fields.values()
    )


def _line_of(node: yaml.Node | None, keys: list[str]) -> int | None:
    line = None
    for key in keys:
        # What a part was taken for stands among the keys, and not in the file.
        for name, mark, value in _children(node):
            if name == key:
                line, node = mark.line + 1, value
                break
    return line


def _children(node: yaml.Node | None) -> Iterator[tuple[str, yaml.Mark, yaml.Node]]:
    """Give what a part holds: its key, where that stands, and what it is."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield str(key.value), key.start_mark, value
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield str(index), value.start_mark, value

"""Explain errors in a YAML file: the line, the key, and the valid choices."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

_MERGE = "tag:yaml.org,2002:merge"
_KEY = "[key]"
"""Appended by pydantic to the location of an invalid key."""


def duplicate_keys(tree: yaml.Node | None) -> list[str]:
    """Return messages on keys that a mapping holds twice; PyYAML silently keeps the last one.

    Parameters
    ----------
    tree : yaml.Node or None
        From `yaml.compose`.

    Returns
    -------
    list of str
        One message a key, with both lines; in order of lines.
    """
    messages: list[tuple[int, str]] = []
    seen: set[int] = set()
    # No recursion, because an anchor may contain itself.
    stack: list[tuple[str, yaml.Node]] = [] if tree is None else [("", tree)]
    while stack:
        place, node = stack.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        stack += [(f"{place}{name}.", value) for name, _, value in _children(node)]
        if not isinstance(node, yaml.MappingNode):
            continue
        lines: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if key.tag == _MERGE or not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in lines:
                message = f"{place}{key.value}: given twice, in lines {lines[key.value]} and {line}"
                messages.append((line, message))
            lines[key.value] = line
    return [message for _, message in sorted(messages)]


def explain_yaml_error(
    error: ValidationError, tree: yaml.Node | None, model: type[BaseModel], words: Mapping[str, str]
) -> list[str]:
    """Return one message for each error, with its line and the valid choices.

    Parameters
    ----------
    error : ValidationError
    tree : yaml.Node or None
        Nodes of the file.
    model : type
        Model of the file.
    words : mapping of str to str
        Pattern of a text -> description of the texts that match it.

    Returns
    -------
    list of str
    """
    lines = []
    for problem in error.errors():
        keys = [str(key) for key in problem["loc"] if key != _KEY]
        line = _line_of(tree, keys)
        place = ".".join(keys) or "top level"
        message = _message(problem, keys, model, words)
        lines.append(f"{f'line {line}: ' if line else ''}{place}: {message}")
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
            return f"unknown key; keys here are {', '.join([*near, *others])}"
    return problem["msg"]


def _known_keys(model: type[BaseModel], keys: Sequence[str]) -> list[str]:
    """Return the valid keys at a location of a file, sorted."""
    candidates: list[Any] = [model]
    for key in keys:
        below = [inner for kind in candidates for inner in _below(kind, key)]
        # A location key without a node names the member of a union that pydantic tried.
        candidates = below or [kind for kind in candidates if _is_kind(kind, key)] or candidates
    return sorted({name for kind in candidates for name in kind.model_fields if _is_model(kind)})


def _below(kind: Any, key: str) -> list[Any]:
    if _is_model(kind):
        field = kind.model_fields.get(key)
        return [] if field is None else _models(field.annotation)
    origin, held = get_origin(kind), get_args(kind)
    if origin is dict:
        return _models(held[1])
    if origin in (list, tuple) and key.isdecimal():
        return [inner for annotation in held for inner in _models(annotation)]
    return []


def _models(annotation: Any) -> list[Any]:
    """Return the models, lists and mappings that an annotation allows."""
    if _is_model(annotation) or get_origin(annotation) in (dict, list, tuple):
        return [annotation]
    return [inner for argument in get_args(annotation) for inner in _models(argument)]


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
        # A key that names a member of a union is not in the file: keep the node.
        for name, mark, value in _children(node):
            if name == key:
                line, node = mark.line + 1, value
                break
    return line


def _children(node: yaml.Node | None) -> Iterator[tuple[str, yaml.Mark, yaml.Node]]:
    """Yield key, position and value of the entries of a node."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield str(key.value), key.start_mark, value
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield str(index), value.start_mark, value

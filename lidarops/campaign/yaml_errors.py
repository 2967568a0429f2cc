"""Read quantities of a YAML file by its schema, and explain its errors.

Messages state the line, the key, the value, and what is expected there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, Self

import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from lidarops.settings import NO_UNIT, nearest
from lidarops.units import PATTERN, is_quantity, is_small, parse_quantity, written

_DECIMAL: Final = re.compile(r"[+-]?(?:0|[1-9][0-9_]*)", re.ASCII)
"""Whole number that is the same in any version of YAML."""
_COMMA: Final = re.compile(r"\s*[+-]?\d+,(?!\d{3}\b)\d+\D*$", re.ASCII)
_MERGE = "tag:yaml.org,2002:merge"
_KEY = "[key]"
"""Appended by pydantic to the location of an invalid key."""
_OWN_WORDS: Final = ("value_error", "located")
"""Types of errors whose message comes from a validator."""
_LONGEST: Final = 60
"""Characters of a value that a message shows."""
_WORDS = {
    "string": "text",
    "boolean": "true or false",
    "object": "a mapping of keys to values",
}

Schema = dict[str, Any]


class Loader(yaml.SafeLoader):
    """Reads a YAML file as `yaml.SafeLoader`, but yes, no, on and off as texts.

    A key or a name may be ``no``. Where a model has a boolean, pydantic takes these texts for one,
    as it does 1, 0, ``'true'`` and ``'false'``. Texts are also what YAML 1.1 reads in another base:
    ``-5:00``, which is 5 h and not 300 s, and ``060``, which is 60 and not 48.
    """

    def construct_yaml_int(self, node: yaml.ScalarNode) -> Any:
        """Return a decimal number, or the text of what is none."""
        text = str(node.value)
        return super().construct_yaml_int(node) if _DECIMAL.fullmatch(text) else text

    def construct_yaml_float(self, node: yaml.ScalarNode) -> Any:
        """Return a number, or the text of one with colons."""
        text = str(node.value)
        return text if ":" in text else super().construct_yaml_float(node)


for _name in ("int", "float"):
    Loader.add_constructor(f"tag:yaml.org,2002:{_name}", getattr(Loader, f"construct_yaml_{_name}"))


Loader.yaml_implicit_resolvers = {
    first: [known for known in resolvers if known[0] != "tag:yaml.org,2002:bool"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


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


def with_plain_numbers(content: Any, schema: Callable[[], dict[str, Any]]) -> Any:
    """Return the content of a file with quantities, such as ``4 ns``, as numbers in the unit there.

    What is none, or has a unit of another dimension, is left for the validation to name.

    Parameters
    ----------
    content : object
        Of YAML.
    schema : callable
        Returns the JSON schema of the file, with units; called where a text may be a quantity.
    """
    texts = _texts(content)
    return _plain(content, Expected.root(schema())) if any(map(is_quantity, texts)) else content


def _texts(content: Any) -> Iterator[str]:
    """Yield all texts that are values."""
    stack, seen = [content], set[int]()
    while stack:
        value = stack.pop()
        if isinstance(value, str):
            yield value
        # An anchor may contain itself.
        elif isinstance(value, dict | list) and id(value) not in seen:
            seen.add(id(value))
            stack += value.values() if isinstance(value, dict) else value


def _plain(content: Any, expected: Expected | None) -> Any:
    if expected is None:
        return content
    if isinstance(content, dict):
        return {key: _plain(value, expected.below(str(key))) for key, value in content.items()}
    if isinstance(content, list):
        return [_plain(value, expected.below(str(k))) for k, value in enumerate(content)]
    if isinstance(content, str) and expected.unit and not expected.takes_any_text():
        number = parse_quantity(content, expected.unit)
        return content if number is None else number
    return content


def with_quantities(schema: Any, unit: str | None = None) -> Any:
    """Return a JSON schema for editors, in which numbers with a unit may be quantities."""
    if isinstance(schema, list):
        return [with_quantities(inner, unit) for inner in schema]
    if not isinstance(schema, dict):
        return schema
    unit = schema.get("unit", unit) if isinstance(schema.get("unit"), str | None) else unit
    if schema.get("type") in ("number", "integer") and unit:
        return {"anyOf": [schema, {"type": "string", "pattern": f"^{PATTERN}$"}]}
    return {key: with_quantities(inner, unit) for key, inner in schema.items()}


def explain_yaml_error(
    error: ValidationError, tree: yaml.Node | None, schema: dict[str, Any]
) -> list[str]:
    """Return one message for each place of an error: line, key, what is expected, and the value.

    Parameters
    ----------
    error : ValidationError
    tree : yaml.Node or None
        Nodes of the file.
    schema : dict
        JSON schema of the file, with units.

    Returns
    -------
    list of str
    """
    problems = [_Problem(details, tree, Expected.root(schema)) for details in error.errors()]
    messages: dict[str, str] = {}
    for problem in problems:
        # Pydantic names an error for each member of a union: the nested ones say more.
        above = problem.keys
        nested = any(
            len(other.keys) > len(above) and other.keys[: len(above)] == above for other in problems
        )
        if not (problem.of_union and nested):
            messages.setdefault(problem.place, problem.message())
    return list(messages.values())


class _Problem:
    """One error of pydantic, its place in the file, and what the schema expects there."""

    def __init__(self, details: ErrorDetails, tree: yaml.Node | None, root: Expected) -> None:
        self.details, self.tree = details, tree
        self.of_key = details["loc"][-1:] == (_KEY,)
        location = [str(key) for key in details["loc"] if key != _KEY]
        location += [str(key) for key in details.get("ctx", {}).get("keys", ())]
        unknown = location.pop() if details["type"] == "extra_forbidden" else None
        self.keys: list[str] = []
        self.expected = root
        self.of_union = False
        self.mapping = root
        for key in location:
            below = self.expected.below(key)
            # A location key that the schema lacks names the member of a union that was tried.
            self.of_union = below is None
            if below is not None:
                self.mapping, self.expected = self.expected, below
                self.keys.append(key)
        self.unknown = unknown
        self.keys += [] if unknown is None else [unknown]
        self.line, self.node, names = _find(tree, self.keys)
        self.name = names[-1] if names else ""
        self.place = ".".join(names) or "top level"

    def message(self) -> str:
        """Return the line, the key and the text."""
        line = f"line {self.line}: " if self.line else ""
        return f"{line}{self.place}: {self._text()}"

    def _text(self) -> str:
        kind = self.details["type"]
        if self.unknown is not None:
            return self._on_unknown_key(self.unknown)
        if self.of_key:
            return f"must be {self.mapping.words_of_keys()}, not {self.name!r}"
        if kind == "missing":
            return f"is required: {self.expected.words()}"
        if kind in _OWN_WORDS:
            return self.details["msg"].removeprefix("Value error, ")
        return f"must be {self.expected.words()}, not {self._value()}{self._hint()}"

    def _on_unknown_key(self, key: str) -> str:
        known = self.expected.keys()
        # In braces, 7,5 m is the value 7 and the key 5 m.
        entries = list(_children(_find(self.tree, self.keys[:-1])[1]))
        for (_, _, before), (name, _, _) in pairwise(entries):
            if name == key and key[:1].isdecimal() and isinstance(before, yaml.ScalarNode):
                return f"is no key; decimals stand behind a point: {before.value}.{key}"
        question = nearest(key, known)
        near = [name for name in known if repr(name) in question]
        others = [name for name in known if name not in near]
        return f"unknown key; {question}keys here are {', '.join([*near, *others])}"

    def _value(self) -> str:
        """Return the value as it is written in the file."""
        value = self.details["input"]
        if isinstance(value, dict):
            return "a mapping"
        if isinstance(value, str) or not isinstance(self.node, yaml.ScalarNode):
            text = repr(value)
        else:
            text = self.node.value or "empty"
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."

    def _hint(self) -> str:
        """Return the nearest valid choice, or why YAML reads another type than was meant."""
        value = self.details["input"]
        question = nearest(str(value), self.expected.choices()) if isinstance(value, str) else ""
        if self.expected.unit and isinstance(value, str) and _COMMA.match(value):
            question = f"decimals stand behind a point: {value.replace(',', '.').strip()}"
        return f"; {question.strip()}" if question else ""


def _find(
    node: yaml.Node | None, keys: list[str]
) -> tuple[int | None, yaml.Node | None, list[str]]:
    """Return line and node of the last key that the file has, and the keys as written there."""
    line, names, value = None, [], node
    for key in keys:
        entry = next((entry for entry in _children(value) if entry[0] == key), None)
        names.append(key if entry is None else entry[0])
        if entry is not None:
            line, value = entry[1].line + 1, entry[2]
        else:
            value = None
    return line, value, names


def _children(node: yaml.Node | None) -> Iterator[tuple[str, yaml.Mark, yaml.Node]]:
    """Yield key, position and value of the entries of a node."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield str(key.value), key.start_mark, value
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield str(index), value.start_mark, value


@dataclass(frozen=True)
class Expected:
    """What a JSON schema expects at a place of a file: the possible schemas, and the unit there."""

    definitions: Schema
    schemas: tuple[Schema, ...]
    """Without references and unions."""
    unit: str | None = None

    @classmethod
    def root(cls, schema: Schema) -> Self:
        """Return what is expected of the whole file."""
        return cls(schema.get("$defs", {}), (schema,))

    def below(self, key: str) -> Expected | None:
        """Return what is expected at a key or index, or None if the schemas have no such place."""
        inner = [schema for outer in self.schemas for schema in _below(outer, key)]
        return self._resolved(inner, self.unit) if inner else None

    def keys(self) -> list[str]:
        """Return the valid keys of mappings, sorted."""
        return sorted({key for schema in self.schemas for key in schema.get("properties", ())})

    def words_of_keys(self) -> str:
        """Return what is expected of the keys of mappings, where only some texts are valid."""
        names = (schema.get("propertyNames", {}) for schema in self.schemas)
        return " or ".join(dict.fromkeys(str(name.get("words", "text")) for name in names))

    def choices(self) -> list[str]:
        """Return the valid texts, where a list gives them."""
        found = (choice for schema in self.schemas for choice in _choices(schema))
        return [choice for choice in found if isinstance(choice, str)]

    def takes_any_text(self) -> bool:
        """Return whether any text may be valid, not only some of a list."""
        texts = [schema for schema in self.schemas if schema.get("type") == "string"]
        return not all(list(_choices(schema)) for schema in texts)

    def words(self) -> str:
        """Return what is expected, such as ``a number from 1 to 200 sr``."""
        texts = [self._words(schema) for schema in self.schemas if schema.get("type") != "null"]
        return " or ".join(dict.fromkeys(texts))

    def _resolved(self, schemas: list[Schema], unit: str | None) -> Expected:
        """Return the schemas without references and unions, with the unit of the innermost."""
        plain = [pair for schema in schemas for pair in self._plain(schema, unit)]
        unit = next((own for _, own in plain if own), None)
        return Expected(
            self.definitions, tuple({**schema, "unit": own} for schema, own in plain), unit
        )

    def _plain(self, schema: Schema, unit: str | None) -> Iterator[tuple[Schema, str | None]]:
        unit = schema.get("unit") or unit
        for union in ("anyOf", "oneOf"):
            for inner in schema.get(union, ()):
                yield from self._plain(inner, unit)
        if "$ref" in schema:
            yield from self._plain(self.definitions[schema["$ref"].rpartition("/")[2]], unit)
        elif not {"anyOf", "oneOf"} & set(schema):
            yield schema, unit

    def _words(self, schema: Schema) -> str:
        kind = schema.get("type", "")
        if choices := list(_choices(schema)):
            return " or ".join(repr(choice) for choice in choices)
        if kind in ("number", "integer"):
            return _number(schema)
        if kind == "array":
            return self._list(schema)
        return str(schema.get("words") or _WORDS.get(kind, "another value"))

    def _list(self, schema: Schema) -> str:
        inner = schema.get("prefixItems", [schema.get("items", {})])
        item = self._resolved(inner, schema.get("unit")).words()
        if "prefixItems" in schema:
            return f"a list of {len(inner)} values, each {item}"
        least = schema.get("minItems", 0)
        return f"a list of {f'at least {least} values' if least else 'values'}, each {item}"


def _below(schema: Schema, key: str) -> Iterator[Schema]:
    if key in schema.get("properties", {}):
        yield schema["properties"][key]
    elif isinstance(schema.get("additionalProperties"), dict):
        yield schema["additionalProperties"]
    elif schema.get("patternProperties"):
        yield from schema["patternProperties"].values()
    elif schema.get("type") == "array" and key.isdecimal():
        fixed = schema.get("prefixItems", [])
        yield fixed[int(key)] if int(key) < len(fixed) else schema.get("items") or {}


def _choices(schema: Schema) -> Iterator[str]:
    if "const" in schema:
        yield schema["const"]
    yield from schema.get("enum", ())


def _number(schema: Schema) -> str:
    """Return the kind of a number, its bounds and its unit."""
    least, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    most, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    unit = schema.get("unit") or NO_UNIT
    limits: list[tuple[str, Any]] = [
        ("above", above), ("at least", least), ("below", below), ("at most", most)
    ]  # fmt: skip
    limits = [(word, bound) for word, bound in limits if bound is not None]
    small = bool(limits) and all(is_small(bound, unit) for _, bound in limits)
    bounds = {bound: written(bound, unit) if small else _digits(bound) for _, bound in limits}
    parts = ["a whole number" if schema["type"] == "integer" else "a number"]
    if least is not None and most is not None:
        parts.append(f"from {bounds[least]} to {bounds[most]}")
    else:
        parts.append(" and ".join(f"{word} {bounds[bound]}" for word, bound in limits))
    if not small:
        parts.append("(no unit)" if unit == NO_UNIT else str(unit))
    return " ".join(part for part in parts if part)


def _digits(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:.12g}"

"""What a JSON schema expects at a place of a file, in words with bounds and unit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Self

from lidarops.settings import NO_UNIT

_WORDS = {
    "string": "text",
    "boolean": "true or false",
    "object": "a mapping of keys to values",
}

Schema = dict[str, Any]


@dataclass(frozen=True)
class Expected:
    """The schemas that are possible at a place, and the unit that holds there."""

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
        return self._of(inner, self.unit) if inner else None

    def member(self, tag: str) -> Expected:
        """Return what is expected of the member of a union that has a tag or title."""
        chosen = tuple(schema for schema in self.schemas if _has_tag(schema, tag))
        return replace(self, schemas=chosen or self.schemas)

    def keys(self) -> list[str]:
        """Return the valid keys of mappings, sorted."""
        return sorted({key for schema in self.schemas for key in schema.get("properties", ())})

    def words_of_keys(self) -> str:
        """Return what is expected of the keys of mappings, where only some texts are valid."""
        names = (schema.get("propertyNames", {}) for schema in self.schemas)
        return " or ".join(dict.fromkeys(str(name.get("words", "text")) for name in names))

    def choices(self) -> list[str]:
        """Return the valid texts, where a list gives them."""
        return [text for schema in self.schemas for text in _choices(schema)]

    def words(self) -> str:
        """Return what is expected, such as ``a number from 1 to 200 sr``."""
        texts = [self._words(schema) for schema in self.schemas if schema.get("type") != "null"]
        return " or ".join(dict.fromkeys(texts))

    def _of(self, schemas: list[Schema], unit: str | None) -> Expected:
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
        item = self._of(inner, schema.get("unit")).words()
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


def _has_tag(schema: Schema, tag: str) -> bool:
    tags = [inner.get("const") for inner in schema.get("properties", {}).values()]
    return tag == schema.get("title") or tag in tags


def _choices(schema: Schema) -> Iterator[str]:
    if "const" in schema:
        yield schema["const"]
    yield from schema.get("enum", ())


def _number(schema: Schema) -> str:
    """Return the kind of a number, its bounds and its unit."""
    least, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    most, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    parts = ["a whole number" if schema["type"] == "integer" else "a number"]
    if least is not None and most is not None:
        parts.append(f"from {_digits(least)} to {_digits(most)}")
    else:
        limits = (("above", above), ("at least", least), ("below", below), ("at most", most))
        parts.append(" and ".join(f"{w} {_digits(x)}" for w, x in limits if x is not None))
    unit = schema.get("unit")
    parts.append("(no unit)" if unit in (None, NO_UNIT) else str(unit))
    return " ".join(part for part in parts if part)


def _digits(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:.12g}"

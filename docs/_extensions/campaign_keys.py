"""The page of the keys of a campaign file, from its JSON schema."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import timedelta
from typing import Any, Final

from product_variables import own_kinds
from pydantic import TypeAdapter
from tables import first_paragraph, table

from lidarops.campaign.model import campaign_schema
from lidarops.kinds import kinds

_BOUNDS: Final = {
    "minimum": "≥ {}",
    "exclusiveMinimum": "> {}",
    "maximum": "≤ {}",
    "exclusiveMaximum": "< {}",
    "minItems": "at least {}",
    "maxItems": "at most {}",
}
_TYPES: Final = {
    "boolean": "true or false",
    "integer": "whole number",
    "string": "text",
}
_DURATION: Final = re.compile(r"PT?\d")
_TIMEDELTA: Final = TypeAdapter(timedelta)
_LONGEST_DEFAULT: Final = 60
"""Characters; a longer default is that of the mapping that the key names."""


def page() -> str:
    """Return a section for the file, and for each mapping within it in the order of mention."""
    schema = campaign_schema()
    definitions = schema["$defs"]
    for name in kinds().keys() - own_kinds():
        definitions["Products"]["properties"].pop(name, None)
    lines = ["## The file", *_keys(schema)]
    for name in _mentioned(schema, definitions):
        section = definitions[name]
        if "properties" in section:
            lines += [f"## {name}", "", first_paragraph(section.get("description"))]
            lines += _keys(section)
    return "\n".join(lines)


def _mentioned(schema: dict[str, Any], definitions: dict[str, Any]) -> list[str]:
    """Return the names of definitions, those of the first level first."""
    names: dict[str, None] = {}
    level = list(_references(schema["properties"]))
    while level:
        names |= dict.fromkeys(level)
        deeper = [name for parent in level for name in _references(definitions[parent])]
        level = [name for name in deeper if name not in names]
    return list(names)


def _references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        if "$ref" in value:
            yield _name(value)
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _references(item)


def _name(reference: dict[str, Any]) -> str:
    return str(reference["$ref"]).rpartition("/")[2]


def _keys(section: dict[str, Any]) -> Iterator[str]:
    required = section.get("required", ())
    yield from table(
        ("key", "value", "default", "meaning"),
        [
            (
                f"`{key}`",
                _value(field),
                "required" if key in required else _default(field),
                _meaning(field),
            )
            for key, field in section["properties"].items()
        ],
    )


def _meaning(field: dict[str, Any]) -> str:
    """Return what a key means: its own description, or that of the one section it leads to."""
    unit = f"[{field.get('unit')}]"
    # The value states the unit.
    if text := str(field.get("description", "")).removesuffix(unit).strip():
        return text
    names = set(_references(field))
    definition = campaign_schema()["$defs"][names.pop()] if len(names) == 1 else {}
    text = first_paragraph(definition.get("description")).rstrip(".")
    return text[:1].lower() + text[1:]


def _default(field: dict[str, Any]) -> str:
    value = field.get("default")
    if isinstance(value, str) and _DURATION.match(value):
        value = _interval(_TIMEDELTA.validate_python(value))
    text = json.dumps(value, ensure_ascii=False)
    if value in (None, "", [], {}) or isinstance(value, dict) or len(text) > _LONGEST_DEFAULT:
        return ""
    return f"`{text}`" if isinstance(value, list) else f"`{text.strip(chr(34))}`"


def _interval(duration: timedelta) -> str:
    """Return an interval as campaign files write it, in the largest unit that divides it."""
    seconds = round(duration.total_seconds())
    units = {"d": 86400, "h": 3600, "min": 60, "s": 1}
    return next(f"{seconds // size}{unit}" for unit, size in units.items() if seconds % size == 0)


def _value(field: dict[str, Any]) -> str:
    if "$ref" in field:
        definition = campaign_schema()["$defs"][_name(field)]
        linked = f"[{_name(field)}](#{_name(field).lower()}){_unit(field)}"
        return linked if "properties" in definition else _value(definition)
    if "enum" in field or "const" in field:
        return ", ".join(f"`{value}`" for value in field.get("enum", [field.get("const")]))
    if choices := field.get("anyOf", field.get("oneOf")):
        others = [choice for choice in choices if choice.get("type") != "null"]
        return " or ".join(dict.fromkeys(_value(_with_unit(choice, field)) for choice in others))
    return _KINDS.get(field.get("type", ""), _plain)(field)


def _with_unit(inner: dict[str, Any], outer: dict[str, Any]) -> dict[str, Any]:
    return {"unit": outer.get("unit"), **inner}


def _list(field: dict[str, Any]) -> str:
    items = field.get("items") or (field.get("prefixItems") or [{}])[0]
    return ", ".join([f"list of {_value(_with_unit(items, field))}", *_bounds(field)])


def _mapping(field: dict[str, Any]) -> str:
    of_patterns = next(iter(field.get("patternProperties", {}).values()), None)
    values = field.get("additionalProperties") or of_patterns
    return "mapping" + (f" to {_value(values)}" if isinstance(values, dict) else "")


def _plain(field: dict[str, Any]) -> str:
    kind = field.get("type", "")
    text = str(field.get("words") or _TYPES.get(kind, kind))
    shown = text + _unit(field) if kind in {"number", "integer"} else text
    return ", ".join([shown, *_bounds(field)])


def _unit(field: dict[str, Any]) -> str:
    unit = field.get("unit")
    return f" in {unit}" if unit and unit != "1" else ""


def _bounds(field: dict[str, Any]) -> list[str]:
    return [text.format(f"{field[key]:g}") for key, text in _BOUNDS.items() if key in field]


_KINDS: Final = {"array": _list, "object": _mapping}
"""How values that hold others are written, by their type."""

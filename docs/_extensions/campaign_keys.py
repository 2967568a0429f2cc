"""The page of the keys of a campaign file, from its JSON schema."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

from tables import first_paragraph, table

from lidarops.campaign.model import campaign_schema
from lidarops.kinds import kinds

_BOUNDS: Final = {
    "minimum": "≥ {}",
    "exclusiveMinimum": "> {}",
    "maximum": "≤ {}",
    "exclusiveMaximum": "< {}",
    "minLength": "at least {} characters",
    "minItems": "at least {}",
    "maxItems": "at most {}",
}
_TYPES: Final = {
    "boolean": "true or false",
    "integer": "whole number",
    "null": "none",
    "string": "text",
}
_LONGEST_DEFAULT: Final = 60
"""Characters; a longer default is that of the mapping that the key names."""


def page() -> str:
    """Return a section for the file, and for each mapping within it in the order of mention."""
    schema = campaign_schema()
    definitions = schema["$defs"]
    for name, kind in kinds().items():
        if not kind.package.startswith("lidarops."):
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
                str(field.get("description", "")).replace("\n", " "),
            )
            for key, field in section["properties"].items()
        ],
    )


def _default(field: dict[str, Any]) -> str:
    value = field.get("default")
    text = json.dumps(value, ensure_ascii=False)
    if value in (None, "", [], {}) or isinstance(value, dict) or len(text) > _LONGEST_DEFAULT:
        return ""
    return f"`{text}`" if isinstance(value, list) else f"`{text.strip(chr(34))}`"


def _value(field: dict[str, Any]) -> str:
    if "$ref" in field:
        definition = campaign_schema()["$defs"][_name(field)]
        linked = f"[{_name(field)}](#{_name(field).lower()})"
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
    unit = field.get("unit")
    shown = f"{text} in {unit}" if unit and unit != "1" and kind == "number" else text
    return ", ".join([shown, *_bounds(field)])


def _bounds(field: dict[str, Any]) -> list[str]:
    return [text.format(f"{field[key]:g}") for key, text in _BOUNDS.items() if key in field]


_KINDS: Final = {"array": _list, "object": _mapping}
"""How values that hold others are written, by their type."""

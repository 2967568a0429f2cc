"""The page of the command line, from the typer application."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer
from tables import table

from lidarops.cli import app

_EXAMPLE = re.compile(r"^Example: (.+)$", re.MULTILINE)


def page() -> str:
    """Return a section for each command, in the order of the alphabet."""
    shown = commands()
    return "\n".join(line for name in sorted(shown) for line in _section(name, shown[name]))


def commands() -> dict[str, Any]:
    """Return the commands of lidarops that its help lists."""
    every = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return {name: command for name, command in every.items() if not command.hidden}


def _section(name: str, command: Any) -> Iterator[str]:
    text = command.help or ""
    arguments = [item for item in command.params if item.param_type_name == "argument"]
    usage = " ".join(["lidarops", name, "[OPTIONS]", *map(_argument, arguments)])
    yield f"## `{name}`\n"
    yield f"```text\n{usage}\n```\n"
    yield _EXAMPLE.sub("", text).strip()
    if examples := _EXAMPLE.findall(text):
        yield "\n```sh"
        yield from examples
        yield "```"
    rows = [_row(item) for item in command.params if item.help]
    if rows:
        yield from table(("name", "default", "meaning"), rows)
    yield ""


def _argument(parameter: Any) -> str:
    name = _metavar(parameter) + ("..." if parameter.nargs == -1 else "")
    return name if parameter.required else f"[{name}]"


def _metavar(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _row(parameter: Any) -> tuple[str, str, str]:
    if parameter.param_type_name == "argument":
        names = f"`{_metavar(parameter)}`"
    else:
        names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    default = parameter.default
    shown = default is not None and not isinstance(default, bool) and not callable(default)
    return names, f"`{default}`" if shown else "", parameter.help.replace("\n", " ")

"""The size and shape of the sources, as figures: ``python -m support.shape``.

A table of the figures that ``tests/architecture/test_size.py`` holds to limits.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@cache
def text(path: Path) -> str:
    """Return a source."""
    return path.read_text(encoding="utf-8")


@cache
def tree(path: Path) -> ast.Module:
    """Return the syntax tree of a source."""
    return ast.parse(text(path))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of the syntax tree of a source."""
    return tuple(ast.walk(tree(path)))


def sources(*roots: str) -> list[Path]:
    """Return the sources below folders of the checkout, by default those of the library."""
    return [
        path
        for root in roots or ("lidarops", "flows")
        for path in sorted((ROOT / root).rglob("*.py"))
    ]


def lines(*roots: str) -> int:
    """Return the number of lines below folders, those of docstrings and comments included."""
    return sum(text(path).count("\n") for path in sources(*roots))


def code_lines(*roots: str) -> int:
    """Return the number of lines with code: no docstring, no comment, not empty."""
    return sum(len(_code_lines(path)) for path in sources(*roots))


def _code_lines(path: Path) -> set[int]:
    written = enumerate(text(path).splitlines(), start=1)
    coded = {number for number, line in written if line.strip() and line.strip()[0] != "#"}
    return coded - _documented(path)


def _documented(path: Path) -> set[int]:
    """Return the lines of texts that stand alone: docstrings of modules, functions, fields."""
    return {
        line
        for node in nodes(path)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }


def dataclasses() -> list[ast.ClassDef]:
    """Return the dataclasses of the library."""
    return [
        node
        for path in sources()
        for node in nodes(path)
        if isinstance(node, ast.ClassDef)
        and any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]


def tuning_numbers() -> Iterator[tuple[Path, str, str]]:
    """Yield the numbers that tune retrievals: source, name and description of each.

    They are the fields of classes named ``Thresholds``.
    """
    for path in sources("lidarops/retrieve"):
        for node in nodes(path):
            if isinstance(node, ast.ClassDef) and node.name == "Thresholds":
                for entry, following in zip(node.body, [*node.body[1:], ast.Pass()], strict=True):
                    if isinstance(entry, ast.AnnAssign):
                        words = ast.unparse(following) if isinstance(following, ast.Expr) else ""
                        yield path, ast.unparse(entry.target), words


def copied_thresholds() -> list[str]:
    """Return the constants of modules that only copy a threshold."""
    return [
        f"{path.relative_to(ROOT)}: {line}"
        for path in sources()
        for line in text(path).splitlines()
        if re.match(r"[A-Z_]+(: Final(\[\w+\])?)? = THRESHOLDS\.\w+$", line)
    ]


def longest_parameters() -> tuple[int, str]:
    """Return the largest number of parameters of a function that is no command, and its place."""
    return max(
        (len(node.args.args) + len(node.args.kwonlyargs) + len(node.args.posonlyargs), place)
        for place, node in functions()
    )


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield the functions of the library and their places, but for commands.

    The parameters of commands, of typer and of Prefect, are the options of the user.
    """
    for path in sources():
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef) and not _is_command(node, path):
                yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", node


def _is_command(node: ast.FunctionDef, path: Path) -> bool:
    """Return whether typer or Prefect calls a function, by its decorators or the source."""
    names = {ast.unparse(one).partition("(")[0] for one in node.decorator_list}
    decorated = any(name.rpartition(".")[2] in {"command", "callback", "flow"} for name in names)
    return decorated or f"typer.run({node.name})" in text(path)


def packages() -> dict[str, int]:
    """Return the lines of each package at the root, and of each part of `retrieve`."""
    count: dict[str, int] = defaultdict(int)
    for path in sources("lidarops"):
        parts = path.relative_to(ROOT / "lidarops").parts[:-1]
        depth = 2 if parts[:1] == ("retrieve",) else 1
        count["/".join(parts[:depth])] += text(path).count("\n")
    return dict(count)


def figures() -> dict[str, int]:
    """Return all figures by name."""
    numbers = list(tuning_numbers())
    classes = dataclasses()
    return {
        "lines": lines(),
        "lines of code alone": code_lines(),
        "modules": len(sources()),
        "dataclasses": len(classes),
        "lines of dataclasses": sum((c.end_lineno or 0) - c.lineno + 1 for c in classes),
        "tuning numbers": len(numbers),
        "tuning numbers that are assumed": sum("assumed" in words for _, _, words in numbers),
        "copied thresholds": len(copied_thresholds()),
        "most parameters": longest_parameters()[0],
        "lines of the largest package": max(packages().values()),
    }


def main() -> None:
    """Print the figures."""
    for name, number in figures().items():
        sys.stdout.write(f"{number:8d}  {name}\n")


if __name__ == "__main__":
    main()

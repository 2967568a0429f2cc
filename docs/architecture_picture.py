"""Draw the packages of lidarops and their imports: ``python docs/architecture_picture.py``.

The picture is drawn from the import statements of the sources, in the layers of the contract in
``pyproject.toml``. A test redraws it and compares, so it cannot go out of date.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from functools import cache
from html import escape
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
PICTURE: Final = Path(__file__).with_name("architecture.svg")

PURPOSES: Final = {
    "flows": "Prefect flows: schedules",
    "cli": "command line",
    "run": "stale products, runs, clusters",
    "site": "pages to browse an archive",
    "aggregate": "many products as one",
    "reports": "page and record of a run",
    "figures": "data reduction and drawing",
    "products": "one folder for each kind",
    "scene": "one scene: plan, signals, products",
    "netcdf": "variables, build, write, read",
    "catalog": "granules and ledger",
    "simulate": "atmosphere to raw files",
    "campaign": "the campaign file, validated",
    "retrieve": "numerics: arrays in, arrays out",
    "raw": "raw formats, xarray engine",
    "system": "stores and processes",
    "vocabulary": "errors, flags, settings, kinds",
}
"""Package -> what it is for, in the words of the picture."""
VOCABULARY: Final = {"errors", "flags", "constants", "units", "settings", "kinds", "records"}

WIDTH: Final = 1180
ROW: Final = 92
BOX: Final = (240, 52)
MARGIN: Final = 20
LANE: Final = 10
"""Distance of two lines that pass a row side by side."""


@cache
def imports() -> dict[str, set[str]]:
    """Return, for each package at the root, the packages whose modules it imports."""
    graph: dict[str, set[str]] = {}
    for root in ("lidarops", "flows"):
        for source in sorted((ROOT / root).rglob("*.py")):
            importer = _package(source.relative_to(ROOT).with_suffix("").parts)
            if importer:
                imported = {_package(name.split(".")) for name in _imported(source)}
                graph.setdefault(importer, set()).update(imported - {importer, ""})
    return graph


def _imported(source: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def _package(parts: tuple[str, ...] | list[str]) -> str:
    """Return the package at the root that a module belongs to; empty for none of ours."""
    if parts[0] == "flows":
        return "flows"
    if parts[0] != "lidarops" or len(parts) == 1:
        return ""
    name = "vocabulary" if parts[1] in VOCABULARY else parts[1]
    return name if name in PURPOSES else ""


def levels() -> list[list[str]]:
    """Return the layers of the import contract, highest first, with the vocabulary as one."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract = settings["tool"]["importlinter"]["contracts"][0]
    rows = [[name.strip() for name in layer.split("|")] for layer in contract["layers"]]
    kept = [[name for name in row if name in PURPOSES] for row in rows]
    kept.insert(1, ["flows"])
    return [row for row in kept if row] + [["vocabulary"]]


def draw() -> str:
    """Return the picture as SVG: one row a layer, an arrow from each package to what it imports."""
    rows, graph = levels(), imports()
    centres = {
        name: (WIDTH * (column + 0.5) / len(row), MARGIN + BOX[1] / 2 + ROW * level)
        for level, row in enumerate(rows)
        for column, name in enumerate(row)
    }
    height = 2 * MARGIN + BOX[1] + ROW * (len(rows) - 1)
    lines = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}"'
            f' width="{WIDTH}" height="{height}" font-family="sans-serif">'
        ),
        "<title>Packages of lidarops: each imports only packages below it</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
    ]
    lanes: set[tuple[int, int]] = set()
    level = {name: number for number, row in enumerate(rows) for name in row}
    for name in sorted(graph):
        for other in sorted(_direct(name, graph)):
            between = range(level[name] + 1, level[other])
            lines.append(_line(centres, name, other, [rows[number] for number in between], lanes))
    lines += [_box(name, *centres[name]) for row in rows for name in row]
    return "\n".join([*lines, "</svg>"]) + "\n"


def _direct(name: str, graph: dict[str, set[str]]) -> set[str]:
    """Return the imports of a package that no other of its imports reaches."""
    return {
        other
        for other in graph[name]
        if not any(other in _reachable(via, graph) for via in graph[name] - {other})
    }


def _reachable(name: str, graph: dict[str, set[str]]) -> set[str]:
    reached: set[str] = set()
    waiting = set(graph.get(name, ()))
    while waiting:
        package = waiting.pop()
        reached.add(package)
        waiting |= graph.get(package, set()) - reached
    return reached


def _line(
    centres: dict[str, tuple[float, float]],
    name: str,
    other: str,
    rows: list[list[str]],
    lanes: set[tuple[int, int]],
) -> str:
    """Return a line from one box down to another, through the gaps of the rows between them."""
    (x, y), (end, below) = centres[name], centres[other]
    path = [f"M{x:.0f} {y + BOX[1] / 2:.0f}"]
    at = (x, y + BOX[1] / 2)
    for row in rows:
        middle = centres[row[0]][1]
        straight = x + (end - x) * (middle - y) / (below - y)
        gap = _gap(straight, [centres[box][0] for box in row], round(middle), lanes)
        path += [_bend(at, (gap, middle - BOX[1] / 2)), f"V{middle + BOX[1] / 2:.0f}"]
        at = (gap, middle + BOX[1] / 2)
    path.append(_bend(at, (end, below - BOX[1] / 2)))
    return (
        f'<path d="{" ".join(path)}" fill="none" stroke="#8a97a6" stroke-width="1.4"/>'
        f'<circle cx="{end:.0f}" cy="{below - BOX[1] / 2:.0f}" r="3" fill="#8a97a6"/>'
    )


def _bend(start: tuple[float, float], stop: tuple[float, float]) -> str:
    middle = (start[1] + stop[1]) / 2
    return f"C{start[0]:.0f} {middle:.0f} {stop[0]:.0f} {middle:.0f} {stop[0]:.0f} {stop[1]:.0f}"


def _gap(target: float, boxes: list[float], row: int, lanes: set[tuple[int, int]]) -> float:
    """Return the free place nearest to a place in a row of boxes, and keep it."""
    places = [
        place
        for place in range(MARGIN, WIDTH - MARGIN, LANE)
        if all(abs(place - box) > BOX[0] / 2 + LANE for box in boxes) and (row, place) not in lanes
    ]
    place = min(places, key=lambda place: abs(place - target))
    lanes.add((row, place))
    return float(place)


def _box(name: str, x: float, y: float) -> str:
    width, height = BOX
    return (
        f'<rect x="{x - width / 2:.0f}" y="{y - height / 2:.0f}" width="{width}"'
        f' height="{height}" rx="6" fill="#eef3f8" stroke="#33475b"/>'
        f'<text x="{x:.0f}" y="{y - 4:.0f}" text-anchor="middle" font-size="16"'
        f' font-weight="bold" fill="#1c2a38">{escape(name)}/</text>'
        f'<text x="{x:.0f}" y="{y + 15:.0f}" text-anchor="middle" font-size="12"'
        f' fill="#33475b">{escape(PURPOSES[name])}</text>'
    ).replace("vocabulary/", "vocabulary")


def main() -> None:
    """Write ``docs/architecture.svg``."""
    PICTURE.write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()

"""The pages on the papers name functions and tests that exist, and every paper is cited."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from support.cases import each

from lidarops import constants
from lidarops.netcdf.variables import layout_of
from lidarops.retrieve.network.geometry import network_of_lines

PAGES = {
    "background": "bobrovsky2024",
    "least_squares": "potapova2021",
    "multiangle": "gobrusenko1989",
    "forward_model": "vasylkivskyi2009",
    "multiposition": "drabenko2021",
}
"""Page of docs/papers -> key of catalogs/references.bib."""


def _page(repository: Path, name: str) -> str:
    return (repository / "docs" / "papers" / f"{name}.md").read_text(encoding="utf-8")


def _resolved(dotted: str) -> object:
    """Return a module or what it holds."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


def _words_of(package: str, repository: Path) -> set[str]:
    """Return the names of modules, functions, classes and arguments of a package, and its texts."""
    words: set[str] = set()
    for path in (repository / package.replace(".", "/")).rglob("*.py"):
        words |= {path.stem, path.parent.name}
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                words.add(node.name)
            elif isinstance(node, ast.arg):
                words.add(node.arg)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                words.add(node.value)
    return words


@each("name", PAGES)
def test_a_page_names_functions_and_tests_that_exist(name: str, repository: Path) -> None:
    text = _page(repository, name)
    prefix = re.search(
        r"^Names begin with `([\w.]+)\.`, tests with `([\w/]+)/`\.$", text, re.MULTILINE
    )
    assert prefix
    functions = re.findall(r"`((?:\w+\.)+\w+)`", text)
    assert len(functions) > 1
    for dotted in functions:
        assert _resolved(f"{prefix[1]}.{dotted}") is not None
    tests = set(re.findall(r"`([\w/]+\.py)::(test_\w+)`", text))
    assert len(tests) > 5
    for file, test in tests:
        assert f"\ndef {test}(" in (repository / prefix[2] / file).read_text("utf-8"), (file, test)
    assert not re.search(r"`test_\w+`", text)
    # Arguments, methods, and functions of a module that the same row names.
    table = text.partition("## Where each formula is")[2].partition("\n## ")[0]
    cells = [line.split(" | ")[2] for line in table.splitlines() if line.count(" | ") == 3]
    assert len(cells) > 5
    words = {word for cell in cells for word in re.findall(r'[`"](\w+)(?=[`="])', cell)}
    assert words - {"auto"} <= _words_of(prefix[1], repository)


def _variables() -> dict[str, Any]:
    """Return what the lines of code of the pages take: one homogeneous path, scan and network."""
    rng = np.random.default_rng(1)
    distance = np.arange(1500.0, 7500.0, 30.0)
    power = 10.0 + 100.0 * (1500.0 / distance) ** 2 + rng.normal(size=(2, distance.size))
    angle = np.radians([120.0, 60.0, 90.0])
    network = network_of_lines(
        [[300.0, 0, 0], [-500.0, 0, 0], [0, 0, 0]],
        np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1),
        tolerance=1e-3,
    )
    zenith_angle = np.linspace(0.0, 60.0, 5)
    altitude = np.arange(100.0, 900.0, 100.0)
    path = 1.0 / np.cos(np.radians(zenith_angle))
    signal = np.exp(-2e-3 * path[np.newaxis, :, np.newaxis] * altitude)
    return {
        "range": distance, "power": power, "variance": 1.0, "network": network,
        "r": distance, "sigma": np.full(distance.size, 1e-4), "k": 1.0,
        "beta": np.full(distance.size, 1e-5), "signal": signal, "zenith_angle": zenith_angle,
        "altitude": altitude,
    }  # fmt: skip


@each("name", PAGES)
def test_the_lines_of_code_of_a_page_run(name: str, repository: Path) -> None:
    names = _variables()
    if name == "multiposition":
        near = np.arange(100.0, 2000.0, 5.0)
        names |= {"range": near, "power": np.tile(np.exp(-4e-3 * near) / near**2, (3, 1))}
        names |= {"variance": (1e-6 * names["power"]) ** 2}
    if name == "multiangle":
        names["variance"] = (1e-3 * names["signal"]) ** 2
    blocks = re.findall(r"```python\n(.*?)```", _page(repository, name), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(block, names)


def test_the_readme_leads_to_the_page_of_every_paper(repository: Path) -> None:
    readme = (repository / "README.md").read_text(encoding="utf-8")
    index = _page(repository, "index")
    for name in PAGES:
        assert f"(docs/papers/{name}.md)" in readme
        assert f"({name}.md)" in index
    for author in ("Bobrovsky", "Potapova", "Gobrusenko", "Ivanenko", "Drabenko", "Vasylkivskyi"):
        assert author in readme


def test_every_paper_is_in_the_sources_and_the_citation(repository: Path) -> None:
    entries = (repository / "catalogs" / "references.bib").read_text(encoding="utf-8")
    citation = yaml.safe_load((repository / "CITATION.cff").read_text(encoding="utf-8"))
    titles = {re.sub(r"\s+", " ", reference["title"]) for reference in citation["references"]}
    for name, key in PAGES.items():
        assert f"`{key}`" in _page(repository, name)
        title = re.search(rf"{{{key},.*?title\s*=\s*{{(.*?)}},\n", entries, re.DOTALL)
        assert title
        assert re.sub(r"\s+", " ", title[1]) in titles


def _cited_keys(repository: Path) -> Iterator[str]:
    for folder in ("lidarops", "docs"):
        for path in (repository / folder).rglob("*.[pm][yd]"):
            if "_build" not in path.parts:
                yield from re.findall(r"`([a-z]+\d{4})`", path.read_text(encoding="utf-8"))


def test_every_cited_key_is_an_entry_of_the_sources(repository: Path) -> None:
    entries = (repository / "catalogs" / "references.bib").read_text(encoding="utf-8")
    keys = set(re.findall(r"^@\w+{(\w+),", entries, re.MULTILINE))
    cited = set(_cited_keys(repository))
    assert set(PAGES.values()) <= cited
    assert cited <= keys


def test_products_of_networks_cite_the_paper_that_they_use() -> None:
    """Those of homogeneous paths, the known shape and scans of `mld` are cited where they run."""
    assert constants.MULTIPOSITION_PAPER in layout_of("visibility").references

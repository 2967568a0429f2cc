"""The generated parts of the reference are complete."""

from __future__ import annotations

import inspect
import pkgutil
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import campaign_keys
import command_line
import product_variables
import pytest
import python_api
import stiff_cases
import yaml
from support.pages import blocks, name_of, pages

import flows
import lidarops
from lidarops.campaign.model import load_campaign
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds

# Made of the settings of all kinds of product, and listed among the keys of a campaign file.
ASSEMBLED = {"Products", "Network"}
# Mappings whose keys are no keys of the schema.
NAMES = {"stations", "instruments", "networks", "channels", "nitrogen", "water_vapour", "exponents"}
OWN_KINDS = ("elastic", "homogeneous", "multiangle", "raman", "signal", "visibility")


def _first_cells(page: str) -> set[str]:
    return set(re.findall(r"^\| `([^`]+)`", page, re.MULTILINE))


def _modules(package: ModuleType) -> Iterator[ModuleType]:
    yield package
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.name.rpartition(".")[2].startswith("_"):
            yield import_module(found.name)


@pytest.mark.parametrize("package", [lidarops, flows], ids=lambda package: package.__name__)
def test_every_public_function_and_class_is_listed_under_its_module(package: ModuleType) -> None:
    sections = python_api.every_function().split("\n### ")
    listed = {text.partition("`\n")[0].strip("`"): _first_cells(text) for text in sections}
    for module in _modules(package):
        own = {
            name
            for name, value in vars(module).items()
            if (inspect.isfunction(value) or inspect.isclass(value))
            and value.__module__ == module.__name__
            and value.__name__ == name
            and not name.startswith("_")
        }
        assert own - ASSEMBLED <= listed.get(module.__name__, set()), module.__name__


def test_modules_for_users_have_a_page_with_all_their_public_names(tmp_path) -> None:
    (tmp_path / "made").mkdir()
    (tmp_path / "made/old.md").touch()
    python_api.write_pages(tmp_path / "made")
    pages = {path.stem: path.read_text() for path in (tmp_path / "made").iterdir()}
    assert pages.keys() == set(python_api.MODULES)
    assert ".. autofunction:: lidarops.open_archive" in pages["lidarops"]
    assert ".. autoclass:: lidarops.raw.licel.Header\n   :members:" in pages["lidarops.raw.licel"]
    offered = python_api.offered()
    for name in python_api.MODULES:
        assert f"[{name}](made/{name}.md)" in offered


def test_every_command_is_listed_with_its_options() -> None:
    page = command_line.page()
    for name, command in command_line.commands().items():
        section = page.partition(f"## `{name}`\n")[2].partition("\n## ")[0]
        assert f"lidarops {name} " in section
        for parameter in command.params:
            for option in parameter.opts if parameter.param_type_name == "option" else ():
                assert f"`{option}`" in section, (name, option)


def _written(value: Any) -> Iterator[str]:
    """Give the keys of a campaign file."""
    for key, inner in value.items() if isinstance(value, dict) else ():
        yield key
        # Of these, the writer chooses the keys, or they are channels.
        named = key in NAMES and isinstance(inner, dict)
        for item in inner.values() if named else (inner,):
            yield from _written(item)
    for item in value if isinstance(value, list) else ():
        yield from _written(item)


def test_every_key_has_a_meaning() -> None:
    """The description of its field, or that of the one section that it leads to."""
    rows = re.findall(r"^\| `(\w+)` \|.*\|([^|]*)\|$", campaign_keys.page(), re.MULTILINE)
    assert len(rows) > 250
    assert [key for key, meaning in rows if not re.search("[a-z]{2}", meaning)] == []


def test_every_key_is_listed_with_unit_bounds_and_default(repository) -> None:
    page = campaign_keys.page()
    (dead_time,) = re.findall(r"^\| `dead_time` \|.*\|$", page, re.MULTILINE)
    assert "number in s, ≥ 1e-10, ≤ 2e-07" in dead_time
    assert "| `latitude` | number in degree, ≥ -90, ≤ 90 | required |" in page
    assert "or number in s or `keep`, `remove` | `30d` | how long products" in page
    # Units once, and intervals as campaign files write them.
    assert "range of every bin |" in page
    assert "| `lidar_ratio` | number in sr, ≥ 5, ≤ 150 | `50.0` | extinction over" in page
    assert "[DiurnalCourse](#diurnalcourse) in m-1 | required | at 532 nm |" in page
    assert not re.search(r"\[[a-zA-Z0-9 -]+\] \|$", page, re.MULTILINE)
    intervals = set(re.findall(r"or number in s \| `(\S+)` \|", page))
    assert intervals == {"10min", "30min", "6h", "12h", "day"}
    keys = _first_cells(page)
    for path in sorted((repository / "catalogs").glob("*.yaml")):
        load_campaign(path)
        written = set(_written(yaml.safe_load(path.read_text())))
        assert written <= keys
        assert len(written) > 30
    sections = set(re.findall(r"^## (\w+)$", page, re.MULTILINE))
    links = set(re.findall(r"\]\(#(\w+)\)", page))
    assert links <= {section.lower() for section in sections}
    # A kind of another package has its own documentation.
    assert "integrated" not in keys


def test_variables_and_flags_of_the_golden_products_are_listed(repository) -> None:
    page = product_variables.page()
    bits = page.partition("## Bits of")[2]
    files = sorted((repository / "tests/golden").glob("*.cdl"))
    assert {path.stem.partition("_")[0] for path in files} == set(OWN_KINDS)
    for path in files:
        text = path.read_text(encoding="utf-8")
        section = page.partition(f"## Variables of `{path.stem.partition('_')[0]}`")[2]
        described = set(re.findall(r"^    (\w+):long_name", text, re.MULTILINE))
        assert len(described) > 10
        # These three describe the file, and are the same in all kinds.
        described -= {"station", "provenance", "quantization_info"}
        assert described <= _first_cells(section.partition("\n## ")[0]), path.name
        masks = re.findall(r"quality_flag:flag_masks = (.*) ;", text)
        words = re.findall(r'quality_flag:flag_meanings = "(.*)" ;', text)
        assert masks
        for some, names in zip(masks, words, strict=True):
            for mask, word in zip(some.split(", "), names.split(), strict=True):
                assert f"| `{word}` | {mask} |" in bits, path.name


def test_every_flag_that_rejects_values_points_to_facts_or_to_nothing_to_set(repository) -> None:
    page = (repository / "docs/howto/campaign.md").read_text(encoding="utf-8")
    section = page.partition("## Most values are rejected")[2]
    (of_none,) = re.findall(r"^Nothing to set: (.*)$", section, re.MULTILINE)
    cells = [*re.findall(r"^\| (`.*?) \|", section, re.MULTILINE), of_none]
    named = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    bits = [bit for kind in OWN_KINDS for bit in flags_of(kind)]
    rejecting = {bit.word for bit in bits if bit.severity is Severity.REJECT}
    assert rejecting <= set(named)
    assert set(named) <= {bit.word for bit in bits}
    assert len(named) == len(set(named))


def test_the_table_of_backgrounds_names_the_products_that_take_each(repository) -> None:
    page = (repository / "docs/algorithms/background.md").read_text(encoding="utf-8")
    table = page.partition("## Model")[2].partition("\n## ")[0]
    cells = re.findall(r"^\| (.*`.*) \| .* \| .* \| (.*) \|$", table, re.MULTILINE)
    rows = [[re.findall(r"`(\w+)`", cell) for cell in row] for row in cells]
    named = {(method, kind) for methods, kinds in rows for method in methods for kind in kinds}
    taken = {
        (method, kind)
        for kind in OWN_KINDS
        if (field := kinds()[kind].settings.model_fields.get("background"))
        for method in get_args(field.annotation)
        if isinstance(method, str)
    }
    assert len(taken) > 6
    assert taken <= named


def test_stiff_cases_of_every_retrieval_are_listed_with_what_they_expect() -> None:
    sections = stiff_cases.page().split("## ")[1:]
    titles = [section.partition("\n")[0] for section in sections]
    assert titles == [
        "Homogeneous", "Signal chain", "Elastic", "Multi-angle", "Network", "Forward model",
    ]  # fmt: skip
    rows = [
        re.findall(r"^\| (?!case |---)(.+) \| (.+) \|$", text, re.MULTILINE) for text in sections
    ]
    assert all(len(cases) >= 5 for cases in rows)
    # A case without expectation cannot fail.
    assert all(expected.strip() for cases in rows for _, expected in cases)


def test_the_exit_codes_name_the_kinds_that_may_be_without_usable_values(repository: Path) -> None:
    page = (repository / "docs/reference/command_line.md").read_text()
    named = re.search(r"has no usable value \(of other products than (.+?)\)", page)
    assert named
    free = {name for name in OWN_KINDS if not kinds()[name].expects_usable}
    assert set(re.findall(r"`(\w+)`", named[1])) == free


def test_commands_are_apart() -> None:
    """A heading of Markdown needs an empty line before it."""
    assert not re.search(r"[^\n]\n## ", command_line.page())


def test_scripts_and_pages_import_what_users_may_call(repository) -> None:
    texts = {path.name: path.read_text() for path in (repository / "examples").glob("*.py")}
    for page in pages():
        code = [
            block.text for block in blocks(page) if re.search(r"python|code-cell", block.language)
        ]
        texts[name_of(page)] = "\n".join(code)
    imported = {
        (name, module)
        for name, text in texts.items()
        for module in re.findall(r"^(?:from|import) (lidarops[\w.]*)", text, re.MULTILINE)
    }
    assert len(imported) > 20
    assert {
        (name, module) for name, module in imported if module not in python_api.MODULES
    } == set()

"""Make the same archives with two states of the code, and compare every value of the products.

For changes that must not change a value, such as moved modules. In the root of each checkout::

    python tests/end_to_end/same_products.py make OUT [--only NAME ...]
    python tests/end_to_end/same_products.py compare BEFORE AFTER [--only NAME ...]

Values of flags are compared by the ``flag_meanings`` of each file, since their places may move.

``make`` uses the command line of that checkout only. ``compare`` exits with 1 where a value, a
flag, a type, a variable, a raw file or an exit code differs. Reworded texts are listed, each once.
``--renamed OLD=NEW ...`` gives words of variable names that were renamed on purpose.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

DATA = Path(os.environ.get("LIDAROPS_TEST_DATA", Path.cwd().parent / "shared" / "data"))
"""Real raw files; archives that need them are left out where there are none."""
CAMPAIGNS = Path(__file__).resolve().parent / "campaigns"

DERIVED = {
    "id": "UUID of inputs, plan, settings and code",
    "product_version": "number of the version of the content",
    "lidarops_code_version": "digest of the sources",
    "lidarops_plan_sha256": "digest of the plan, whose reasons are texts",
    "date_created": "when the product was written",
    "date_modified": "as date_created",
    "date_issued": "as date_created",
    "date_metadata_modified": "as date_created",
}
"""Global attributes derived from the code, not from the data -> how."""

DERIVED_PROVENANCE = re.compile(
    r"agent/lidarops:software/lidarops:code_version"
    r"|entity/lidarops:(product|means)/lidarops:id"
    r"|entity/lidarops:plan/lidarops:sha256"
)
"""Places in the provenance of the same digests and identifiers."""

MEANING = {"units", "calendar", "_Encoding"}
"""Texts that give the meaning of the stored numbers: they must be the same."""

RENAMED: dict[str, str] = {}
"""Words of names in the older products -> words in the newer ones."""

WRITE_MIXED = (
    "import sys, yaml; from support.archives import mixed_campaign;"
    "yaml.safe_dump(mixed_campaign.tree(profiles=40), open(sys.argv[1], 'w'))"
)


@dataclass(frozen=True)
class Recipe:
    """Campaign, raw files and runs of one archive."""

    campaign: str
    """Path of a campaign file; ``written:NAME`` is written by this script."""
    raw: Path | None = None
    """Folder of real raw files; None where they are simulated."""
    runs: tuple[tuple[str, ...], ...] = ((),)
    """Options of each run of ``reprocess``."""
    means: bool = False


ALL = (("--all-steps",),)
RECIPES = {
    "demo": Recipe("catalogs/demo.yaml", means=True),
    "scan": Recipe("catalogs/scan.yaml", means=True),
    "network": Recipe("catalogs/network.yaml", means=True),
    "network_six_beams": Recipe("catalogs/network_six_beams.yaml"),
    # The second run plans with what the first one knows.
    "mixed": Recipe("written:mixed", runs=((), ("--force",))),
    "mixed_all_steps": Recipe("written:mixed", runs=ALL),
    "dialects": Recipe("written:dialects"),
    "pilar": Recipe(str(CAMPAIGNS / "pilar.yaml"), DATA / "pilar", ALL),
    "pilar_planned": Recipe(str(CAMPAIGNS / "pilar.yaml"), DATA / "pilar"),
    "saopaulo": Recipe(str(CAMPAIGNS / "saopaulo.yaml"), DATA / "saopaulo", ALL),
    "saopaulo_planned": Recipe(str(CAMPAIGNS / "saopaulo.yaml"), DATA / "saopaulo"),
    "manaus": Recipe(str(CAMPAIGNS / "manaus.yaml"), DATA, ALL),
    "savant": Recipe(str(CAMPAIGNS / "savant.yaml"), DATA / "savant"),
}


# Archives -------------------------------------------------------------------------------------


def make(out: Path, names: list[str]) -> int:
    """Make archives with the code of the working directory.

    Raw files go to ``OUT/raw/NAME``, products to ``OUT/made/NAME``. An archive that exists is an
    error: a second run would have nothing to do.
    """
    root = Path.cwd()
    environment = _environment(root, out)
    where = "import lidarops; print(lidarops.__file__)"
    imported = subprocess.run(
        [sys.executable, "-c", where], env=environment, check=True, capture_output=True, text=True
    ).stdout.strip()
    print(f"lidarops: {imported}")
    if Path(imported).parent != root / "lidarops":
        raise SystemExit(f"this is not the code of {root}")
    for name in names:
        if (out / "raw" / name).exists() or (out / "made" / name).exists():
            raise SystemExit(f"{out} holds {name} already")
    for name in names:
        started = time.monotonic()
        codes = _make_one(name, out, environment)
        count = sum(1 for _ in (out / "made" / name).rglob("*.nc"))
        seconds = time.monotonic() - started
        print(f"{name}: {count} products, {seconds:.0f} s, exit codes {codes}", flush=True)
    return 0


def _environment(root: Path, out: Path) -> dict[str, str]:
    """Return an environment in which the checkout alone decides on the products."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("LIDAROPS_")}
    folders = (root, root / "tests", root / "tests" / "plugin")
    return kept | {
        "SOURCE_DATE_EPOCH": "1700000000",
        "PYTHONPATH": os.pathsep.join(map(str, folders)),
        "NUMBA_CACHE_DIR": str(out / "cache" / "numba"),
        "XDG_CACHE_HOME": str(out / "cache"),
    }


def _make_one(name: str, out: Path, environment: Mapping[str, str]) -> str:
    """Make one archive; return the exit codes of its commands."""
    recipe = RECIPES[name]
    made = out / "made" / name
    made.mkdir(parents=True)
    campaign = str(_campaign(recipe, made / "campaign.yaml", environment))
    raw = recipe.raw or out / "raw" / name
    folders = ("--archive", str(raw), "--out", str(made))
    commands = [("reprocess", campaign, *folders, *options) for options in recipe.runs]
    if recipe.raw is None:
        commands.insert(0, ("simulate", campaign, *folders))
    if recipe.means:
        commands.append(("aggregate", str(made), "--means", "day"))
    codes = []
    with (made / "output.log").open("w") as log:
        for command in commands:
            call = [sys.executable, "-m", "lidarops", *command]
            done = subprocess.run(call, env=environment, stdout=log, stderr=log, check=False)
            codes.append(f"{command[0]} {done.returncode}")
    exit_codes = ", ".join(codes)
    (made / "exit_codes.txt").write_text(f"{exit_codes}\n")
    return exit_codes


def _campaign(recipe: Recipe, path: Path, environment: Mapping[str, str]) -> Path:
    """Return the path of the campaign file, written first if the recipe says so."""
    if recipe.campaign == "written:mixed":
        call = [sys.executable, "-c", WRITE_MIXED, str(path)]
        subprocess.run(call, env=environment, check=True)
        return path
    if recipe.campaign == "written:dialects":
        # Two hours of the example of a month, with more damaged files.
        text = Path("catalogs/archive.yaml").read_text()
        for old, new in (("duration: 2.592e+6", "duration: 7200"), ("0.002", "0.05")):
            if old not in text:
                raise SystemExit(f"catalogs/archive.yaml does not hold {old!r}")
            text = text.replace(old, new)
        path.write_text(text)
        return path
    if Path(recipe.campaign).is_absolute():
        return Path(recipe.campaign)
    return Path.cwd() / recipe.campaign


# Comparison -----------------------------------------------------------------------------------


@dataclass
class Comparison:
    """Counts, failures and changed texts of a comparison."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    texts: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    """(variable and attribute, before, after) -> number of files."""


def compare(before: Path, after: Path, names: list[str]) -> int:
    """Compare two folders that ``make`` has filled; return the exit code."""
    comparison = Comparison()
    for name in names:
        failures = len(comparison.failures)
        old, new = _files(before, name), _files(after, name)
        if not any(path.startswith("made/") and path.endswith(".nc") for path in old):
            comparison.failures.append(f"{name}: no products in {before}")
        comparison.counts["archives"] += 1
        for path in sorted({*old, *new}):
            if path not in old or path not in new:
                comparison.failures.append(f"{path}: {'is new' if path in new else 'is missing'}")
            elif path.endswith(".nc"):
                _compare_netcdf(path, old[path], new[path], comparison)
            else:
                comparison.counts["other files"] += 1
                if _digest(old[path]) != _digest(new[path]):
                    comparison.failures.append(f"{path}: has other bytes")
        print(f"{name}: {len(comparison.failures) - failures} failures", flush=True)
    _print(comparison)
    return 1 if comparison.failures else 0


def _files(root: Path, name: str) -> dict[str, Path]:
    """Return raw files, exit codes and all NetCDF files of an archive, by their relative path."""
    raw = [path for path in (root / "raw" / name).rglob("*") if path.is_file()]
    made = root / "made" / name
    paths = [*raw, *made.rglob("*.nc"), *made.glob("exit_codes.txt")]
    # Names of means hold a digest of names and meanings of variables.
    return {
        re.sub(r"[-_][0-9a-f]{8,}(?=[-_./])", "", path.relative_to(root).as_posix()): path
        for path in paths
    }


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _compare_netcdf(path: str, before: Path, after: Path, comparison: Comparison) -> None:
    """Compare two NetCDF files: structure, attributes, values."""
    comparison.counts["NetCDF files"] += 1
    with netCDF4.Dataset(before) as old, netCDF4.Dataset(after) as new:
        old.set_auto_maskandscale(False)
        new.set_auto_maskandscale(False)
        _compare_groups(path, old, new, comparison)


def _compare_groups(
    path: str, old: netCDF4.Dataset, new: netCDF4.Dataset, comparison: Comparison
) -> None:
    """Compare dimensions, attributes and variables of a group, and its groups."""
    renamed = {_renamed(name): variable for name, variable in old.variables.items()}
    if {_renamed(name): size for name, size in _sizes(old).items()} != _sizes(new):
        comparison.failures.append(f"{path}: dimensions {_sizes(new)}, were {_sizes(old)}")
    if old.data_model != new.data_model:
        comparison.failures.append(f"{path}: format {new.data_model}, was {old.data_model}")
    _compare_attributes(path, "", _global_attributes(old), _global_attributes(new), comparison)
    for name in sorted({*renamed, *new.variables}):
        if name not in renamed or name not in new.variables:
            state = "is new" if name in new.variables else "is missing"
            comparison.failures.append(f"{path}: variable {name} {state}")
        else:
            _compare_variables(path, renamed[name], new.variables[name], comparison)
    for name in sorted({*old.groups, *new.groups}):
        if name not in old.groups or name not in new.groups:
            state = "is new" if name in new.groups else "is missing"
            comparison.failures.append(f"{path}: group {name} {state}")
        else:
            _compare_groups(f"{path}/{name}", old.groups[name], new.groups[name], comparison)


def _renamed(text: str) -> str:
    """Return a name of the older products with the words of the newer."""
    return re.sub(r"[a-z]+", lambda word: RENAMED.get(word[0], word[0]), text)


def _sizes(group: netCDF4.Dataset) -> dict[str, tuple[int, bool]]:
    """Return size and kind of each dimension; lengths of texts may differ."""
    return {
        name: (-1 if name.endswith("_strlen") else len(dimension), dimension.isunlimited())
        for name, dimension in group.dimensions.items()
    }


def _attributes(item: Any) -> dict[str, Any]:
    return {name: item.getncattr(name) for name in item.ncattrs()}


def _global_attributes(group: netCDF4.Dataset) -> dict[str, Any]:
    """Return global attributes without those derived from the code, also within the history."""
    attributes = _attributes(group)
    kept = {name: value for name, value in attributes.items() if name not in DERIVED}
    if "history" in kept:
        for name in ("lidarops_code_version", "date_created"):
            if name in attributes:
                kept["history"] = kept["history"].replace(attributes[name], name.upper())
    return kept


def _compare_attributes(
    path: str, owner: str, old: Mapping[str, Any], new: Mapping[str, Any], comparison: Comparison
) -> None:
    """List texts that differ; other differences, and attributes of one file only, are failures."""
    for name in sorted({*old, *new}):
        before, after = old.get(name), new.get(name)
        if _equal(before, after):
            continue
        if _is_text(before) and _is_text(after) and name not in MEANING:
            _list_text(f"{owner}:{name}", before, after, comparison)
        else:
            change = f"is {_short(after)}, was {_short(before)}"
            comparison.failures.append(f"{path}: attribute {owner}:{name} {change}")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) or (
        isinstance(value, list) and all(isinstance(item, str) for item in value)
    )


def _equal(before: Any, after: Any) -> bool:
    """Tell whether two attributes are the same, bit by bit."""
    if before is None or after is None or _is_text(before) or _is_text(after):
        return type(before) is type(after) and before == after
    old, new = np.asarray(before), np.asarray(after)
    same = old.dtype == new.dtype and old.shape == new.shape
    return same and old.tobytes() == new.tobytes()


def _compare_variables(
    path: str, old: netCDF4.Variable, new: netCDF4.Variable, comparison: Comparison
) -> None:
    """Compare type, shape, storage, attributes and values of two variables."""
    name = old.name
    comparison.counts["variables"] += 1
    stated = [_attributes(variable) for variable in (old, new)]
    by_meaning = all("flag_masks" in attributes for attributes in stated)
    if by_meaning:
        _compare_meanings(path, name, *stated, comparison)
    _compare_attributes(path, name, *map(_placeless, stated), comparison)
    text = old.dtype in (str, np.dtype("S1")) and new.dtype in (str, np.dtype("S1"))
    forms = [_form(variable, text=text) for variable in (old, new)]
    if forms[0] != forms[1]:
        comparison.failures.append(f"{path}: {name} is {forms[1]}, was {forms[0]}")
        if not text and (old.dtype != new.dtype or old.shape != new.shape):
            return
    if text:
        comparison.counts["texts"] += 1
        before, after = _text(old), _text(new)
        if name == "provenance":
            _compare_provenance(path, before, after, comparison)
        elif before != after:
            comparison.failures.append(f"{path}: {name} is {_short(after)}, was {_short(before)}")
        return
    before, after = np.asarray(old[...]), np.asarray(new[...])
    if by_meaning:
        before, after = map(_by_meaning, (before, after), stated)
    comparison.counts["values"] += before.size
    count, most = _differing(before, after)
    comparison.counts["values differing"] += count
    if count:
        by = f"by {most:.3g} at most" if most else "in NaN or signs of zero"
        comparison.failures.append(f"{path}: {name}: {count} of {before.size} values differ, {by}")


def _placeless(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a variable without those that follow the places of its flags."""
    places = {"flag_masks", "lidarops_flag_layout"}
    places |= {"flag_meanings"} if "flag_masks" in attributes else set()
    return {name: value for name, value in attributes.items() if name not in places}


def _masks(attributes: Mapping[str, Any]) -> dict[str, int]:
    """Return meaning -> mask of a variable of flags."""
    masks = np.atleast_1d(attributes["flag_masks"]).tolist()
    return dict(zip(attributes["flag_meanings"].split(), masks, strict=True))


def _compare_meanings(
    path: str, name: str, old: Mapping[str, Any], new: Mapping[str, Any], comparison: Comparison
) -> None:
    before, after = sorted(_masks(old)), sorted(_masks(new))
    comparison.counts["variables of flags"] += 1
    if before != after:
        comparison.failures.append(f"{path}: {name} has meanings {after}, had {before}")


def _by_meaning(values: np.ndarray, attributes: Mapping[str, Any]) -> np.ndarray:
    """Return values with their flags in the order of their names, then bits without a name."""
    masks = _masks(attributes)
    unnamed = values.astype(np.int64) & ~sum(masks.values())
    for place, name in enumerate(sorted(masks)):
        unnamed |= ((values & masks[name]) != 0).astype(np.int64) << (32 + place)
    return unnamed


def _form(variable: netCDF4.Variable, *, text: bool) -> tuple[Any, ...]:
    """Return type, dimensions and storage; sizes of texts may differ."""
    form = (
        str(variable.dtype),
        tuple(map(_renamed, variable.dimensions)),
        variable.endian(),
        variable.filters(),
    )
    return form if text else (*form, variable.shape, variable.chunking())


def _text(variable: netCDF4.Variable) -> str:
    """Return the content of a text variable, one line for each value."""
    variable.set_auto_chartostring(False)
    values = np.asarray(variable[...])
    if values.dtype.kind == "S":
        # Zero bytes are padding.
        rows = values.reshape(-1, values.shape[-1] if values.ndim else 1)
        return "\n".join(b"".join(row.tolist()).decode() for row in rows)
    return "\n".join(str(value) for value in values.ravel().tolist())


def _differing(before: np.ndarray, after: np.ndarray) -> tuple[int, float]:
    """Return how many values differ in any bit (NaN equals NaN), and the largest difference."""
    if before.tobytes() == after.tobytes():
        return 0, 0.0
    size = before.dtype.itemsize
    rows = [np.ascontiguousarray(values).reshape(-1).view(np.uint8) for values in (before, after)]
    other = (rows[0].reshape(-1, size) != rows[1].reshape(-1, size)).any(axis=1)
    old, new = before.reshape(-1), after.reshape(-1)
    if before.dtype.kind == "f":
        other &= ~(np.isnan(old) & np.isnan(new))
    if not other.any():
        return 0, 0.0
    difference = np.abs(new[other].astype(float) - old[other].astype(float))
    return int(other.sum()), float(np.nanmax(difference, initial=0.0))


def _compare_provenance(path: str, before: str, after: str, comparison: Comparison) -> None:
    """Compare two provenances entry by entry: texts are listed, other differences are failures."""
    old, new = _entries(before), _entries(after)
    old = {
        _renamed(place) if "/settings/" in place else place: value for place, value in old.items()
    }
    for place in sorted({*old, *new}):
        if old.get(place) == new.get(place) or DERIVED_PROVENANCE.fullmatch(place):
            continue
        if isinstance(old.get(place), str) and isinstance(new.get(place), str):
            # Steps are numbered in a plan; their texts are not.
            where = re.sub(r"/\d+(?=/|$)", "/*", place)
            _list_text(f"provenance:{where}", old[place], new[place], comparison)
        else:
            change = f"is {_short(new.get(place))}, was {_short(old.get(place))}"
            comparison.failures.append(f"{path}: provenance: {place} {change}")


def _entries(text: str) -> dict[str, Any]:
    """Return place -> value of a provenance, with products named by path and not by digest."""
    for entity in json.loads(text)["entity"].values():
        # Means name products by digests, which contain the code version.
        if entity["prov:type"]["$"] == "lidarops:Product" and "lidarops:path" in entity:
            for key in ("lidarops:sha256", "lidarops:id"):
                text = text.replace(entity[key], entity["lidarops:path"])
    document = json.loads(text)
    # Numbered in the order of digests.
    document["used"] = sorted(json.dumps(use, sort_keys=True) for use in document["used"].values())
    return dict(_leaves("", document))


def _leaves(place: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Give the place and value of every entry, also of JSON kept as text."""
    if isinstance(value, str) and value.startswith("{") and "/used/" not in place:
        value = json.loads(value)
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    else:
        yield place.removeprefix("/"), value
        return
    if not value:
        yield f"{place}/".removeprefix("/"), "empty"
    for key, item in items:
        yield from _leaves(f"{place}/{key}", item)


# Report ---------------------------------------------------------------------------------------


def _list_text(
    owner: str, before: str | list[str], after: str | list[str], comparison: Comparison
) -> None:
    """Count the words in which two texts differ, line by line where there are as many lines."""
    old, new = (text if isinstance(text, list) else text.split("\n") for text in (before, after))
    if len(old) != len(new):
        old, new = ["\n".join(old)], ["\n".join(new)]
    for changed in {_changed(*pair) for pair in zip(old, new, strict=True) if pair[0] != pair[1]}:
        comparison.texts[owner, *changed] += 1


def _changed(before: str, after: str, context: int = 4) -> tuple[str, str]:
    """Return the part in which two texts differ, with some words of context."""
    old, new = (re.findall(r"\s*\S+", text) or [text] for text in (before, after))
    shorter = min(len(old), len(new))
    head = next((k for k in range(shorter) if old[k] != new[k]), shorter)
    shorter -= head
    tail = next((k for k in range(shorter) if old[-1 - k] != new[-1 - k]), shorter)
    first, last = max(0, head - context), max(0, tail - context)
    left, right = "... " if first else "", " ..." if last else ""
    parts = ["".join(words[first : len(words) - last]).strip() for words in (old, new)]
    return f"{left}{parts[0]}{right}", f"{left}{parts[1]}{right}"


def _short(value: Any) -> str:
    text = "absent" if value is None else repr(value)
    return text if len(text) <= 200 else f"{text[:197]}..."


def _print(comparison: Comparison) -> None:
    """Print texts that differ, failures, and how much was compared."""
    print(
        f"\n{len(comparison.texts)} texts differ (no failure); not compared: {', '.join(DERIVED)}"
    )
    last = ""
    for (owner, before, after), files in sorted(comparison.texts.items()):
        if owner != last:
            print(f"  {owner}")
            last = owner
        print(f"    in {files} files\n      - {before}\n      + {after}")
    print(f"\n{len(comparison.failures)} failures")
    for failure in comparison.failures:
        print(f"  {failure}")
    counts = comparison.counts
    numbers = [
        f"{counts[item]} {item}"
        for item in ("archives", "NetCDF files", "other files", "variables", "variables of flags")
    ]
    print(
        f"\n{', '.join(numbers)}; {counts['values']} values compared,"
        f" {counts['values differing']} differing; {counts['texts']} variables of text;"
        f" {'NOT THE SAME' if comparison.failures else 'the same'}"
    )


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make", help="make the archives with this checkout's lidarops")
    making.add_argument("out", type=Path)
    comparing = commands.add_parser("compare", help="compare what two checkouts have made")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    comparing.add_argument(
        "--renamed", nargs="+", default=[], metavar="OLD=NEW", help="words of variable names"
    )
    available = [name for name, recipe in RECIPES.items() if not recipe.raw or recipe.raw.is_dir()]
    for command in (making, comparing):
        command.add_argument("--only", nargs="+", choices=RECIPES, default=available)
    options = parser.parse_args()
    if options.command == "make":
        return make(options.out.resolve(), options.only)
    RENAMED.update(pair.split("=") for pair in options.renamed)
    return compare(options.before.resolve(), options.after.resolve(), options.only)


if __name__ == "__main__":
    sys.exit(main())

"""Sums that may be reassociated have the same last digits whatever was compiled before."""

from __future__ import annotations

import ast
from pathlib import Path

SUMS = {"summing", "fusing", "finding"}
INLINED = {*SUMS, "inlined", "allocating"}
COMPILED = {*INLINED, "compiled"}


def compiled_functions(module: Path) -> dict[str, tuple[str, set[str]]]:
    """Return how each compiled function of a module is compiled, and what it calls."""
    found = {}
    for each in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(each, ast.FunctionDef) and each.decorator_list:
            how = ast.unparse(each.decorator_list[0])
            called = {ast.unparse(c.func) for c in ast.walk(each) if isinstance(c, ast.Call)}
            if how in COMPILED:
                found[each.name] = how, called
    return found


def test_what_calls_a_sum_is_inlined_or_called_from_python_alone(repository: Path):
    modules = {
        path: compiled_functions(path)
        for path in sorted((repository / "lidarops" / "retrieve").rglob("*.py"))
    }
    everywhere = [function for module in modules.values() for function in module.items()]
    # Names with an underscore belong to their module, others to all.
    checked = 0
    for path, module in modules.items():
        sums = {name for name, (how, _) in everywhere if how in SUMS and not name.startswith("_")}
        sums |= {name for name, (how, _) in module.items() if how in SUMS}
        for name, (how, called) in module.items():
            if not called & sums:
                continue
            checked += 1
            users = [user for user, (_, others) in module.items() if name in others]
            users += [user for user, (_, others) in everywhere if name in others and name[0] != "_"]
            assert how in INLINED or not users, f"{path.name}: {name}, called by {users}"
    assert checked > 10

"""Random mutations of the code, and whether tests fail: ``python -m benchmarks.studies.mutations``.

Each mutant is made in a copy of the checkout, and only the tests of its package are run.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lidarops.retrieve.common.compiled_code import keep_apart

ROOT: Final = Path(__file__).parents[2]
CACHE: Final = """
from lidarops.retrieve.common.compiled_code import keep_apart
print(keep_apart())
"""
TIME_LIMIT: Final = 300
"""CPU seconds of a process that tests a mutant; one that uses more counts as killed."""

PACKAGES: Final = {
    "retrieve/air": (2, "retrieve/air"),
    "retrieve/background": (5, "retrieve/background"),
    "retrieve/elastic": (7, "retrieve/elastic stiff"),
    "retrieve/homogeneous": (7, "retrieve/homogeneous stiff"),
    "retrieve/multiangle": (9, "retrieve/multiangle stiff"),
    "retrieve/network": (8, "retrieve/network stiff"),
    "retrieve/signal": (4, "retrieve/signal"),
    "plan": (6, "plan steps end_to_end/test_leaving_out.py"),
    "catalog": (6, "catalog raw/test_licel_archive.py run"),
    "run": (6, "run end_to_end/test_reproduction.py end_to_end/test_archives.py"),
}
"""Package -> number of mutants in 60, by size, and tests."""

COMPARISONS: Final[dict[type, tuple[type | None, type]]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (None, ast.NotEq),
    ast.NotEq: (None, ast.Eq),
    ast.Is: (None, ast.IsNot),
    ast.IsNot: (None, ast.Is),
    ast.In: (None, ast.NotIn),
    ast.NotIn: (None, ast.In),
}
"""Comparison -> the one that differs at the boundary, and the opposite."""

OPERATORS: Final[dict[type, type]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
_PAIRS: Final = {"min": "max", "minimum": "maximum", "argmin": "argmax", "any": "all"}
NAMES: Final = _PAIRS | {new: old for old, new in _PAIRS.items()}
"""Function -> the one that is called instead."""


@dataclass(frozen=True)
class Mutant:
    """One expression of a file, and what stands there instead."""

    path: Path
    kind: str
    line: int
    span: tuple[int, int]
    new: str

    def source(self, old: bytes) -> bytes:
        """Return the source with the mutation."""
        return old[: self.span[0]] + self.new.encode() + old[self.span[1] :]


def mutants(root: Path, path: Path) -> Iterator[Mutant]:
    """Yield all mutants of a file of a checkout."""
    source = (root / path).read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node in _expressions(ast.parse(source)):
        span = (
            starts[node.lineno - 1] + node.col_offset,
            starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0),
        )
        for kind, new in _replacements(node):
            text = ast.unparse(ast.fix_missing_locations(new))
            whole = text if isinstance(node, ast.AugAssign) else f"({text})"
            yield Mutant(path, kind, node.lineno, span, whole)


def _expressions(node: ast.AST) -> Iterator[ast.expr | ast.AugAssign]:
    """Yield what is computed: no annotations, decorators, messages or assertions."""
    left_out = (ast.Raise, ast.JoinedStr, ast.Assert)
    for name, value in ast.iter_fields(node):
        if name in {"annotation", "returns", "decorator_list"}:
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, left_out):
                continue
            if isinstance(child, ast.expr | ast.AugAssign):
                yield child
            yield from _expressions(child)


def _replacements(node: ast.expr | ast.AugAssign) -> Iterator[tuple[str, ast.AST]]:
    match node:
        case ast.Compare(left=left, ops=[op], comparators=others):
            boundary, opposite = COMPARISONS[type(op)]
            if boundary:
                yield "boundary", ast.Compare(left, [boundary()], others)
            yield "comparison", ast.Compare(left, [opposite()], others)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            yield "operator", ast.BinOp(left, OPERATORS[type(op)](), right)
        case ast.AugAssign(target=target, op=op, value=value) if type(op) in OPERATORS:
            yield "operator", ast.AugAssign(target, OPERATORS[type(op)](), value)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield "not", operand
        case ast.BoolOp(op=op, values=values):
            yield "and, or", ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
        case ast.Constant(value=bool() | int() | float() as value):
            yield "constant", ast.Constant(_other_number(value))
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=options) if name in NAMES:
            yield "min, max", ast.Call(ast.Name(NAMES[name]), arguments, options)
        case ast.Call(func=ast.Attribute(of, name), args=arguments, keywords=options) if (
            name in NAMES
        ):
            yield "min, max", ast.Call(ast.Attribute(of, NAMES[name]), arguments, options)


def _other_number(value: float) -> float:
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else 2.0 * value or 1.0


def choose(root: Path, count: int, seed: int) -> list[tuple[str, Mutant]]:
    """Return random mutants of a checkout: packages by their shares, kinds of mutation alike."""
    generator = random.Random(seed)
    total = sum(share for share, _ in PACKAGES.values())
    chosen: list[tuple[str, Mutant]] = []
    for package, (share, _) in PACKAGES.items():
        paths = sorted((root / "lidarops" / package).rglob("*.py"))
        every = [mutant for path in paths for mutant in mutants(root, path.relative_to(root))]
        kinds = sorted({mutant.kind for mutant in every})
        for _ in range(round(share * count / total)):
            kind = generator.choice(kinds)
            chosen.append((package, generator.choice([m for m in every if m.kind == kind])))
    return chosen


def importers(root: Path, module: Path) -> set[Path]:
    """Return the modules of lidarops that import one, also through others, and the module."""
    imported = {
        path.relative_to(root): {
            name
            for node in ast.walk(ast.parse(path.read_bytes()))
            if isinstance(node, ast.ImportFrom) and node.module
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        }
        for path in (root / "lidarops").rglob("*.py")
    }
    found, left = {module}, [module]
    while left:
        name = ".".join(left.pop().with_suffix("").parts).removesuffix(".__init__")
        new = {path for path, names in imported.items() if name in names} - found
        found |= new
        left += new
    return found


class Copy:
    """A copy of the checkout, in which mutants are tested."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
        for name in filter(None, listed.stdout.split("\0")):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        self._compiled = folder / "compiled"
        # The compiled code of the checkout; numba names its folders after those of the sources.
        for source in (ROOT / "lidarops").rglob("*"):
            if source.is_dir() and source.name != "__pycache__":
                own = _cache_name(folder / source.relative_to(ROOT))
                for cached in Path(keep_apart()).glob(_cache_name(source)):
                    shutil.copytree(cached, self._compiled / own)

    def failure(self, package: str, mutant: Mutant) -> str:
        """Return the first test that fails with a mutant; an empty text if it survives."""
        path = self.folder / mutant.path
        old, stat = path.read_bytes(), path.stat()
        # Compiled code holds code and constants of the modules that its module imports.
        stale = {module.stem for module in importers(self.folder, mutant.path)}
        path.write_bytes(mutant.source(old))
        try:
            own = Path(self._python("-c", CACHE).stdout.strip())
            if not own.is_relative_to(self.folder):
                return "cannot be imported"
            _copy_compiled(self._compiled, own, stale)
            naming, others = self._tests(package, mutant)
            failed = (naming and self._run(naming)) or (others and self._run(others)) or ""
            _copy_compiled(own, self._compiled, stale)
            shutil.rmtree(own, ignore_errors=True)
            return failed
        finally:
            # Compiled code is kept for a file of this time.
            path.write_bytes(old)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    def _tests(self, package: str, mutant: Mutant) -> tuple[list[str], list[str]]:
        """Return the test files of the package that name the module, and the others."""
        files: list[Path] = []
        for name in PACKAGES[package][1].split():
            path = self.folder / "tests" / name
            files += sorted(path.rglob("test_*.py")) if path.is_dir() else [path]
        word = mutant.path.stem.removeprefix("_")
        naming = [str(file) for file in files if word in file.read_text() + file.name]
        return naming, [str(file) for file in files if str(file) not in naming]

    def _run(self, tests: list[str]) -> str:
        """Return the first failure; an empty text if all tests pass."""
        options = ["-x", "-q", "-p", "no:cacheprovider", "-o", "timeout=0"]
        done = self._python("-m", "pytest", *options, *tests)
        if done.returncode == 0:
            return ""
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return failed[0].replace(f"{self.folder}/", "")[:160] if failed else "no report"

    def _python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {
            "PYTHONPATH": f"{self.folder}:{self.folder}/tests/plugin",
            # Compiled bytecode makes the next start faster.
            "PYTHONDONTWRITEBYTECODE": "",
            "OMP_NUM_THREADS": "1",
        }
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=self.folder,
            env=environment,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT, TIME_LIMIT)),
            capture_output=True,
            text=True,
            check=False,
        )


def _cache_name(folder: Path) -> str:
    return f"{folder.name}_{hashlib.sha1(str(folder).encode(), usedforsecurity=False).hexdigest()}"


def _copy_compiled(source: Path, target: Path, stale: set[str]) -> None:
    """Copy compiled functions, but for those of modules that are stale."""
    for file in source.rglob("*.nb?"):
        if file.name.split(".")[0] not in stale:
            (target / file.parent.name).mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, target / file.parent.name)


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Write one line a mutant, as a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the mutants to test")
    parser.add_argument("--list", action="store_true", help="name the mutants, and test none")
    arguments = parser.parse_args()
    sys.stdout.write("| | mutant | kind | instead | outcome | CPU s |\n" + "| --- " * 6 + "|\n")
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        chosen = choose(copy.folder, arguments.count, arguments.seed)
        for number in arguments.only or range(len(chosen)):
            package, mutant = chosen[number]
            before = _cpu()
            outcome = ""
            if not arguments.list:
                failed = copy.failure(package, mutant)
                outcome = f"killed: {failed}" if failed else "survived"
            new = mutant.new.replace("|", "\\|")
            sys.stdout.write(
                f"| {number} | {mutant.path}:{mutant.line} | {mutant.kind} | `{new}` | {outcome} "
                f"| {_cpu() - before:.0f} |\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()

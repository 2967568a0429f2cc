"""Kill and disturb commands many times, and check that nothing is lost or wrong.

``python tests/crash/soak.py --kills 1000 --seed 1 --folder /tmp/soak`` kills the process groups, or
only the first process, of runs on the command line, with dask workers and as flows, of aggregate,
site, publish and report, at random moments. In half of them calls of the system fail now and then,
and in a quarter a raw file is damaged until the command has ended.
After each kill the ledger holds only what is on the disk, and every product and published file is
absent or right; after each round of kills, undisturbed commands give what they give without kills.

Most commands are forks of this process, which has loaded what they need: a command with its checks
takes about one second of CPU time. Some start afresh by the console script, and all of dask and
Prefect do.
Moments are counted in CPU time of the command, so that kills fall evenly on it on any machine.
``--jobs`` soaks that many archives beside each other.

A file is renamed first and entered in the ledger then, because the two cannot be one operation: the
other order would enter files that do not exist. A kill in between, or a disk that fails as the
renaming is made durable, leaves a file that the ledger does not know. That shows only where the
bytes differ from those before, so where a part of the files of a scene could not be read before or
now. Then only one scene of each worker may be concerned, ``verify`` must name these files, each
must be right, and the next run makes them again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import sys
import sysconfig
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import h5py

# By it all products are dated.
os.environ.setdefault("SOURCE_DATE_EPOCH", "1700000000")
TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from support import damage  # noqa: E402
from support.archives import crash_archive  # noqa: E402
from support.faults import sitecustomize as faults  # noqa: E402

from lidarops.cli import app  # noqa: E402
from lidarops.netcdf.comparison import compare_products  # noqa: E402
from lidarops.records import Grade  # noqa: E402
from lidarops.system.files import MANIFEST  # noqa: E402

RUN_ID = re.compile(rb"\d{8}T\d{6}-[0-9a-f]{6}")
SCENES = 2
FILES = 6
"""Raw files of a scene of the archive."""
STEPS = 25
"""Kills of a round, after which undisturbed commands follow."""
FRESH = 12
"""One of so many commands starts by the console script."""
RATES = (0.0005, 0.005, 0.05)
"""Shares of the calls on files that fail in a disturbed command."""
DAMAGED = 0.25
"""Share of the commands that meet a damaged raw file."""
DAMAGES: dict[str, Callable[[Path, random.Random], object]] = {
    "truncated": lambda file, rng: file.write_bytes(damage.truncate(file.read_bytes(), rng)),
    "empty": lambda file, _: file.write_bytes(b""),
    "zeroed page": lambda file, _: file.write_bytes(bytes(512) + file.read_bytes()[512:]),
    "flipped line ends": lambda file, rng: file.write_bytes(
        damage.flip_line_end(file.read_bytes(), rng)
    ),
    "vanished": lambda file, _: file.unlink(),
    "unreadable": lambda file, _: (file.unlink(), file.symlink_to(file)),
}
"""For which a file is refused; a flipped digit of a time would make another scene."""
TAG = "LIDAROPS_TEST_SOAK"
COMMANDS = ("reprocess", "force", "site", "aggregate", "publish", "report")
WEIGHTS = (6, 2, 2, 2, 2, 1)
GROUPS = {"cluster": 4.0, "pool": 4.0, "flow": 20.0}
"""CPU time in s of commands that start interpreters."""
TRACEBACK = 99
"""Exit code of a command that ended with a traceback."""
GIVE_UP = 120.0
"""s that a process may outlive its parent, on a busy machine; it should be none."""


@dataclass
class Tally:
    """Numbers of what was done."""

    kills: Counter[str] = field(default_factory=Counter)
    ended: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    """Calls of the system that failed on purpose."""
    damages: Counter[str] = field(default_factory=Counter)
    """Raw files damaged while a command ran."""
    disturbed: int = 0
    """Commands in which calls of the system may fail."""
    unentered: int = 0
    """Commands that ended between the renaming of a changed product and its entry in the ledger."""
    rounds: int = 0
    tracebacks: int = 0
    """Disturbed commands that ended with a traceback instead of a message."""
    corrupted: int = 0
    slowest_end: float = 0.0
    """s that the last child of a killed process lived on."""

    def add(self, other: Tally) -> None:
        for name, value in vars(other).items():
            if isinstance(value, Counter):
                getattr(self, name).update(value)
            else:
                join = max if name == "slowest_end" else sum
                setattr(self, name, join((getattr(self, name), value)))


class Soak:
    """One campaign folder after the other, with seeded kills."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.rng = random.Random(seed)
        self.folder = folder
        self.tally = Tally()
        self.disturbed = False
        """Whether a command of this round was disturbed."""
        self.unentered: set[str] = set()
        """Products of other files than before that a killed command could not enter."""
        self.parts: dict[str, bool] = {}
        """Digest of a product of some files of its scene -> whether it is right."""
        self.calm = folder / "calm"
        crash_archive.make(self.calm, scenes=SCENES)
        _load_commands(self.calm, folder / "loading")
        self.took = {name: self._timed(name) for name in COMMANDS} | GROUPS
        self.start_up = self._timed("reprocess", fresh=True)
        self.whole = crash_archive.products(self.calm)
        self.views = _views(self.calm)

    def _timed(self, name: str, *, fresh: bool = False) -> float:
        """Return the CPU time in s of an undisturbed command."""
        process = _start(_command(self.calm, name), self.calm, fresh=fresh)
        status, took = _watch(process)
        assert status == 0, f"{name} without kills ended with {status}"
        return took

    def run_jobs(self, jobs: int, kills: int, seconds: float) -> int:
        """Soak in processes with folders of their own; return how many of them failed."""
        processes = {
            os.fork() or self._job(job, kills // jobs + (job < kills % jobs), seconds): job
            for job in range(jobs)
        }
        failed = 0
        while processes:
            process, status = os.wait()
            failed += status != 0
            file = self._folder_of(processes.pop(process)) / "tally.json"
            if file.exists():
                tally = json.loads(file.read_text())
                self.tally.add(
                    Tally(**{k: Counter(v) if isinstance(v, dict) else v for k, v in tally.items()})
                )
        return failed

    def _folder_of(self, job: int) -> Path:
        return self.folder / f"job{job}"

    def _job(self, job: int, kills: int, seconds: float) -> NoReturn:
        failed = 1
        try:
            self.folder = self._folder_of(job)
            self.folder.mkdir()
            self.rng = random.Random(self.rng.random() + job)
            self.run(kills, seconds)
            failed = 0
        except BaseException:  # noqa: BLE001 - the process is a fork of the soak, and must not go on
            traceback.print_exc()
        finally:
            (self.folder / "tally.json").write_text(json.dumps(vars(self.tally)))
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(failed)

    def run(self, kills: int, seconds: float) -> None:
        until = time.monotonic() + seconds
        while self.tally.kills.total() < kills and time.monotonic() < until:
            place = self.folder / f"round{self.tally.rounds}"
            shutil.copytree(self.calm / "raw", place / "raw")
            shutil.copy(self.calm / "campaign.yaml", place)
            self.disturbed, self.unentered = False, set()
            for _ in range(min(STEPS, kills - self.tally.kills.total())):
                self._step(place)
            self._conclude(place)
            self.tally.rounds += 1
            print(json.dumps(vars(self.tally)), flush=True)
            shutil.rmtree(place)

    def _step(self, place: Path) -> None:
        """Start a command, kill it at a random moment, and check what is left."""
        number = self.tally.kills.total() + self.tally.ended.total()
        name = self.rng.choices(COMMANDS, WEIGHTS)[0]
        # These start interpreters, which takes most of their time.
        name = {14: "cluster", 29: "pool", 44: "cluster", 59: "flow"}.get(number % 60, name)
        fresh = name not in GROUPS and number % FRESH == 0
        disturbed = self.rng.random() < 0.5
        self.tally.disturbed += disturbed
        damaged = self._damage(place)
        self.disturbed |= disturbed or damaged is not None
        wrong = f"{self.rng.getrandbits(31)} {self.rng.choice(RATES)}" if disturbed else ""
        moment = self.rng.uniform(0.0, self.took[name] + fresh * self.start_up)
        process = _start(_command(place, name), place, wrong, fresh=fresh)
        status, _ = _watch(process, place if name in GROUPS else None, moment)
        label = f"{name}{', console script' if fresh else ''}"
        if status is None:
            alone = self.rng.random() < 0.5
            (os.kill if alone else os.killpg)(process, signal.SIGKILL)
            os.waitpid(process, 0)
            self.tally.kills[f"{label}{', first process' if alone else ''}"] += 1
        else:
            self.tally.ended[label] += 1
            self.tally.tracebacks += status == TRACEBACK
        began = time.monotonic()
        while left := _processes(place):
            assert time.monotonic() - began < GIVE_UP, f"{name}: {left} live on"
            time.sleep(0.02)
        self.tally.slowest_end = max(self.tally.slowest_end, time.monotonic() - began)
        if damaged is not None:
            damaged.unlink(missing_ok=True)
            shutil.copy(self.calm / "raw" / damaged.name, damaged)
        workers = 2 if name in ("cluster", "flow") else 1
        self._check(place, interrupted=status is None or disturbed, workers=workers)

    def _damage(self, place: Path) -> Path | None:
        """Damage a raw file in a part of the commands, and return it."""
        if self.rng.random() >= DAMAGED:
            return None
        file = self.rng.choice(sorted((place / "raw").iterdir()))
        name = self.rng.choice(list(DAMAGES))
        DAMAGES[name](file, self.rng)
        self.tally.damages[name] += 1
        return file

    def _check(self, place: Path, *, interrupted: bool, workers: int) -> None:
        unentered = set(crash_archive.wrong_rows(place))
        new = unentered - self.unentered
        if new:
            self.tally.unentered += 1
            assert interrupted, f"the ledger does not hold {new}"
            assert self.disturbed, f"the ledger does not hold {new}"
            assert all((place / "out/products" / path).exists() for path in new)
            scenes = {path.rpartition("_")[2] for path in new}
            assert len(scenes) <= workers, f"products of several scenes are not entered: {new}"
            _, output = _called(["verify", _campaign(place), "--json"], place)
            named = {Path(wrong["path"]).name for wrong in json.loads(output)["mismatches"]}
            assert named >= {Path(path).name for path in unentered}, output
        self.unentered = unentered
        for root in (place / "out/products", place / "published"):
            for path, digest in _digests(root).items():
                # Of a file that could not be read, the product says so, and the next run mends it.
                right = digest == self.whole[path] or self._is_later_version(root / path, path)
                right = right or (self.disturbed and self._is_right_part(root / path, digest))
                assert right, f"{root / path} is wrong"
        for page in (place / "out/report").glob("*/index.html"):
            assert page.read_text().rstrip().endswith("</html>")

    def _conclude(self, place: Path) -> None:
        """Run everything undisturbed, and compare it with what was never disturbed."""
        file = _log_of_faults(place)
        self.tally.faults.update(file.read_text().split() if file.exists() else ())
        file.unlink(missing_ok=True)
        changed = self._corrupt(place) if self.rng.random() < 0.3 else ""
        for name in ("reprocess", "site", "aggregate", "publish"):
            code, output = _called(_command(place, name), place)
            assert code == 0, f"{name} after kills ended with {code}: {output}"
        products = crash_archive.products(place)
        assert products.keys() == self.whole.keys(), changed
        for path, digest in products.items():
            right = digest == self.whole[path]
            assert right or self._is_later_version(place / "out/products" / path, path), path
        assert _digests(place / "published") == products
        views = self.views if products == self.whole else self._new_views(place)
        assert _views(place) == views
        code, output = _called(_command(place, "reprocess"), place)
        assert (code, "nothing to do" in output) == (0, True), output
        code, output = _called(["verify", _campaign(place), "--json"], place)
        assert (code, json.loads(output)["mismatches"]) == (0, []), output
        code, output = _called(["catalog", _campaign(place), "--json"], place)
        assert json.loads(output)["refused_files"] == [], output

    def _is_later_version(self, product: Path, path: str) -> bool:
        """Return whether a product is right, but its second version: the first was of a part."""
        calm = self.calm / "out/products" / path
        return self.disturbed and compare_products(calm, product).grade is Grade.NONE

    def _is_right_part(self, product: Path, digest: str) -> bool:
        """Return whether a product states fewer files than its scene has, and follows from them."""
        if digest not in self.parts:
            with h5py.File(product) as file:
                of_part = file.attrs["lidarops_input_count"].item() < FILES
            words = ["reproduce", str(product), "--archive", str(self.calm / "raw")]
            self.parts[digest] = of_part and _called(words, self.folder)[0] == 0
        return self.parts[digest]

    def _new_views(self, place: Path) -> dict[str, str]:
        """Return the views of the products of a round, where nothing was before them."""
        new = place / "new"
        kept = shutil.ignore_patterns("site", "aggregates")
        shutil.copytree(place / "out", new / "out", ignore=kept)
        shutil.copytree(place / "published", new / "published")
        for name in ("site", "aggregate"):
            code, output = _called(_command(new, name), new)
            assert code == 0, f"{name} without a former one ended with {code}: {output}"
        return _views(new)

    def _corrupt(self, place: Path) -> str:
        """Change a byte of a product; verify must name it, and a run make it again."""
        if _called(_command(place, "reprocess"), place)[0]:
            return ""
        file = self.rng.choice(sorted((place / "out/products").rglob("*.nc")))
        data = bytearray(file.read_bytes())
        data[self.rng.randrange(len(data))] ^= 1
        file.write_bytes(bytes(data))
        self.tally.corrupted += 1
        code, output = _called(["verify", _campaign(place), "--json"], place)
        named = [wrong["path"] for wrong in json.loads(output)["mismatches"]]
        assert (code, [Path(path).name for path in named]) == (1, [file.name]), output
        return file.name


def _campaign(place: Path) -> str:
    return str(place / "campaign.yaml")


def _command(place: Path, name: str) -> list[str]:
    """Return the words after ``lidarops``; of a flow, those after ``python``."""
    if name == "report":
        runs = sorted((place / "out/report").glob("*/run.json"))
        return ["report", str(runs[-1].parent)] if runs else _command(place, "reprocess")
    campaign, out = _campaign(place), str(place / "out")
    return {
        "reprocess": ["reprocess", campaign, "--wait", "60"],
        "force": ["reprocess", campaign, "--wait", "60", "--force"],
        "cluster": ["reprocess", campaign, "--wait", "60", "--force", "--workers", "2"],
        "flow": ["-m", "flows.reprocess", campaign, "--wait", "60", "--force"],
        "site": ["site", out],
        "pool": ["site", out, "--workers", "2"],
        "aggregate": ["aggregate", out],
        "publish": ["publish", campaign, f"file://{place}/published"],
        "verify": ["verify", campaign, "--json"],
        "catalog": ["catalog", campaign, "--json"],
    }[name]


def _load_commands(calm: Path, place: Path) -> None:
    """Run the commands within this process, so that its forks have modules and kernels loaded."""
    shutil.copytree(calm / "raw", place / "raw")
    shutil.copy(calm / "campaign.yaml", place)
    with (place / "output.txt").open("w") as output, redirect_stdout(output):
        for name in (*COMMANDS, "verify", "catalog"):
            with suppress(SystemExit):
                app(_command(place, name))
    assert threading.active_count() == 1, "a fork would lack a thread"
    shutil.rmtree(place)


def _watch(
    process: int, group: Path | None = None, moment: float = float("inf")
) -> tuple[int | None, float]:
    """Return the exit code of a process, none if it still runs at a moment, and its CPU time in s.

    With the folder of its commands, the time is that of all processes that descend from it.
    """
    took = 0.0
    while True:
        members = [process] if group is None else _processes(group)
        now = sum(_cpu_time(member) for member in members)
        took = max(took, now)
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), took
        if took > moment:
            return None, took
        time.sleep(0.003 if group is None else 0.05)


def _cpu_time(process: int) -> float:
    """Return the CPU time of a process in s, by the clock that clock_getcpuclockid(3) gives."""
    with suppress(OSError):
        return time.clock_gettime((~process << 3) | 2)
    return 0.0


def _start(
    words: Sequence[str],
    place: Path,
    wrong: str = "",
    output: int | None = None,
    *,
    fresh: bool = False,
) -> int:
    """Start a command as the first process of a group, with faults by the seed and rate given."""
    process = os.fork()
    if process:
        return process
    # Forked, because a new interpreter would load modules for seconds.
    code = 1
    try:
        os.setsid()
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null if output is None or stream == 0 else output, stream)
        os.environ |= {TAG: str(place), "PREFECT_HOME": str(place / "prefect")}
        os.environ["PYTHONPATH"] = f"{Path(faults.__file__).parent}:{TESTS.parent}"
        if wrong:
            os.environ[faults.VARIABLE] = f"{wrong} {place}"
            os.environ[faults.LOG] = str(_log_of_faults(place))
        if words[0] == "-m":
            os.execv(sys.executable, [sys.executable, *words])
        if "--workers" in words:
            # A pool needs a parent that it can import anew.
            os.execv(sys.executable, [sys.executable, "-m", "lidarops", *words])
        if fresh:
            script = Path(sysconfig.get_path("scripts")) / "lidarops"
            os.execv(script, [str(script), *words])
        faults.install_from_environment()
        app(list(words))
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:  # noqa: BLE001 - the process is a fork of the soak, and must not go on
        traceback.print_exc()
        code = TRACEBACK
    finally:
        sys.stdout.flush()
        os._exit(code)


def _log_of_faults(place: Path) -> Path:
    """Return the file in which the processes of a folder note the calls that failed on purpose."""
    return place.with_name(f"{place.name}.faults")


def _wait(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def _called(words: Sequence[str], place: Path) -> tuple[int, str]:
    """Run a command to its end without kills and faults; return its exit code and output."""
    file = place / "output.txt"
    with file.open("wb") as stream:
        code = _wait(_start(words, place, output=stream.fileno()))
    return code, file.read_text()


def _processes(place: Path) -> list[int]:
    """Return the living processes that descend from commands of a folder."""
    mark = f"{TAG}={place}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            ours = entry.name.isdigit() and mark in (entry / "environ").read_bytes().split(b"\0")
            if ours and (entry / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                found.append(int(entry.name))
    return found


def _digests(root: Path, skipped: Callable[[Path], bool] = lambda _: False) -> dict[str, str]:
    return {
        # The site links the report of the last run, by the id of the run; its manifest states it.
        path.relative_to(root).as_posix(): hashlib.sha256(
            RUN_ID.sub(b"RUN", path.read_bytes())
            if path.suffix == ".html" or path.name == MANIFEST
            else path.read_bytes()
        ).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.startswith(".") and not skipped(path)
    }


def _views(place: Path) -> dict[str, str]:
    """Return the digests of site, aggregates and published files."""
    return {
        f"{name}/{path}": digest
        for name, root in (
            ("site", place / "out/site"),
            ("aggregates", place / "out/aggregates"),
            ("published", place / "published"),
        )
        for path, digest in _digests(root).items()
    }


def main() -> None:
    """Soak, and print what was done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after this time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    soak = Soak(options.folder, options.seed)
    failed = soak.run_jobs(options.jobs, options.kills, options.seconds)
    print(json.dumps(vars(soak.tally)))
    sys.exit(failed)


if __name__ == "__main__":
    main()

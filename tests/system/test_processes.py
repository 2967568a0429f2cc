"""Work on several processes gives the same results in the same order, even if processes die."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool, _ExecutorManagerThread
from itertools import count, islice
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from lidarops.errors import CatalogError
from lidarops.system import processes
from lidarops.system.processes import Processes, prefetch_one


def product(kept: int, item: int) -> int:
    return kept * item


def process(kept: int, item: int) -> int:
    return os.getpid()


def deadly(kept: int, item: int) -> int:
    """End each process at an item, also the main one."""
    if item == 5:
        os._exit(9)
    return kept * item


def deadly_once(kept: Path, item: int) -> int:
    """End the first process that comes to an item."""
    if item == 5 and not kept.exists():
        kept.touch()
        os._exit(9)
    return 2 * item


def worn_out(kept: int, item: int) -> int:
    """End each process at its second item of these."""
    if item >= 5:
        WORN.append(item)
    if len(WORN) > 1:
        os._exit(9)
    return kept * item


WORN: list[int] = []


def lost(item: int) -> int:
    return -item


def failing(kept: int, item: int) -> int:
    if item == 5:
        raise CatalogError("is away", file="archive", remedy="wait")
    return item


def doubled(items: range) -> list[tuple[int, int]]:
    return [(item, 2 * item) for item in items]


def left_alive(others: Collection[BaseProcess], seconds: float) -> list[BaseProcess]:
    """Return the children besides others that do not end in time, and kill them."""
    left = [child for child in multiprocessing.active_children() if child not in others]
    for child in left:
        child.join(seconds)
    alive = [child for child in left if child.is_alive()]
    for child in alive:
        child.kill()
    return alive


def wait_until_idle(process: BaseProcess) -> None:
    """Wait until a process waits for work: it sleeps, and uses no more CPU time."""
    before, still = "", 0
    for _ in range(600):
        # From the state on; the name before it may hold spaces.
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        now = " ".join((fields[0], *fields[11:13]))
        still = still + 1 if now == before and fields[0] == "S" else 0
        if still == 10:
            return
        before = now
        time.sleep(0.1)


@pytest.fixture
def no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a process is started")

    monkeypatch.setattr(processes, "ProcessPoolExecutor", refuse)


class TestEach:
    @pytest.mark.parametrize("number", [1, 2])
    def test_keeps_the_order(self, number: int) -> None:
        with Processes(number, 2) as pool:
            assert list(pool.map_items(product, range(40), at_a_time=3)) == doubled(range(40))
            others = {results for _, results in pool.map_items(process, range(40), at_a_time=3)}
            assert list(pool.map_items(product, [], at_a_time=3)) == []
        assert (os.getpid() not in others) == (number > 1)

    def test_takes_items_as_they_are_needed(self) -> None:
        taken = count()
        with Processes(2, 2) as pool:
            results = pool.map_items(product, taken, at_a_time=1)
            assert list(islice(results, 30)) == doubled(range(30))
        assert next(taken) < 100

    @pytest.mark.usefixtures("no_process")
    def test_starts_no_process_for_few_items(self) -> None:
        with Processes(2, 2) as pool:
            results = pool.map_items(product, range(9), at_a_time=3, fewest=10)
            assert list(results) == doubled(range(9))

    @pytest.mark.usefixtures("no_process")
    def test_a_daemon_that_may_start_no_process_does_it_itself(self, monkeypatch) -> None:
        monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)
        with Processes(2, 2) as pool:
            assert list(pool.map_items(product, range(9), at_a_time=3)) == doubled(range(9))
            assert list(pool.map_items(product, [7], at_a_time=1, fewest=1)) == [(7, 14)]

    def test_loses_nothing_with_a_process(self, tmp_path, caplog) -> None:
        with caplog.at_level(logging.WARNING), Processes(2, tmp_path / "lost") as pool:
            done = list(pool.map_items(deadly_once, range(40), at_a_time=2, lost=lost))
            assert done == doubled(range(40))
            (other,) = {one for _, one in pool.map_items(process, range(4), at_a_time=1)}
            assert other != os.getpid()
        assert caplog.text.count("a process was lost") == 1

    def test_reports_an_item_that_ends_each_process_and_never_works_on_it_here(self) -> None:
        with Processes(2, 2) as pool:
            done = dict(pool.map_items(deadly, range(40), at_a_time=3, lost=lost))
            alone = pool.map_items(deadly, [5], at_a_time=1, fewest=1, lost=lost)
            assert list(alone) == [(5, -5)]
            with pytest.raises(BrokenProcessPool, match="5 ends each process"):
                list(pool.map_items(deadly, range(9), at_a_time=1))
        assert done == dict(doubled(range(40))) | {5: -5}

    def test_an_item_is_tried_in_a_fresh_process(self) -> None:
        with Processes(2, 2) as pool:
            done = dict(pool.map_items(worn_out, range(12), at_a_time=2, lost=lost))
        assert done == dict(doubled(range(12)))

    def test_leaves_none_behind_if_one_is_lost(self, monkeypatch) -> None:
        before = Future.set_exception

        def slowly(future: Future, error: BaseException) -> None:
            before(future, error)
            # Other tasks continue meanwhile.
            time.sleep(0.02)

        monkeypatch.setattr(Future, "set_exception", slowly)
        others = multiprocessing.active_children()
        with Processes(2, 2) as pool:
            assert len(list(pool.map_items(deadly, range(40), at_a_time=2, lost=lost))) == 40
        assert not left_alive(others, 60.0)

    def test_ends_a_process_that_starts_while_another_is_lost(self, monkeypatch) -> None:
        """The executor neither terminates it nor sends it an end: it does not know it yet."""
        start, terminate = BaseProcess.start, _ExecutorManagerThread.terminate_broken
        starts, begun = count(), threading.Event()
        others = multiprocessing.active_children()

        def slowly(process: BaseProcess) -> None:
            start(process)
            if next(starts):
                begun.set()
                wait_until_idle(process)

        def waiting(thread: _ExecutorManagerThread, cause: object) -> None:
            begun.wait(60)
            terminate(thread, cause)

        monkeypatch.setattr(BaseProcess, "start", slowly)
        monkeypatch.setattr(_ExecutorManagerThread, "terminate_broken", waiting)
        with Processes(2, 2) as pool:
            assert len(list(pool.map_items(deadly, range(40), at_a_time=6, lost=lost))) == 40
        assert begun.is_set()
        assert not left_alive(others, 60.0)

    @pytest.mark.parametrize(
        "error", [BlockingIOError("no more processes"), EOFError("unexpected EOF")]
    )
    def test_goes_on_here_where_none_can_be_started(
        self, monkeypatch, caplog, error: Exception
    ) -> None:
        def unstartable(*_: object, **__: object) -> None:
            raise error

        # Whichever is used.
        for method in ("spawn", "forkserver"):
            monkeypatch.setattr(multiprocessing.get_context(method), "Process", unstartable)
        with caplog.at_level(logging.WARNING), Processes(2, 2) as pool:
            assert list(pool.map_items(product, range(9), at_a_time=2)) == doubled(range(9))
        assert caplog.text.count("a process was lost") == 1

    @pytest.mark.parametrize("number", [1, 2])
    def test_raises_what_a_task_raises(self, number: int) -> None:
        with Processes(number, 2) as pool:
            results = pool.map_items(failing, range(40), at_a_time=1)
            assert list(islice(results, 5)) == [(item, item) for item in range(5)]
            with pytest.raises(CatalogError, match=r"archive: is away \(wait\)"):
                next(results)
            # No process was lost.
            others = {one for _, one in pool.map_items(process, [1, 2], at_a_time=1)}
        assert (os.getpid() not in others) == (number > 1)

    def test_leaves_no_process_if_the_caller_gives_up(self) -> None:
        with pytest.raises(KeyboardInterrupt), Processes(2, 2) as pool:
            _interrupted(pool)
        assert not multiprocessing.active_children()


def _interrupted(pool: Processes[int]) -> None:
    for item, _ in pool.map_items(product, count(), at_a_time=1):
        if item == 20:
            raise KeyboardInterrupt


AHEAD = """
import multiprocessing, os, signal, sys, time
from lidarops.system import processes
from lidarops.system.processes import Processes, preload_modules, start_method

def seen(kept, item):
    held = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return "colorsys" in sys.modules, os.getpid(), os.environ.get("OMP_NUM_THREADS"), held

def variable(kept, name):
    return os.environ.get(name)

if __name__ == "__main__":
    assert start_method() == "spawn"
    preload_modules(["colorsys", "no_such_module"])
    preload_modules(["wave"])
    assert start_method() == "forkserver"
    assert "OMP_NUM_THREADS" not in os.environ
    with Processes(2, 2) as pool:
        found = dict(pool.map_items(seen, range(6), at_a_time=1))
    assert all(loaded for loaded, *_ in found.values()), found
    assert "colorsys" not in sys.modules
    assert os.getpid() not in {pid for _, pid, *_ in found.values()}
    assert {threads for _, _, threads, _ in found.values()} == {"1"}
    # Ctrl-C reaches all processes of a terminal; the server must survive it.
    assert {held for _, _, _, held in found.values()} == {True}
    # The variable may be one that dates products or gives keys of a store.
    os.environ["LIDAROPS_SEEN"] = "later"
    with Processes(2, 2) as pool:
        (found,) = pool.map_items(variable, ["LIDAROPS_SEEN"], at_a_time=1, fewest=1)
        assert found[1] == "later"
    del os.environ["LIDAROPS_SEEN"]
    assert start_method() == "forkserver"
    with Processes(2, 2) as pool:
        ((_, found),) = pool.map_items(seen, [1], at_a_time=1, fewest=1)
        print(found[1], flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
"""

LOADING = """
import os, signal
from multiprocessing import forkserver
from lidarops.system.processes import preload_modules

if __name__ == "__main__":
    preload_modules(["loads_for_a_minute"])
    print(forkserver._forkserver._forkserver_pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""

IN_A_THREAD = """
import os, threading
from lidarops.system import processes

def kept_variables(kept, item):
    return [name for name in os.environ if "LIDAROPS" in name]

if __name__ == "__main__":
    thread = threading.Thread(target=processes.preload_modules, args=(["colorsys"],))
    thread.start()
    thread.join()
    assert processes.start_method() == "forkserver"
    with processes.Processes(2, 2) as pool:
        assert list(pool.map_items(kept_variables, [0], at_a_time=1, fewest=1)) == [(0, [])]
"""

WORKERS = """
import os
from lidarops.run.clusters import local_client
from lidarops.system.processes import preload_modules, start_method

if __name__ == "__main__":
    preload_modules(["distributed.nanny"])
    with local_client(2) as client:
        parents = set(client.run(os.getppid).values())
    import netCDF4
    assert len(parents) == 1, parents
    assert os.getpid() not in parents
    assert start_method() == "forkserver"
"""


class TestPrefetchOne:
    def test_gives_all_in_order(self) -> None:
        assert list(prefetch_one(range(9))) == list(range(9))
        assert list(prefetch_one([])) == []

    def test_computes_the_next_item_meanwhile_and_no_more(self) -> None:
        begun = [threading.Event() for _ in range(4)]

        def numbers() -> Iterator[int]:
            for number, event in enumerate(begun):
                event.set()
                yield number

        items = prefetch_one(numbers())
        assert next(items) == 0
        assert begun[1].wait(10)
        items.close()
        assert not begun[2].is_set()

    def test_raises_the_error_in_place_of_the_item(self) -> None:
        def numbers() -> Iterator[int]:
            yield 1
            raise CatalogError("is away", file="archive", remedy="wait")

        items = prefetch_one(numbers())
        assert next(items) == 1
        with pytest.raises(CatalogError, match="is away"):
            next(items)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks are not safe elsewhere")
class TestPreloadModules:
    def test_processes_have_the_modules_and_end_with_the_first_one(self, tmp_path: Path) -> None:
        script = tmp_path / "ahead.py"
        script.write_text(AHEAD)
        environment = {key: os.environ[key] for key in os.environ if key != "OMP_NUM_THREADS"}
        done = subprocess.run(
            [sys.executable, str(script)],
            capture_output=True, text=True, env=environment, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == -signal.SIGKILL, done.stderr
        assert _ends(int(done.stdout))

    def test_the_server_ends_with_its_parent_also_while_it_loads(self, tmp_path: Path) -> None:
        (tmp_path / "loads_for_a_minute.py").write_text("import time; time.sleep(60)")
        script = tmp_path / "loading.py"
        script.write_text(LOADING)
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        # Its standard error stays open as long as the server.
        done = subprocess.run(
            [sys.executable, str(script)],
            stdout=subprocess.PIPE, env=environment, timeout=30, check=False,
        )  # fmt: skip
        assert done.returncode == -signal.SIGKILL
        assert _ends(int(done.stdout))

    def test_processes_of_a_thread_know_no_parent_to_end_with(self, tmp_path: Path) -> None:
        script = tmp_path / "in_a_thread.py"
        script.write_text(IN_A_THREAD)
        environment = {key: os.environ[key] for key in os.environ if "LIDAROPS" not in key}
        done = subprocess.run(
            [sys.executable, str(script)],
            capture_output=True, text=True, env=environment, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr

    def test_serves_workers_and_later_processes(self, tmp_path: Path) -> None:
        script = tmp_path / "workers.py"
        script.write_text(WORKERS)
        done = subprocess.run(
            [sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr


def _ends(pid: int) -> bool:
    for _ in range(200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_existing_objects_are_not_collected_within_and_are_afterwards():
    assert gc.get_freeze_count() == 0
    with processes.objects_frozen():
        frozen = gc.get_freeze_count()
        assert frozen > 1000
        with processes.objects_frozen():
            assert gc.get_freeze_count() <= frozen
        # The inner context must not unfreeze.
        assert gc.get_freeze_count() > 1000
    assert gc.get_freeze_count() == 0
    with pytest.raises(ValueError, match="inside"), processes.objects_frozen():
        raise ValueError("inside")
    assert gc.get_freeze_count() == 0

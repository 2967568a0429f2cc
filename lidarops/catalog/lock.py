"""One writer at a time: a lock in the database, with a heartbeat."""

from __future__ import annotations

import getpass
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa

from lidarops.catalog.database import LOCK, Database
from lidarops.errors import CatalogError, UnavailableError

HEARTBEAT: Final = 5.0
"""s between heartbeats."""
SILENCE: Final = 60.0
"""s without heartbeat after which a holder counts as dead."""
_POLL: Final = 0.5

_L = LOCK.c
_LOG = logging.getLogger(__name__)
_held: set[str] = set()
"""Tokens of the locks that this process holds."""


class OvertakenError(Exception):
    """Another run has worked on the catalog since it was read."""


Holder = sa.Row[Any]
"""The row of a lock, with the time since its last heartbeat as ``silent``, s."""


def _is_dead(holder: Holder) -> bool:
    """Return whether a holder no longer works: it is silent, or its process has ended."""
    if holder.silent > SILENCE:
        return True
    if holder.machine != _machine():
        return False
    if holder.process == os.getpid() and holder.token not in _held:
        # A lock of this process that it could not release, because the disk was full.
        return True
    return process_start(holder.process) != str(holder.process_started)


class Lock(AbstractContextManager["Lock"]):
    """The right to write to the catalog of one campaign.

    It is acquired before the first write, so that a run with nothing to do writes nothing. The
    holder sends a heartbeat every few seconds. If it is dead, the next process takes over the lock.

    Parameters
    ----------
    database : Database
    wait : float
        Longest time to wait for another holder, s.
    """

    def __init__(self, database: Database, *, wait: float = 0.0) -> None:
        self._database = database
        self._wait = wait
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.token = secrets.token_hex(16)
        self.held = False
        self._last_beat: tuple[str, float] | None = None
        self._since = 0.0
        self._row = (_L.campaign == database.campaign, _L.token == self.token)

    @staticmethod
    def holder_name() -> str:
        """Return user, host and number of this process."""
        try:
            user = getpass.getuser()
        except (KeyError, OSError):
            user = str(os.getuid())
        return f"{user}@{socket.gethostname()} process {os.getpid()}"

    def acquire(self) -> bool:
        """Acquire the lock.

        Returns
        -------
        bool
            Whether it had to wait; data read before may then be outdated.

        Raises
        ------
        CatalogError
            If the holder, which the message names, does not release the lock in time.
        """
        if self.held:
            return False
        waited = self.wait_for(self._try)
        self.held = True
        _held.add(self.token)
        self._thread = threading.Thread(target=self._beat, name="lidarops-lock", daemon=True)
        self._thread.start()
        return waited

    def acquire_unchanged(self) -> None:
        """Acquire the lock, or raise an OvertakenError if it had to wait."""
        if self.acquire():
            raise OvertakenError

    def is_taken(self, *, by_others: bool = False) -> bool:
        """Return whether a living process holds the lock, or that of another campaign."""
        return not all(map(_is_dead, self._holders(others=by_others)))

    def wait_for(self, attempt: Callable[[], bool]) -> bool:
        """Repeat an attempt until it succeeds; return whether it failed at first.

        Raises
        ------
        CatalogError
            If the holder, which the message names, does not release the lock in time.
        """
        until = time.monotonic() + self._wait
        waited = False
        while not attempt():
            if time.monotonic() >= until:
                raise self._refusal()
            waited = True
            time.sleep(_POLL)
        return waited

    def release(self, *_: object) -> None:
        """Release the lock if it is held."""
        if not self.held:
            return
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self.held = False
        _held.discard(self.token)
        try:
            with self._database.transaction() as connection:
                connection.execute(sa.delete(LOCK).where(*self._row))
        except CatalogError as error:
            # The disk is full: the next process takes over when this one has ended.
            _LOG.warning("the lock stays until the next run: %s", error)

    __exit__ = release

    def held_by(self) -> str:
        """Return in words who holds the lock, and when it last gave a sign of life; empty if none.

        Where the clock of the holder is ahead of that of the database, the age is 0.
        """
        current = self.holder()
        if current is None:
            return ""
        since = datetime.fromtimestamp(current.acquired, UTC)
        return (
            f"held by {current.holder} since {since:%Y-%m-%d %H:%M:%S} UTC, with a sign of life"
            f" {max(current.silent, 0.0):.0f} s ago"
        )

    def holder(self) -> Holder | None:
        """Return the present holder of the lock."""
        return next(iter(self._holders()), None)

    def _holders(self, *, others: bool = False) -> list[Holder]:
        """Return the holder, or those of the locks of other campaigns of the database."""
        silent = (self._database.clock() - _L.heartbeat).label("silent")
        query = sa.select(LOCK, silent).where((_L.campaign != self._database.campaign) == others)
        return self._database.read(query, lambda holder: holder)

    def _try(self) -> bool:
        current = self.holder()
        if current is not None and not (_is_dead(current) or self._is_still(current)):
            return False
        database = self._database
        clock = database.clock()
        values = {
            "campaign": database.campaign,
            "token": self.token,
            "holder": self.holder_name(),
            "machine": _machine(),
            "process": os.getpid(),
            "process_started": process_start(os.getpid()),
            "acquired": clock,
            "heartbeat": clock,
        }
        # Only if a dead holder still has it: another process may have been faster.
        known = "" if current is None else current.token
        statement = database.insert(LOCK).values(values)
        statement = statement.on_conflict_do_update(
            index_elements=["campaign"], set_=values, where=_L.token == known
        )
        with database.transaction() as connection:
            connection.execute(statement)
            own = sa.select(sa.func.count()).select_from(LOCK).where(*self._row)
            return bool(connection.scalar(own))

    def _is_still(self, holder: Holder) -> bool:
        """Return whether a holder has sent no heartbeat for `SILENCE` while this one waited.

        The clock of a holder on another machine may be ahead.
        """
        beat = holder.token, holder.heartbeat
        if beat != self._last_beat:
            self._last_beat, self._since = beat, time.monotonic()
        return time.monotonic() - self._since > SILENCE

    def _beat(self) -> None:
        while not self._stop.wait(HEARTBEAT):
            try:
                with self._database.transaction() as connection:
                    connection.execute(
                        sa.update(LOCK).where(*self._row).values(heartbeat=self._database.clock())
                    )
            except CatalogError:
                # The disk is busy or full: the next write reports it; the next beat may succeed.
                continue

    def _refusal(self) -> CatalogError:
        """Return the error of a process that does not get the lock; it names the holder."""
        return UnavailableError(
            self.held_by() or "another run holds the catalog",
            file=self._database.place,
            remedy=f"stop it, or wait for it with --wait SECONDS: after {SILENCE:.0f} s without a"
            " sign of life it is overtaken",
        )


def _machine() -> str:
    """Return host, boot and process namespace, within which a process number is unique."""
    try:
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115 - the target is no path
    except OSError:
        namespace = ""
    return ":".join(
        (socket.gethostname(), _text_of_file("/proc/sys/kernel/random/boot_id"), namespace)
    )


def process_start(process: int) -> str:
    """Return when a process started, in units of its system; empty without one or without /proc."""
    # The program name, in brackets, may hold blanks.
    fields = _text_of_file(f"/proc/{process}/stat").rpartition(")")[2].split()
    return fields[19] if len(fields) > 19 and fields[0] != "Z" else ""


def _text_of_file(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""

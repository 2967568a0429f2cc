"""Do the work of one scene, so that whatever fails ends that scene only."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self, TypeVar

from lidarops.errors import (
    CatalogError,
    LidarOpsError,
    ProductError,
    SceneError,
    UnreadableFileError,
)
from lidarops.records import Plan, Scene, SceneOutcome
from lidarops.system.stores import without_keys

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Failure:
    """Why the work of a scene failed."""

    error: str
    internal: str = ""
    """Traceback of a bug of lidarops; else empty."""
    final: bool = True
    """Whether a retry would fail in the same way: no disk, network or memory was at fault."""

    @classmethod
    def of_bug(cls, error: BaseException, *, final: bool = True) -> Self:
        """Return the internal error that an exception means."""
        words = _storable("".join(traceback.format_exception_only(error)).strip())
        return cls(
            f"internal error: {words} (a bug of lidarops, not of the data)",
            _storable("".join(traceback.format_exception(error))),
            final,
        )

    def outcome(self, scene: Scene, plan: Plan | None) -> SceneOutcome:
        """Return the outcome of a scene that gave no product."""
        return SceneOutcome(
            scene=scene.id,
            station=scene.station,
            instrument=scene.instrument,
            start=scene.start,
            granules=len(scene.granules),
            plan=plan,
            error=self.error,
            internal=self.internal,
        )


def guarded(work: Callable[[], T]) -> T | Failure:
    """Return the result of some work on a scene, or why it failed: by bad data or by a bug."""
    try:
        return work()
    except LidarOpsError as error:
        passing = isinstance(error, CatalogError | ProductError | UnreadableFileError)
        may_pass = passing and not error.wrong_use
        return Failure(str(error), final=not may_pass)
    except MemoryError as error:
        return Failure(str(_too_large(error)), final=False)
    except Exception as error:  # noqa: BLE001 - a bug in one scene must not stop the others
        # A disk may have failed where its error is not expected.
        return Failure.of_bug(error, final=not isinstance(error, OSError))


def _storable(text: str) -> str:
    """Return a text without keys, and with escapes for what a database cannot hold."""
    return without_keys(text).encode("utf-8", "backslashreplace").decode().replace("\0", r"\0")


def _too_large(error: MemoryError) -> SceneError:
    return SceneError(
        f"the scene does not fit in memory: {error or 'no memory left'}",
        remedy="process fewer profiles at a time with a smaller --profiles-per-chunk, or give each"
        " process more memory",
    )

"""What a run did otherwise than the runs before it, from their records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lidarops.errors import CatalogError
from lidarops.figures.wording import counted
from lidarops.records import ProductRecord, RunRecord
from lidarops.reports.run_record import FILE_NAME, load_run_record

_LOOK_BACK: Final = 20
"""Most earlier runs that are read."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Comparison of a run with those before it."""

    previous: str
    """Identifier of the run before; empty for the first."""
    sentences: tuple[str, ...]
    newly_refused: tuple[str, ...] = ()


def difference(record: RunRecord, folder: Path) -> Difference:
    """Compare a run with the earlier runs whose reports are beside its own.

    Parameters
    ----------
    record : RunRecord
    folder : Path
        Report folder of the run. Records that cannot be read are passed over.
    """
    earlier = list(_earlier(record, folder))
    if not earlier:
        return Difference("", ("This is the first run with a report here.",))
    known: dict[str, ProductRecord] = {}
    for other in earlier:
        for scene in other.scenes:
            for product in scene.products:
                known.setdefault(product.path, product)
    new = same = changed = 0
    for scene in record.scenes:
        for product in scene.products:
            old = known.get(product.path)
            if old is None:
                new += 1
            elif old.sha256 == product.sha256:
                same += 1
            else:
                changed += 1
    before, now = _refused(earlier[:1]), _refused([record])
    newly = tuple(sorted(now - before))
    made = f"{counted(new, 'product')} new, {changed:,} with other content"
    words = [
        f"{made}, {same:,} made again with the same content",
        f"{counted(len(newly), 'file')} newly refused, {len(before - now):,} no longer refused",
    ]
    failed = _failed(record) - _failed(earlier[0])
    if failed:
        words.append(f"newly failed: {', '.join(sorted(failed))}")
    return Difference(earlier[0].id, tuple(f"{w}." for w in words), newly)


def _earlier(record: RunRecord, folder: Path) -> Iterator[RunRecord]:
    """Yield earlier runs of the same campaign, the newest first."""
    # The names of runs begin with their time.
    folders = sorted((f for f in folder.parent.iterdir() if f.name < folder.name), reverse=True)
    for other in folders[:_LOOK_BACK]:
        if (other / FILE_NAME).is_file():
            try:
                earlier = load_run_record(other)
            except CatalogError:
                continue
            if earlier.campaign == record.campaign and earlier.started < record.started:
                yield earlier


def _refused(records: Sequence[RunRecord]) -> set[str]:
    return {
        granule.path
        for record in records
        for granule in (*record.refused, *(g for scene in record.scenes for g in scene.refused))
    }


def _failed(record: RunRecord) -> set[str]:
    return {scene.scene for scene in record.scenes if scene.error}

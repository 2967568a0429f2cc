"""What a run did otherwise than the run before it, from their records."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path

from lidarops.errors import CatalogError
from lidarops.figures.wording import counted
from lidarops.records import Grade, ProductRecord, RunRecord
from lidarops.reports.run_record import FILE_NAME, load_run_record


@dataclass(frozen=True, slots=True)
class RunDifference:
    """Comparison of a run with the one before it."""

    previous: str
    """Identifier of the run before; empty for the first, and where it cannot be read."""
    sentences: tuple[str, ...]
    newly_refused: tuple[str, ...] = ()


class _Fate(Enum):
    """What a run made of a product."""

    NEW = auto()
    """Made for the first time, or again where the file of a first version was missing."""
    SAME = auto()
    CHANGED = auto()
    UNCOMPARED = auto()
    """Made again, while the file that it replaces was missing or altered."""


def difference(record: RunRecord, folder: Path) -> RunDifference:
    """Compare products with the files that they replace, the rest with the run before.

    Parameters
    ----------
    record : RunRecord
    folder : Path
        Report folder of the run. Those of earlier runs are beside it.
    """
    fates = Counter(_fate(product) for scene in record.scenes for product in scene.products)
    uncompared = fates[_Fate.UNCOMPARED]
    counts = (
        (fates[_Fate.NEW], "new"),
        (fates[_Fate.CHANGED], "with other content"),
        (fates[_Fate.SAME], "made again with the same content"),
        (uncompared, "made again without a file to compare with"),
    )
    made = [(count, words) for count, words in counts if count] or [(0, "made")]
    products = f"{counted(made[0][0], 'product')} {made[0][1]}"
    products += "".join(f", {count:,} {words}" for count, words in made[1:]) + "."
    if record.frozen:
        products += (
            f" {counted(len(record.frozen), 'product')} of frozen periods would be replaced."
        )
    try:
        before = _before(record, folder)
    except CatalogError:
        return RunDifference("", (products, "The report of the run before cannot be read."))
    if before is None:
        return RunDifference("", (products, "This is the first run with a report here."))
    then, now = _refused(before), _refused(record)
    newly = tuple(sorted(now - then))
    words = [
        products,
        f"{counted(len(newly), 'file')} newly refused, {len(then - now):,} no longer refused.",
    ]
    failed = _failed(record) - _failed(before)
    if failed:
        words.append(f"newly failed: {', '.join(sorted(failed))}.")
    return RunDifference(before.id, tuple(words), newly)


def _fate(product: ProductRecord) -> _Fate:
    if product.change is None:
        return _Fate.NEW if product.stamp.version == 1 else _Fate.UNCOMPARED
    return _Fate.SAME if product.change.grade is Grade.NONE else _Fate.CHANGED


def _before(record: RunRecord, folder: Path) -> RunRecord | None:
    """Return the record of the last earlier run of the same campaign; None without any."""
    # The names of runs begin with their time.
    earlier = sorted((f for f in folder.parent.iterdir() if f.name < folder.name), reverse=True)
    for other in earlier:
        if (other / FILE_NAME).is_file():
            before = load_run_record(other)
            if before.campaign == record.campaign and before.started < record.started:
                return before
    return None


def _refused(record: RunRecord) -> set[str]:
    return {
        granule.path
        for granule in (*record.refused, *(g for scene in record.scenes for g in scene.refused))
    }


def _failed(record: RunRecord) -> set[str]:
    return {scene.scene for scene in record.scenes if scene.error}

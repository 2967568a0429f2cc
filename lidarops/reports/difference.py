"""What a run did otherwise than the run before it, from their records."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

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


_FATES: Final = (
    "new",
    "with other content",
    "made again with the same content",
    "made again without a file to compare with",
)
"""What a run made of products, in the order of the report."""


def difference(record: RunRecord, folder: Path) -> RunDifference:
    """Compare products with the files that they replace, the rest with the run before.

    Parameters
    ----------
    record : RunRecord
    folder : Path
        Report folder of the run. Those of earlier runs are beside it.
    """
    fates = Counter(_fate(product) for scene in record.scenes for product in scene.products)
    made = [(fates[words], words) for words in _FATES if fates[words]] or [(0, "made")]
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


def _fate(product: ProductRecord) -> str:
    new, changed, same, uncompared = _FATES
    if product.change is None:
        # Made for the first time, or again where the file of a first version was missing.
        return new if product.stamp.version == 1 else uncompared
    return same if product.change.grade is Grade.NONE else changed


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

"""How a run is asked for, and what it came to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidarops.campaign.model import Campaign
from lidarops.catalog.ledger import RunStatus
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import Store
from lidarops.records import RunRecord, SceneOutcome, Unmet
from lidarops.reports import run_page, run_record
from lidarops.run.leftovers import Orphan

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[SceneOutcome], None]


@dataclass(frozen=True, slots=True)
class Options:
    """How to run; changes no result."""

    force: bool = False
    """Process what is asked for though it is fresh."""
    workers: int = 1
    """Processes of this machine, also where a cluster does the rest."""
    memory: str | None = None
    """Most memory of a worker that is started here, such as ``2GiB``."""
    cluster: Callable[[], AbstractContextManager[Client]] | None = None
    """Starts or reaches a cluster to run on instead; called only where something is stale."""
    wait: float = 0.0
    """s to wait for another run on the same catalog."""
    profiles_per_chunk: int | None = None
    progress: Progress | None = None
    """Called with the outcome of each scene as it ends."""
    expect: Callable[[int], None] | None = None
    """Called with numbers of granules that are found to be processed."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a run did, and how the archive stands after it."""

    record: RunRecord | None
    """None where there was nothing to do."""
    status: RunStatus
    summary: ScanSummary
    fresh: int
    """Products that were looked at and found fresh; those of days in which nothing at all changed
    are not counted."""
    orphans: tuple[Orphan, ...]
    failures: Mapping[str, str]
    """Scene -> error, of every scene whose last try failed."""
    empty: tuple[str, ...]
    """Scenes whose retrievals left nothing to use; what is found orphaned does not count."""
    barren: Mapping[str, str]
    """Scene -> why it can give no product."""
    set_aside: Mapping[str, str]
    """Path of a good granule that stands in no scene -> why."""
    untold: int = 0
    """More of both, on days in which nothing changed."""
    unmet: tuple[Unmet, ...] = ()
    """What is asked for, or told facts of, and not in the files; what no file holds first."""
    signal: int = 0
    """The signal that stopped the run."""

    @property
    def left_nothing(self) -> tuple[str, ...]:
        """Scenes whose retrievals left nothing to use: of the archive, and of this run's part."""
        scenes = () if self.record is None else self.record.scenes
        return tuple(dict.fromkeys((*self.empty, *(each.scene for each in scenes if each.empty))))

    @property
    def lost(self) -> Mapping[str, str]:
        """Products that are asked for, and of whose scene no raw file is left -> why."""
        return {each.path: each.reason for each in self.orphans if each.lost}

    @property
    def troubled(self) -> bool:
        """Whether anything was refused, failed or lost, in this run or before and still so."""
        return bool(
            self.summary.refused
            or self.failures
            or self.empty
            or self.barren
            or self.set_aside
            or self.untold
            or any(each.nowhere for each in self.unmet)
            or self.lost
            or self.status is not RunStatus.FINISHED
            or (self.record is not None and self.record.failed)
        )


def unreported(campaign: Campaign) -> str:
    """Say how to get the page of the last run, where its report was begun and is not there.

    So it is where the disk was full, or where the run was stopped while it drew.
    """
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        for last in store.runs(limit=1):
            folder = campaign.report_root / last.id
            if folder.is_dir() and not (folder / run_page.INDEX).exists():
                told = "the page of the last run is missing"
                if (folder / run_record.FILE_NAME).exists():
                    return f"{told}: lidarops report {folder}"
                return f"{told}, and its record: lidarops reprocess --force makes others"
    return ""

"""Options of a run, and its result."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog import versions
from lidarops.catalog.ledger import RunStatus
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import Store
from lidarops.records import Findings, RunRecord, SceneOutcome
from lidarops.reports import run_record

if TYPE_CHECKING:
    from distributed import Client

    from lidarops.run.leftovers import Orphan

Progress = Callable[[SceneOutcome], None]
NO_USABLE_VALUE: Final = "its retrievals gave no usable value"


@dataclass(frozen=True, slots=True)
class Options:
    """How to run; affects no product."""

    force: bool = False
    """Process everything selected, also what is fresh."""
    thaw: bool = False
    """Replace products of frozen periods, too."""
    workers: int = 1
    """Local processes; they scan and report also if a cluster processes the scenes."""
    memory: str | None = None
    """Memory limit of this process, or of a local worker, such as ``2GiB``."""
    cluster: Callable[[], AbstractContextManager[Client]] | None = None
    """Starts or reaches a cluster to run on instead; called only if something is stale."""
    wait: float = 0.0
    """s to wait for another run on the same catalog."""
    profiles_per_chunk: int | None = None
    journal: bool = False
    """Note each scene in the report folder as it ends, for the report of a run that is killed."""
    progress: Progress | None = None
    """Called with the outcome of each scene as it ends."""
    expect: Callable[[int], None] | None = None
    """Called with the number of granules of each group of stale scenes before processing."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a run did, and the state of the archive after it."""

    record: RunRecord | None
    """None if there was nothing to do."""
    status: RunStatus
    summary: ScanSummary
    failures: Mapping[str, str]
    """Scene -> error, of every scene whose last try failed."""
    internal: Mapping[str, str]
    """Scene -> traceback, of those that ended with an internal error: a bug of lidarops."""
    unusable: tuple[str, ...]
    """Scenes whose retrievals gave no usable value; orphaned products do not count."""
    empty_scenes: Mapping[str, str] = field(default_factory=dict)
    """Scene -> why it can give no product."""
    set_aside: Mapping[str, str] = field(default_factory=dict)
    """Path of a good granule that belongs to no scene -> why."""
    orphans: tuple[Orphan, ...] = ()
    more_unused: int = 0
    """Number of further empty scenes and granules set aside, on unchanged days."""
    frozen: Mapping[str, str] = field(default_factory=dict)
    """Product of a frozen period that would be replaced -> why."""
    findings: Findings = field(default_factory=Findings)
    signal: int = 0
    """The signal that stopped the run."""

    @property
    def failed_scenes(self) -> Mapping[str, str]:
        """Scene -> error, now or since an earlier run, without internal errors."""
        return self._errors(internal=False)

    @property
    def internal_errors(self) -> Mapping[str, str]:
        """Scene -> internal error, now or since an earlier run."""
        return self._errors(internal=True)

    def _errors(self, *, internal: bool) -> Mapping[str, str]:
        scenes = () if self.record is None else self.record.scenes
        errors = {**self.failures, **{scene.scene: scene.error for scene in scenes if scene.error}}
        return {
            scene: error for scene, error in errors.items() if (scene in self.internal) is internal
        }

    @property
    def unusable_scenes(self) -> tuple[str, ...]:
        """Scenes whose retrievals gave no usable value: of the archive, and of this run."""
        scenes = () if self.record is None else self.record.scenes
        return tuple(
            dict.fromkeys((*self.unusable, *(scene.scene for scene in scenes if scene.unusable)))
        )

    @property
    def lost(self) -> Mapping[str, str]:
        """Requested products of whose scene no raw file is left -> why."""
        return {orphan.path: orphan.reason for orphan in self.orphans if orphan.lost}

    @property
    def has_failures(self) -> bool:
        """Whether anything is refused, failed, empty or lost, now or since an earlier run."""
        return bool(
            self.summary.refused
            or self.failures
            or self.unusable
            or self.empty_scenes
            or self.set_aside
            or self.more_unused
            or self.findings.failed
            or self.lost
            or self.status is not RunStatus.FINISHED
            or (self.record is not None and self.record.failed)
        )


def missing_report(campaign: Campaign) -> str:
    """Return how to get the missing report page of the last run; empty if it is not missing.

    The page is missing if the disk was full or the run was stopped while it drew.
    """
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        for last in store.runs(limit=1):
            folder = campaign.report_root / last.id
            if not folder.is_dir() or (folder / run_record.INDEX).exists():
                return ""
            problem = "the report page of the last run is missing"
            if run_record.exists(folder):
                return f"{problem}; make it with: lidarops report {folder}"
            return f"{problem}, and so is its record; lidarops reprocess --force makes new ones"
    return ""


def is_littered(campaign: Campaign, store: Store) -> bool:
    """Return whether there are temporary files that no run writes and this one may remove."""
    files = versions.temporary_files(Path(campaign.output))
    if store.in_use() or store.others_at_work():
        return False
    return any(os.access(file.parent, os.W_OK) for file in files)

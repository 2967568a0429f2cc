"""Bring an archive up to date: catalog, plan, process, report.

The command line and the Prefect flows call these functions and add no logic of their own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog import product_files
from lidarops.catalog.lock import Lock, OvertakenError
from lidarops.catalog.raw_files import acknowledged
from lidarops.catalog.scan import ScanSummary, scan_archive
from lidarops.catalog.store import RunStatus, Store, Verdict
from lidarops.errors import LidarOpsError
from lidarops.records import Findings, Granule, RunRecord
from lidarops.reports import run_record
from lidarops.run.day_states import DayStates, Signature
from lidarops.run.findings import find
from lidarops.run.options import (
    NO_USABLE_VALUE,
    Options,
    Result,
    Selection,
    check_selection,
    unused,
)
from lidarops.system.files import only_one
from lidarops.system.processes import objects_frozen

if TYPE_CHECKING:
    from lidarops.reports.run_page import RunReport
    from lidarops.run.staleness import Judgement

__all__ = [
    "Options",
    "Result",
    "Selection",
    "assess",
    "bring_up_to_date",
    "refused_files",
    "remove_orphans",
    "report_earlier_runs",
    "report_run",
    "reprocess",
    "survey",
    "update_catalog",
]


MOST_RUNS_REPORTED: Final = 20
"""Last runs whose missing reports are made; older ones are left to ``lidarops report``."""
PAGE_LOCK: Final = ".index.lock"
"""File in the folder of a report that is locked while its page is built."""


_LOG = logging.getLogger(__name__)


def reprocess(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    options: Options | None = None,
) -> RunRecord | None:
    """Do what `bring_up_to_date` does, and return the record; None if there was nothing to do."""
    return bring_up_to_date(campaign, selection=selection, options=options).record


def bring_up_to_date(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    options: Options | None = None,
) -> Result:
    """Bring catalog and products up to date: make all stale products, and nothing else.

    Nothing is written if there is nothing to do.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        What to process; default everything.
    options : Options, optional

    Returns
    -------
    Result
        What the run did, and the state of the archive after it.

    Raises
    ------
    CampaignError
        If the selection names something unknown.
    CatalogError
        If archive or catalog cannot be used, or another run holds the catalog.
    SceneError
        If the cluster is lost.
    """
    selection = selection or Selection()
    options = options or Options()
    check_selection(campaign, selection)
    with (
        Store(campaign.catalog_url, campaign.name) as store,
        Lock(store, wait=options.wait) as lock,
        objects_frozen(),
    ):
        # "Nothing to do" would not count what another run is about to do.
        lock.wait_for(lambda: not lock.is_taken())
        while True:
            try:
                return _pass(DayStates(campaign, store, selection), lock, options)
            except OvertakenError:
                _LOG.info("another run has ended: judging again")


def assess(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    everything: bool = False,
    update: bool = True,
    force: bool = False,
    thaw: bool = False,
    set_aside: list[Granule] | None = None,
) -> Iterator[Judgement]:
    """Judge what every scene needs, and why. Processes nothing.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        What to process; default everything.
    everything : bool
        Whether to yield also scenes that need nothing.
    update : bool
        Whether to update the catalog first.
    force, thaw : bool
        As of `Options`.
    set_aside : list of Granule, optional
        Takes the good files that belong to no scene, with the reason.

    Yields
    ------
    Judgement
    """
    selection = selection or Selection()
    check_selection(campaign, selection)
    if update:
        update_catalog(campaign)
    from lidarops.run.staleness import Judge  # noqa: PLC0415 - loads the numerics

    with Store(campaign.catalog_url, campaign.name) as store:
        judge = Judge(campaign, store, selection=selection, force=force, thaw=thaw)
        known = store.verdicts()
        days = _days_to_judge(judge, judge.signatures(), known, everything=everything or force)
        months = set(judge.months(days)).intersection(days)
        # Months last: by then it is known which of their products are to be made.
        for part in (days, sorted(months)):
            for told in map(judge.days, judge.batches(part)):
                if set_aside is not None:
                    set_aside += acknowledged(campaign, told.set_aside)
                for judged in told.judgements:
                    asked = everything or judged.due or judged.held or judged.frozen or judged.kept
                    if asked and bool(judged.scene.granules) == (part is days):
                        yield judge.explained(judged)


def survey(
    campaign: Campaign, *, selection: Selection | None = None, wait: float = 0.0
) -> Findings:
    """Update the catalog, and return where the archive is not what the campaign states.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        Limits the findings to its instruments, kinds and times; default everything.
    wait : float
        s to wait for another run on the same catalog.
    """
    selection = selection or Selection()
    check_selection(campaign, selection)
    summary = update_catalog(campaign, wait=wait)
    from lidarops.run.leftovers import find_lost  # noqa: PLC0415 - loads the numerics

    with Store(campaign.catalog_url, campaign.name) as store:
        states = DayStates(campaign, store, selection)
        return find(states, summary.idle_patterns, lost=find_lost(campaign, store))


def earlier_problems(
    campaign: Campaign, selection: Selection
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the selected scenes that failed, and those that gave no usable value, with reasons.

    As they were last processed; a catalog must exist.
    """
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        found = store.failures(), dict.fromkeys(store.unusable_scenes(), NO_USABLE_VALUE)
    failed, unusable = (
        {scene: why for scene, why in scenes.items() if selection.scene(scene, campaign)}
        for scenes in found
    )
    return failed, unusable


def update_catalog(
    campaign: Campaign,
    *,
    progress: Callable[[int], None] | None = None,
    wait: float = 0.0,
    workers: int = 1,
) -> ScanSummary:
    """Update the catalog from the archive; see `lidarops.catalog.scan.scan_archive`."""
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        while True:
            try:
                return scan_archive(
                    campaign,
                    store,
                    progress=progress,
                    before_write=lock.acquire_unchanged,
                    workers=workers,
                )
            except OvertakenError:
                continue


def _days_to_judge(
    states: DayStates,
    signatures: Mapping[int, Signature],
    verdicts: Mapping[int, Verdict],
    *,
    everything: bool,
) -> list[int]:
    changed = [
        day
        for day, now in signatures.items()
        if everything or not states.is_settled(now, verdicts.get(day))
    ]
    return states.selection.days(sorted({*changed, *states.months(changed)}))


def _pass(states: DayStates, lock: Lock, options: Options) -> Result:
    """Update the catalog, and do what the days that changed need."""
    campaign, store, write = states.campaign, states.store, lock.acquire_unchanged
    summary = scan_archive(campaign, store, before_write=write, workers=options.workers)
    signatures, verdicts = states.signatures(), store.verdicts()
    days = _days_to_judge(states, signatures, verdicts, everything=options.force)
    if days or _is_something_left(states, signatures):
        from lidarops.run.processing import Pass  # noqa: PLC0415 - loads the numerics

        work = Pass(states, lock, options, summary, days, signatures, verdicts)
        return work.carry_out()
    empty_scenes, set_aside = unused(verdicts, signatures)
    return Result(
        record=None,
        status=RunStatus.FINISHED,
        summary=summary,
        failures=store.failures(),
        internal=store.failures(internal=True),
        unusable=tuple(store.unusable_scenes()),
        empty_scenes=empty_scenes,
        set_aside=set_aside,
        findings=find(states, summary.idle_patterns, settled=verdicts),
        refused=acknowledged(campaign, states.all_refused),
    )


def _is_something_left(states: DayStates, signatures: Mapping[int, Signature]) -> bool:
    """Return whether a run must forget, remove or tell something though no day has changed."""
    campaign, store = states.campaign, states.store
    return (
        bool(campaign.acknowledged)
        or bool(store.scenes_of_other_days(signatures))
        or store.has_dead_run()
        or product_files.is_littered(Path(campaign.output), store)
    )


def refused_files(result: Result) -> Sequence[Granule]:
    """Return the files refused by the catalog or by a scene, and of a run those in no scene."""
    if result.record is None:
        return result.refused
    late = (granule for scene in result.scenes for granule in scene.refused)
    return list({granule.path: granule for granule in (*result.record.refused, *late)}.values())


def remove_orphans(campaign: Campaign, result: Result, *, wait: float = 0.0) -> int:
    """Remove products that the campaign no longer requests: files and ledger rows.

    Products stay if another run has made them again since, or if the campaign still requests them
    although the present files of their scene do not allow them, or their raw files are lost.

    Parameters
    ----------
    campaign : Campaign
    result : Result
        Of the run that listed them.
    wait : float
        s to wait for another run on the same catalog.

    Returns
    -------
    int
        Number of files removed.

    Raises
    ------
    CatalogError
        If another run holds the catalog.
    """
    # A requested product is kept, unless its file was removed by hand.
    removable = [
        orphan
        for orphan in result.orphans
        if not (orphan.requested and (campaign.products_root / orphan.path).exists())
    ]
    if not removable:
        return 0
    removed = 0
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        lock.acquire()
        with store.all_products() as made:
            runs = {product.path: product.run for product in made}
        paths = [orphan.path for orphan in removable if runs.get(orphan.path) == orphan.product.run]
        for name in paths:
            path = campaign.products_root / name
            removed += path.exists()
            path.unlink(missing_ok=True)
        store.forget_products(paths, lock.token)
    return removed


def report_run(campaign: Campaign, run: RunRecord, *, workers: int = 1) -> RunReport:
    """Save the record of a run, unless the run has, and build its report page.

    While another process builds it, this one waits.

    Parameters
    ----------
    campaign : Campaign
    run : RunRecord
    workers : int, optional
        Largest number of local processes that read products and draw; does not affect the page.

    Returns
    -------
    Report
    """
    folder = campaign.report_root / run.id
    if not (folder / run_record.FILE_NAME).exists():
        run_record.save_run_record(run, folder)
    with only_one(folder / PAGE_LOCK, wait=True):
        return _build_page(run, folder, workers)


def _build_page(run: RunRecord, folder: Path, workers: int) -> RunReport:
    from lidarops.reports import run_page  # noqa: PLC0415 - loads what draws

    return run_page.build_report(run, folder, workers=workers)


def report_earlier_runs(campaign: Campaign, *, without: str = "", workers: int = 1) -> list[Path]:
    """Build the missing report pages of runs that were killed or met a full disk; return them.

    A record that cannot be read, and a page that cannot be made, is logged and left. So is a page
    that another process builds.

    Parameters
    ----------
    campaign : Campaign
        A catalog must exist.
    without : str, optional
        Id of a run that is left out.
    workers : int, optional
    """
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        runs = store.runs(limit=MOST_RUNS_REPORTED)
    pages = []
    for run in runs:
        folder = campaign.report_root / run.id
        if run.id == without or run.status is RunStatus.RUNNING or not _lacks_page(folder):
            continue
        try:
            with only_one(folder / PAGE_LOCK, wait=False):
                # Another process may have built it before.
                if _lacks_page(folder):
                    record = run_record.load_run_record(folder)
                    run_record.save_run_record(record, folder)
                    pages.append(_build_page(record, folder, workers).page)
        except BlockingIOError:
            _LOG.info("the report of run %s is being built by another process", run.id)
        except LidarOpsError as error:
            _LOG.warning("run %s has no report: %s", run.id, error)
    return pages


def _lacks_page(folder: Path) -> bool:
    """Return whether a run has a record and no page."""
    return run_record.exists(folder) and not (folder / run_record.INDEX).exists()

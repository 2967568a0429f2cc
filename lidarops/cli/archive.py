"""Commands that work on the archive of a campaign: catalog, plan, reprocess."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import asdict, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidarops.cli import options
from lidarops.cli.app import (
    NO_SCENE,
    Table,
    command,
    exit_with_status,
    finding_tables,
    findings_document,
    from_here,
    loaded_campaign,
    never_made,
    progress_bar,
    say,
    say_wrapped,
    selection_of,
    set_up_log,
    show_error,
    show_rows,
    show_tables,
)
from lidarops.cli.plan import Shown, show_scenes
from lidarops.errors import UNAVAILABLE, LidarOpsError
from lidarops.records import Grade, without_numbers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from contextlib import AbstractContextManager

    from distributed import Client

    from lidarops.campaign.model import Campaign
    from lidarops.records import (
        Granule,
        ProductRecord,
        RunRecord,
        SceneOutcome,
    )
    from lidarops.run.archive import Result

_MANY_FILES = 20
"""Most rows of each table of a catalog, without --all."""
_LINES = 45
"""Lines in the tables of a run, without --all."""
_FEW = 8
"""Lines about removed products, without --all."""
_FEW_FLAGS = 4
"""Flags that a sum of products names."""
_LEAST_MEMORY = 2**20
"""Bytes; a smaller size probably lacks its unit."""


def _size(text: str | None) -> str | None:
    """Refuse an invalid size before the archive is scanned, which may take an hour."""
    if text is None:
        return None
    from dask.utils import parse_bytes

    try:
        size = parse_bytes(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is not a size such as 2GiB") from error
    if size < _LEAST_MEMORY:
        raise typer.BadParameter(
            f"{text!r} is too little for a worker: give a size with its unit, such as 2GiB"
        )
    return text


@command()
def catalog(
    campaign: options.Campaign = Path(),
    archive: options.Archive = None,
    out: options.Out = None,
    catalog: options.Catalog = None,
    workers: options.Workers = 1,
    wait: options.Wait = 0.0,
    rebuild: Annotated[
        bool,
        typer.Option(
            "--rebuild",
            help="Also enter products that the ledger lacks, from their own provenance.",
        ),
    ] = False,
    everything: Annotated[
        bool, typer.Option("--all", help="List every refused file and finding.")
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Create or update the catalog of the archive; list refused files, notes on files, and why.

    Example: lidarops catalog catalogs/demo.yaml

    Example: lidarops catalog catalogs/demo.yaml --rebuild
    """
    from lidarops.catalog.raw_files import acknowledged
    from lidarops.catalog.store import Store
    from lidarops.records import Findings
    from lidarops.run.archive import update_catalog
    from lidarops.run.day_states import ChannelNames

    settings = loaded_campaign(campaign, archive, out, catalog)
    with progress_bar("catalog") as bar:
        summary = update_catalog(settings, progress=bar.advance, wait=wait, workers=workers)
        rebuilt = None
        if rebuild:
            from lidarops.run.ledger_run import rebuild_ledger

            rebuilt = rebuild_ledger(settings, wait=wait, progress=bar.advance)
    with Store(settings.catalog_url, settings.name) as store:
        refused = acknowledged(settings, store.refused())
        own = settings.instruments
        notes = (*store.file_notes(own), *ChannelNames(settings, store).notes(own))
    findings = Findings(file_notes=notes, idle_patterns=summary.idle_patterns)
    if as_json:
        reasons = [{"path": granule.path, "reason": granule.reason} for granule in refused]
        numbers = asdict(summary)
        del numbers["idle_patterns"]
        document = {**numbers, "refused_files": reasons, **findings_document(findings)}
        if rebuilt is not None:
            document["rebuilt"] = asdict(rebuilt)
        typer.echo(json.dumps(document, indent=2))
    else:
        most = None if everything else _MANY_FILES
        show_tables([_refused_table(refused), *finding_tables(findings)], most, _LINES)
        declared = sum(granule.is_expected for granule in refused)
        say(
            f"{summary.files} files: {summary.added} added, {summary.changed} changed,"
            f" {summary.moved} moved, {summary.unchanged} unchanged, {summary.vanished} vanished,"
            f" {summary.refused} refused"
            + (f", {declared} declared invalid or acknowledged" if declared else "")
        )
        if rebuilt is not None:
            show_rows("Not entered in the ledger", ("file", "reason"), rebuilt.problems.items())
            say(
                f"{rebuilt.entered} products entered in the ledger, {rebuilt.without_scene} of them"
                " of no present scene (raw files gone, or scenes cut otherwise);"
                f" {rebuilt.known} known before"
            )
    failed = bool(summary.refused) or findings.failed or bool(rebuilt and rebuilt.problems)
    exit_with_status(failed=failed)


@command()
def reprocess(
    campaign: options.Campaign = Path(),
    archive: options.Archive = None,
    out: options.Out = None,
    catalog: options.Catalog = None,
    instrument: options.Instruments = None,
    station: options.Stations = None,
    product: options.Products = None,
    since: options.Since = None,
    until: options.Until = None,
    force: Annotated[
        bool, typer.Option("--force", help="Process everything selected, even what is fresh.")
    ] = False,
    thaw: Annotated[
        bool, typer.Option("--thaw", help="Replace products of frozen periods, too.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of worker processes; default 1.")
    ] = None,
    scheduler: options.Scheduler = None,
    tls: Annotated[
        tuple[Path, Path, Path] | None,
        typer.Option(
            "--tls",
            help="Certificate of the authority, own certificate and own key, for --scheduler.",
        ),
    ] = None,
    cluster: options.Cluster = None,
    memory_limit: Annotated[
        str | None,
        typer.Option(
            "--memory-limit",
            help="Memory limit of each process, such as 2GiB; scenes are read in chunks that fit.",
            callback=_size,
        ),
    ] = None,
    wait: options.Wait = 0.0,
    remove_orphans: Annotated[
        bool,
        typer.Option(
            "--remove-orphans",
            help="Remove products that would not be made again: no longer requested, or without"
            " raw files.",
        ),
    ] = False,
    profiles_per_chunk: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Profiles that are processed together, whatever the limit; affects no result.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only show what would be made, and why.")
    ] = False,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Serve the pages of dask, to this machine only.")
    ] = False,
    everything: Annotated[
        bool, typer.Option("--all", help="List every product, file and finding.")
    ] = False,
    all_steps: options.AllSteps = False,
    log_level: Annotated[
        str, typer.Option(help="debug, info, warning or error.", metavar="LEVEL")
    ] = "warning",
    log_json: Annotated[
        bool, typer.Option("--log-json", help="Write one JSON object per log line.")
    ] = False,
    log_file: Annotated[
        Path | None, typer.Option(help="Append the log to this file instead of standard error.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Update the catalog, make all stale products, and write a report.

    Prints a line for each kind and channel, with the setting that most rejected values follow from.
    Writes nothing if there is nothing to do. Exit code 1 if anything was refused or failed, 3 if
    products could not be written, or a database, a store or a cluster does not serve.

    Example: lidarops reprocess catalogs/demo.yaml --workers 2
    """
    from lidarops.catalog.store import RunStatus
    from lidarops.run import archive as pipeline
    from lidarops.run.options import selects_no_scene

    set_up_log(log_level, as_json=log_json, file=log_file)
    settings = loaded_campaign(campaign, archive, out, catalog, all_steps=all_steps)
    selection = selection_of(instrument, station, product, since, until)
    if dry_run:
        if remove_orphans:
            raise typer.BadParameter("--dry-run removes nothing: leave out --remove-orphans")
        stated = Shown(stale=True, everything=everything, as_json=as_json, force=force, thaw=thaw)
        show_scenes(settings, selection, stated, wait=wait)
        return
    connect = _cluster(workers, scheduler, tls, cluster, memory_limit)
    with progress_bar("reprocess") as bar:
        chosen = pipeline.Options(
            force=force,
            thaw=thaw,
            workers=workers or 1,
            memory=memory_limit,
            cluster=connect,
            wait=wait,
            profiles_per_chunk=profiles_per_chunk,
            journal=True,
            dashboard=partial(typer.echo, err=True) if dashboard else None,
            progress=lambda outcome: bar.advance(outcome.granules),
            expect=bar.grow,
        )
        result = pipeline.bring_up_to_date(settings, selection=selection, options=chosen)
    no_scene = result.record is None and selects_no_scene(settings, selection)
    if not as_json:
        _print_result(
            settings, result, no_scene=no_scene, removing=remove_orphans, everything=everything
        )
    page, removed = None, None
    earlier: list[Path] = []
    try:
        if result.record is not None:
            page = _page(settings, result.record, chosen.workers)
        own = "" if result.record is None else result.record.id
        earlier = pipeline.report_earlier_runs(settings, without=own, workers=chosen.workers)
        if remove_orphans:
            removed = pipeline.remove_orphans(settings, result, wait=wait)
    finally:
        # The result is printed even if the page or the removal failed.
        if as_json:
            summary = _run_summary(result, page)
            summary |= {"no_scene_selected": no_scene, "removed": removed or 0}
            summary |= {"earlier_reports": [str(made) for made in earlier]}
            typer.echo(json.dumps(summary, indent=2))
        else:
            _print_places(result, page, earlier)
    if removed is not None and not as_json:
        most = None if everything else _FEW
        show_tables([_orphan_table(result, f"{removed} removed")], most, _FEW)
    if result.signal:
        raise typer.Exit(128 + result.signal)
    # A page fails by the disk alone.
    if result.status is RunStatus.STOPPED or (result.record is not None and page is None):
        raise typer.Exit(UNAVAILABLE)
    left = result if removed is None else replace(result, orphans=())
    exit_with_status(failed=left.has_failures)


def _page(campaign: Campaign, run: RunRecord, workers: int) -> Path | None:
    """Build the report page of a run; if that fails, show the error and return None."""
    from lidarops.run.archive import report_run

    try:
        return report_run(campaign, run, workers=workers).page
    except LidarOpsError as error:
        show_error(error)
        return None


def _cluster(
    workers: int | None,
    scheduler: str | None,
    tls: tuple[Path, Path, Path] | None,
    cluster: str | None,
    memory: str | None,
) -> Callable[[], AbstractContextManager[Client]] | None:
    """Return a function that connects to the selected cluster; None for this machine."""
    if tls and scheduler is None:
        raise typer.BadParameter("--tls belongs to --scheduler; a cluster file has its own tls")
    if scheduler is None and cluster is None:
        return None
    from lidarops.run import clusters

    chosen = clusters.choose_cluster(
        workers=workers, scheduler=scheduler, cluster=cluster, memory=memory
    )
    if tls and isinstance(chosen, clusters.Scheduler):
        ca, certificate, key = tls
        files = clusters.Tls(ca=ca, certificate=certificate, key=key)
        chosen = chosen.model_copy(update={"tls": files})
    return partial(clusters.connect_client, chosen)


def _refused_table(refused: Iterable[Granule]) -> Table:
    rows = ((granule.path, granule.instrument, granule.reason) for granule in refused)
    return "Refused", ("file", "instrument", "reason"), _varied(rows)


def _varied(rows: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return rows that end with a reason, one of each kind first: tables may show few."""
    of_kind: dict[str, Iterator[int]] = defaultdict(count)
    return sorted(rows, key=lambda row: next(of_kind[without_numbers(row[-1])]))


def _run_summary(result: Result, page: Path | None) -> dict[str, Any]:
    from lidarops.run.archive import refused_files

    record, scenes = result.record, result.scenes
    products = [product for scene in scenes for product in scene.products]
    changes = {product.path: product.change for product in products if product.change is not None}
    refused = refused_files(result)
    return {
        "run": None if record is None else record.id,
        "status": result.status.value,
        "report": None if page is None else str(page),
        "scenes": len(scenes),
        "failed_scenes": dict(result.failed_scenes),
        "internal_errors": {
            scene: {"error": error, "traceback": result.internal[scene]}
            for scene, error in result.internal_errors.items()
        },
        "unusable_scenes": list(result.unusable_scenes),
        "refused_files": {granule.path: granule.reason for granule in refused},
        "products": [product.path for product in products],
        "quality": {product.path: product.verdicts._asdict() for product in products},
        "versions": {product.path: product.stamp.version for product in products},
        "changes": {path: change.as_dict() for path, change in changes.items()},
        "frozen_products": dict(result.frozen),
        "files_set_aside": dict(result.set_aside),
        "empty_scenes": dict(result.empty_scenes),
        **findings_document(result.findings),
        "disagreements": [
            {"scene": scene.scene, **asdict(pair)}
            for scene in scenes
            for pair in scene.disagreements
        ],
        "rejections": _rejections(scenes),
        "scene_notes": {scene.scene: list(scene.notes) for scene in scenes if scene.notes},
        "orphans": {each.path: each.reason for each in result.orphans if not each.requested},
        "kept_products": {each.path: each.reason for each in result.orphans if each.requested},
    }


def _print_places(result: Result, page: Path | None, earlier: Iterable[Path]) -> None:
    """Print where the report and the tracebacks of internal errors are."""
    from lidarops.figures.wording import counted

    if page is not None:
        say(f"report:   {from_here(page)}")
    if result.internal:
        on_page = page is not None and set(result.internal) <= {
            scene.scene for scene in result.scenes
        }
        scenes = counted(len(result.internal), "scene")
        place = page if on_page else "the output of the same command with --json"
        say(
            f"{scenes} ended with an internal error: please report it,"
            f" with the traceback in {place}"
        )
    for made in earlier:
        say(f"report of an earlier run: {made}")


def _print_result(
    campaign: Campaign, result: Result, *, no_scene: bool, removing: bool, everything: bool
) -> None:
    from lidarops.figures.wording import counted, listed

    scenes = result.scenes
    tables = _product_tables(scenes, everything=everything)
    found = _tables(result, removing=removing)
    show_tables((*tables, *found), None if everything else _LINES, _LINES, main=2)
    products = [product for scene in scenes for product in scene.products]
    same = sum(each.change is not None and each.change.grade is Grade.NONE for each in products)
    say_wrapped(f"{counted(same, 'product')} made again without a change" if same else "", "")
    empty = [product for product in products if product.usable == 0]
    if empty:
        names = listed({f"{product.kind} {product.channel}" for product in empty})
        words = f"products without a usable value, flags say why: {len(empty)} ({names})"
        say_wrapped(words, "")
    if no_scene:
        typer.echo(NO_SCENE)
    elif result.record is not None:
        ended = f" ({result.status.value})" if result.status != "finished" else ""
        place = from_here(campaign.products_root)
        say_wrapped(f"products: {place}{ended}{never_made(result.findings)}", "")
    else:
        state = "the archive is not what the campaign states, see above"
        if not result.findings.failed:
            state = "every requested product is fresh or cannot be made"
        say_wrapped(f"nothing to do: {state}{never_made(result.findings)}", "")


def _tables(result: Result, *, removing: bool) -> Iterator[Table]:
    """Yield what a run found, but its products: what changed, was not used, or has no value."""
    from lidarops.figures.wording import change_in_words
    from lidarops.reports.findings import disagreement_rows, scene_note_rows
    from lidarops.run.archive import refused_files
    from lidarops.run.options import NO_USABLE_VALUE

    scenes = result.scenes
    reason, problem = ("file", "reason"), ("scene", "problem")
    changes = (
        (product.path, change.grade.value, change_in_words(change), "; ".join(change.causes))
        for scene in scenes
        for product in scene.products
        for change in [product.change]
        if change is not None and change.grade is not Grade.NONE
    )
    yield "Products made again", ("file", "change", "difference", "cause"), changes
    title = "Frozen products that would be replaced (--thaw replaces them)"
    yield title, reason, result.frozen.items()
    refused = refused_files(result)
    yield _refused_table(refused)
    listed = {granule.path for granule in refused}
    set_aside = ((path, why) for path, why in result.set_aside.items() if path not in listed)
    unused = (*set_aside, *result.empty_scenes.items())
    yield "Not used", ("file or scene", "reason"), _varied(unused)
    yield from finding_tables(result.findings)
    for title, where, found in (
        ("Channels that disagree", "channels", disagreement_rows(scenes)),
        ("Not found in the data", "in", scene_note_rows(scenes)),
    ):
        rows = ((row.instrument, row.subject, row.problem) for row in found)
        yield title, ("instrument", where, "finding"), rows
    if not removing:
        yield _orphan_table(result, "kept; --remove-orphans removes them")
    kept = ((orphan.path, orphan.reason) for orphan in result.orphans if orphan.requested)
    yield "Requested products that could not be made again (kept)", reason, kept
    processed = {scene.scene for scene in scenes}
    unusable = dict.fromkeys(result.unusable_scenes, NO_USABLE_VALUE).items()
    now = [row for row in unusable if row[0] in processed]
    yield "Without a usable value", problem, now
    earlier = [row for row in (*result.failures.items(), *unusable) if row[0] not in processed]
    yield "From earlier runs, unchanged since", problem, earlier


def _orphan_table(result: Result, fate: str) -> Table:
    rows = ((orphan.path, orphan.reason) for orphan in result.orphans if not orphan.requested)
    return f"Products that would not be made again ({fate})", ("file", "reason"), rows


def _rejections(scenes: Sequence[SceneOutcome]) -> list[tuple[str, str, str, str]]:
    if not scenes:
        return []
    from lidarops.reports.rejections import rejection_rows

    return list(rejection_rows(scenes))


def _product_tables(scenes: Sequence[SceneOutcome], *, everything: bool) -> Iterator[Table]:
    """Yield sums of each kind and channel and what failed, and with `everything` each product.

    A sum ends with advice: the settings that most rejected values follow from.
    """
    from lidarops.figures.wording import counted

    made = [product for scene in scenes for product in scene.products]
    if everything:
        names = "scene", "kind", "channel", "values", "good", "care", "reject", "flags"
        yield "Products", names, (row for scene in scenes for row in _product_rows(scene))
    alike: dict[str, list[ProductRecord]] = defaultdict(list)
    for scene in scenes:
        for product in scene.products:
            alike[f"{product.kind} {product.channel} of {scene.instrument}"].append(product)
    advice: dict[str, str] = {}
    for name, flag, _, settings in _rejections(scenes):
        advice.setdefault(name, f"; check, because of {flag}: {settings}")
    yield (
        f"{counted(len(made), 'product')}, summed (--all lists them)",
        ("",),
        (
            (f"{name}: {_summed(products)}{advice.get(name, '')}",)
            for name, products in sorted(alike.items())
        ),
    )
    errors = ((scene.scene, scene.error) for scene in scenes if scene.error)
    yield "Failed", ("scene", "error"), errors


def _summed(products: Sequence[ProductRecord]) -> str:
    """Return totals, and the shares of good values, of others and of frequent flags, in words."""
    from lidarops.figures.wording import counted

    values = sum(product.values for product in products)
    flags: Counter[str] = Counter()
    for product in products:
        flags.update(product.flagged)
    counts = zip(
        ("good", "care", "reject"),
        (sum(each) for each in zip(*(product.verdicts for product in products), strict=True)),
        strict=True,
    )
    frequent = ((name.lower(), count) for name, count in flags.most_common(_FEW_FLAGS))
    shares = (
        ", ".join(f"{name} {count / max(values, 1):.0%}" for name, count in each)
        for each in (counts, frequent)
    )
    totals = f"{counted(len(products), 'product')}, {counted(values, 'value')}"
    return "; ".join(filter(None, (totals, *shares)))


def _product_rows(scene: SceneOutcome) -> Iterator[tuple[object, ...]]:
    for product in scene.products:
        flags = ", ".join(f"{name.lower()} {count}" for name, count in product.flagged.items())
        numbers = (product.values, *product.verdicts)
        yield scene.scene, product.kind, product.channel, *numbers, flags

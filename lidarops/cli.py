"""The command line: one function call a command.

Exit codes: 0 all well, 1 something was refused or failed, 2 wrong use.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, TypeVar

import typer

from lidarops.errors import CampaignError, LidarOpsError, RetrievalInputError

if TYPE_CHECKING:
    from rich.table import Table

    from lidarops.campaign import Campaign
    from lidarops.catalog.store import Store
    from lidarops.records import Granule, Plan, RunRecord
    from lidarops.scenes import Cut

app = typer.Typer(
    help="Reprocess archives of atmospheric lidar data into CF-compliant products.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

CampaignFile = Annotated[Path, typer.Argument(help="Campaign file (YAML).", metavar="CAMPAIGN")]
ArchiveOption = Annotated[
    str | None,
    typer.Option("--archive", help="Folder or URL of the raw files; wins over the campaign file."),
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder of catalog, products and reports; wins over the file."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
InstrumentOption = Annotated[
    list[str] | None, typer.Option("--instrument", help="Only this instrument; may be repeated.")
]
SinceOption = Annotated[
    datetime | None, typer.Option("--since", help="Only scenes that end after this UTC time.")
]
UntilOption = Annotated[
    datetime | None, typer.Option("--until", help="Only scenes that start before this UTC time.")
]

_P = ParamSpec("_P")
_R = TypeVar("_R")

WRONG_USE = 2
REFUSED = 1


def _plainly(command: Callable[_P, _R]) -> Callable[_P, _R]:
    """Show an error of ours as a sentence, not as a traceback."""

    @wraps(command)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            return command(*args, **kwargs)
        except LidarOpsError as error:
            typer.secho(f"error: {error}", fg="red", err=True)
            wrong_use = isinstance(error, CampaignError | RetrievalInputError)
            raise typer.Exit(WRONG_USE if wrong_use else REFUSED) from error

    return wrapped


@app.callback()
def _main(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from lidarops import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.command()
@_plainly
def simulate(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Processes.")] = 1,
) -> None:
    """Write a simulated campaign of raw Licel files, with its truth.

    Example: lidarops simulate catalogs/demo.yaml --workers 2
    """
    from contextlib import nullcontext

    from lidarops.campaign import load
    from lidarops.engine import local_client
    from lidarops.products.write import write_plain
    from lidarops.simulate.campaign import carry_out, plan

    settings = load(campaign, archive=archive, output=out)
    planned = plan(settings)
    cluster = nullcontext() if workers == 1 else local_client(workers)
    with _bar("simulate", len(planned.paths)) as advance, cluster as client:
        simulated = carry_out(planned, client=client, progress=advance)
    write_plain(simulated.truth, settings.truth_path)
    typer.echo(f"{len(simulated.paths)} raw files and truth.nc in {settings.archive}")


@app.command()
@_plainly
def catalog(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Scan the archive, or bring its catalog up to date; list what is refused and why.

    Example: lidarops catalog catalogs/demo.yaml
    """
    from dataclasses import asdict

    from lidarops.campaign import load
    from lidarops.catalog.scan import scan
    from lidarops.records import Status

    settings = load(campaign, archive=archive, output=out)
    store = _store(settings)
    try:
        with _bar("catalog", None) as advance:
            summary = scan(settings, store, progress=advance)
        refused = store.granules(status=Status.REFUSED)
    finally:
        store.close()
    if as_json:
        reasons = [{"path": granule.path, "reason": granule.reason} for granule in refused]
        typer.echo(json.dumps({**asdict(summary), "refused_files": reasons}, indent=2))
    else:
        _show(_refused_table(refused))
        typer.echo(
            f"{summary.files} files: {summary.added} added, {summary.changed} changed,"
            f" {summary.unchanged} unchanged, {summary.vanished} vanished,"
            f" {summary.refused} refused"
        )
    _leave(failed=bool(refused))


@app.command("plan")
@_plainly
def show_plan(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    instrument: InstrumentOption = None,
    since: SinceOption = None,
    until: UntilOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the scenes, their steps, and what is left out and why. Runs nothing.

    Example: lidarops plan catalogs/demo.yaml
    """
    from lidarops.campaign import load
    from lidarops.plans import plan

    settings = load(campaign, archive=archive, output=out)
    cut = _cut(settings, instrument, since, until)
    plans = [plan(scene, settings) for scene in cut.scenes]
    if as_json:
        typer.echo(json.dumps([item.as_dict() for item in plans], indent=2))
        return
    for scene, item in zip(cut.scenes, plans, strict=True):
        title = f"{scene.id}: {len(scene.granules)} granules, {len(scene.dark)} dark"
        _show(_plan_table(title, item))


@app.command()
@_plainly
def reprocess(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    instrument: InstrumentOption = None,
    since: SinceOption = None,
    until: UntilOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Processes.")] = 1,
    profiles_per_chunk: Annotated[
        int | None, typer.Option(min=1, help="Profiles a dask chunk; changes no result.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Catalog the archive, process its scenes into products, and write the report.

    Example: lidarops reprocess catalogs/demo.yaml --workers 2
    """
    from lidarops.campaign import load
    from lidarops.engine import run
    from lidarops.pipeline import report_run

    settings = load(campaign, archive=archive, output=out)
    cut = _cut(settings, instrument, since, until)
    with _bar("reprocess", len(cut.scenes)) as advance:
        record = run(
            settings,
            cut,
            workers=workers,
            profiles_per_chunk=profiles_per_chunk,
            progress=lambda _outcome: advance(1),
        )
    page = report_run(settings, record)
    if as_json:
        typer.echo(json.dumps(_run_summary(record, page), indent=2))
    else:
        _tell(record, page)
    _leave(failed=record.failed)


@app.command()
@_plainly
def report(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or its run.json.", metavar="RUN")],
) -> None:
    """Build the HTML report and figures of a run again.

    Example: lidarops report demo/report/20260301T000000-ab12cd
    """
    from lidarops.reports import page, record

    folder = run if run.is_dir() else run.parent
    typer.echo(str(page.build(record.load(run), folder)))


@app.command()
@_plainly
def inspect(
    file: Annotated[Path, typer.Argument(help="A raw file or a product.", metavar="FILE")],
    provenance: Annotated[
        bool, typer.Option("--provenance", help="Print a product's PROV-JSON.")
    ] = False,
) -> None:
    """Show what a raw file or a product holds.

    Example: lidarops inspect demo/raw/coast/h2630100.000000
    """
    from lidarops import inspection

    if provenance:
        typer.echo(inspection.provenance(file))
        return
    for table in inspection.tables(file):
        _show(table)


@app.command()
@_plainly
def bench(
    what: Annotated[str, typer.Argument(help="accuracy or throughput", metavar="WHAT")],
    files: Annotated[
        list[Path] | None, typer.Argument(help="Raw files of one layout, for the case reader.")
    ] = None,
    case: Annotated[
        str | None, typer.Option(help="elastic, homogeneous, multiangle, multiposition or reader.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of the EARLINET elastic intercomparison, for the case elastic."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A minute at most.")] = False,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=100, help="Counted repeats of each timing.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of page and JSON.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure errors against the least possible ones, or speed against a floor of the same run.

    Example: lidarops bench accuracy --case homogeneous --quick --out bench

    Example: lidarops bench accuracy --case elastic --quick --data boeckmann

    Example: lidarops bench throughput demo/raw/coast/h*.*0
    """
    from lidarops.bench import cases, results
    from lidarops.bench.terms import Effort

    today = datetime.now(UTC).date().isoformat()
    with _bar("bench", None) as advance:
        effort = Effort(quick=quick, repeats=repeats, date=today, progress=advance)
        finding = cases.run(what, case, files or [], effort, data=data)
    page = None if out is None else cases.write(finding, out)
    if as_json:
        typer.echo(json.dumps(results.plain(finding.result), indent=1))
        return
    for part in finding.report.parts:
        for found in part.tables:
            table = _table(found.title, *found.columns)
            for cells in found.rows:
                _row(table, *cells)
            _show(table)
    if page is not None:
        typer.echo(f"report: {page}")


def _store(campaign: Campaign) -> Store:
    from lidarops.catalog.store import Store

    return Store(campaign.catalog_url, campaign.name)


def _cut(
    campaign: Campaign,
    instruments: list[str] | None,
    since: datetime | None,
    until: datetime | None,
) -> Cut:
    from lidarops.pipeline import prepare

    return prepare(campaign, instruments=instruments or (), since=_utc(since), until=_utc(until))


def _utc(moment: datetime | None) -> datetime | None:
    return None if moment is None else moment.replace(tzinfo=moment.tzinfo or UTC)


def _leave(*, failed: bool) -> None:
    if failed:
        raise typer.Exit(REFUSED)


@contextmanager
def _bar(name: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show progress on standard error where that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(name, total=total)
        yield lambda done: bar.advance(task, done)


def _show(table: Table) -> None:
    from rich.console import Console

    if table.row_count:
        Console().print(table)


def _table(title: str, *columns: str) -> Table:
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _row(table: Table, *cells: Any) -> None:
    from rich.text import Text

    # Text, because a path or a reason may hold what rich would take for markup.
    table.add_row(*(Text(str(cell)) for cell in cells))


def _refused_table(refused: list[Granule]) -> Table:
    table = _table("Refused", "file", "instrument", "reason")
    for granule in refused:
        _row(table, granule.path, granule.instrument, granule.reason)
    return table


def _plan_table(title: str, plan: Plan) -> Table:
    table = _table(title, "channel", "step", "does", "why")
    for step in plan.steps:
        settings = ", ".join(f"{key} {value}" for key, value in step.settings.items())
        _row(table, step.channel, step.name, settings or "yes", step.reason)
    for left in plan.left_out:
        _row(table, left.channel, left.name, "left out", left.reason)
    return table


def _run_summary(record: RunRecord, page: Path) -> dict[str, Any]:
    return {
        "run": record.id,
        "report": str(page),
        "scenes": len(record.scenes),
        "failed_scenes": {scene.scene: scene.error for scene in record.scenes if scene.error},
        "refused_files": {granule.path: granule.reason for granule in _all_refused(record)},
        "products": [product.path for scene in record.scenes for product in scene.products],
    }


def _all_refused(record: RunRecord) -> list[Granule]:
    return [*record.refused, *(granule for scene in record.scenes for granule in scene.refused)]


def _tell(record: RunRecord, page: Path) -> None:
    table = _table("Products", "scene", "kind", "channel", "values", "unflagged", "flags")
    for scene in record.scenes:
        for product in scene.products:
            flags = ", ".join(f"{name.lower()} {count}" for name, count in product.flagged.items())
            of = (scene.scene, product.kind.value, product.channel)
            _row(table, *of, product.values, product.unflagged, flags)
        if scene.error:
            _row(table, scene.scene, "none", "", "", "", scene.error)
    _show(table)
    _show(_refused_table(_all_refused(record)))
    typer.echo(f"products: {record.products}\nreport:   {page}")

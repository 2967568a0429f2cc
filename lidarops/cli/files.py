"""Commands on one file or one run: show it, or make it again."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import JsonOption, WorkersOption, command, exit_with_status, say, show
from lidarops.errors import LidarOpsError


@command()
def report(
    run: Annotated[
        Path, typer.Argument(help="Report folder of a run, or its run.json.", metavar="RUN")
    ],
    workers: WorkersOption = 1,
) -> None:
    """Build the HTML report of a run and its figures again.

    Example: lidarops report demo/report/RUN --workers 2
    """
    from lidarops.reports import run_page, run_record

    folder = run if run.is_dir() else run.parent
    say(str(run_page.build_report(run_record.load_run_record(run), folder, workers=workers).page))


@command()
def inspect(
    file: Annotated[
        Path,
        typer.Argument(help="A raw file, a product, or a folder of raw files.", metavar="FILE"),
    ],
    provenance: Annotated[
        bool, typer.Option("--provenance", help="Print the PROV-JSON of a product.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the content of a raw file or a product, or the groups of raw files of a folder.

    Example: lidarops inspect demo/raw/coast/h2492106.010000
    """
    from lidarops.reports import inspection

    if provenance:
        say(inspection.provenance(file))
        return
    if as_json:
        typer.echo(json.dumps(inspection.describe(file), indent=2, ensure_ascii=False))
        return
    for table in inspection.tables(file):
        show(table)


@command()
def plot(
    file: Annotated[Path, typer.Argument(help="A raw file or a product.", metavar="FILE")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="PNG, SVG or PDF file; by default FILE.png here."),
    ] = None,
    variable: Annotated[str, typer.Option(help="Draw this variable only.")] = "",
    time: Annotated[
        str, typer.Option(help="UTC, such as 2024-03-01T06:00/2024-03-01T18:00.", metavar="SPAN")
    ] = "",
    range_: Annotated[str, typer.Option("--range", help="km, such as 0.3/5.", metavar="SPAN")] = "",
    altitude: Annotated[str, typer.Option(help="km above sea level.", metavar="SPAN")] = "",
) -> None:
    """Draw a raw file or a product; more than one figure get numbered files.

    Example: lidarops plot demo/raw/coast/h2492106.010000 -o h2492106.svg
    """
    from lidarops.reports import plotting
    from lidarops.system.files import write_atomically

    if out is not None and out.suffix not in plotting.TYPES:
        raise LidarOpsError(f"is none of {', '.join(plotting.TYPES)}", file=out, wrong_use=True)
    figures = plotting.draw_file(file, plotting.selection(variable, time, range_, altitude))
    from lidarops.figures.stills import still

    out = out or Path(f"{file.name.removesuffix('.nc')}.png")
    out.parent.mkdir(parents=True, exist_ok=True)
    for number, figure in enumerate(figures, 1):
        target = out if len(figures) == 1 else out.with_stem(f"{out.stem}_{number}")
        write_atomically(target, still(figure, out.suffix))
        say(f"{target}: {figure.caption}")


@command()
def reproduce(
    product: Annotated[Path, typer.Argument(help="A product.", metavar="PRODUCT")],
    archive: Annotated[
        str | None,
        typer.Option("--archive", help="Folder or URL of the raw files; searched for by default."),
    ] = None,
    ancillary: Annotated[
        Path | None,
        typer.Option("--ancillary", help="Folder of soundings and overlap functions."),
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option(
            "--catalog",
            help="SQLAlchemy URL of a catalog that knows where raw files were moved;"
            " searched for by default.",
            metavar="URL",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a product again from its provenance. Exit code 0 if every byte is the same.

    Example: lidarops reproduce demo/products/hill/hill-vertical/elastic/2024/*355o*0922*.nc
    """
    from lidarops.run.reproduction import explain_difference, reproduce_product

    result = reproduce_product(product, archive=archive, ancillary=ancillary, catalog=catalog)
    say(json.dumps(asdict(result), indent=2) if as_json else explain_difference(result))
    exit_with_status(failed=not result.identical)


@command()
def compare(
    old: Annotated[Path, typer.Argument(help="A product.", metavar="OLD")],
    new: Annotated[Path, typer.Argument(help="Another version of it.", metavar="NEW")],
    as_json: JsonOption = False,
) -> None:
    """Show how a product differs from another version of it, and why. Exit code 0 if it does not.

    none: the same values and texts. minor: other texts or flags, or values within a tenth of their
    stated errors. major: all else.

    Example: lidarops compare OLD.nc NEW.nc
    """
    from lidarops.figures.wording import change_in_words
    from lidarops.netcdf.comparison import compare_products
    from lidarops.records import Grade

    change = compare_products(old, new)
    if as_json:
        typer.echo(json.dumps(change.as_dict(), indent=2))
    else:
        say(f"{change.grade.value}: {change_in_words(change)}")
        for cause in change.causes:
            say(f"  {cause}")
    exit_with_status(failed=change.grade is not Grade.NONE)

"""The command that makes a product again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import JsonOption, app, exit_with_status, with_plain_errors


@app.command()
@with_plain_errors
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
    from dataclasses import asdict

    from lidarops.run.reproduction import explain_difference, reproduce_product

    result = reproduce_product(product, archive=archive, ancillary=ancillary, catalog=catalog)
    typer.echo(json.dumps(asdict(result), indent=2) if as_json else explain_difference(result))
    exit_with_status(failed=not result.identical)

"""The command that makes the archive browser."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import (
    JsonOption,
    command,
    exit_with_status,
    progress_bar,
    say,
    show_rows,
)


@command()
def site(
    out: Annotated[
        Path, typer.Argument(help="Output folder of a campaign, with its products.", metavar="OUT")
    ],
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
    products_at: Annotated[
        str,
        typer.Option(
            help="Where downloads lead: an address, or a place relative to the site, such as .. for"
            " a site that is published beside the products."
        ),
    ] = "../products",
    copies: Annotated[
        bool,
        typer.Option("--copies", help="Copy the products into the site, to serve it alone."),
    ] = False,
    stac_at: Annotated[
        str,
        typer.Option(
            help="Where links to the STAC catalog lead, for a site that is published or holds"
            " copies: an address, or a place relative to the site. Default: no link there."
        ),
    ] = "",
    reports_at: Annotated[
        str, typer.Option(help="The same for the folder of the reports of runs.")
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Make a static site of all products: calendar, figures, flags, provenance, downloads.

    Writes to OUT/site; the pages need neither server nor network. Run it again to update the site.
    Exit code 1 if a product cannot be shown completely.

    Example: lidarops site demo --workers 2

    Example: lidarops site demo --products-at https://example.org/lidar/products
    """
    from lidarops.figures.wording import counted
    from lidarops.site.build import build_site

    with progress_bar("site", None) as bar:
        made = build_site(
            out,
            workers=workers,
            products_at=products_at,
            copies=copies,
            stac_at=stac_at,
            reports_at=reports_at,
            progress=bar.advance,
        )
    if as_json:
        typer.echo(json.dumps(asdict(made), indent=2, default=str))
    else:
        rows = ((problem.path, problem.reason) for problem in made.problems)
        show_rows("Cannot be shown completely", ("file", "reason"), rows)
        say(
            f"{counted(made.products, 'product')}, {counted(made.made, 'page')} made\n"
            f"site: {made.index}"
        )
    exit_with_status(failed=bool(made.problems))

"""The command that makes the archive browser."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import (
    JsonOption,
    add_row,
    app,
    exit_with_status,
    make_table,
    progress_bar,
    show,
    with_plain_errors,
)


@app.command()
@with_plain_errors
def site(
    out: Annotated[
        Path, typer.Argument(help="Output folder of a campaign, with its products.", metavar="OUT")
    ],
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Make a static site of all products: calendar, figures, flags, provenance, downloads.

    Writes to OUT/site; the pages need neither server nor network. Run it again to update the site.
    Exit code 1 if a product cannot be shown completely.

    Example: lidarops site demo --workers 2
    """
    from lidarops.site.build import build_site

    with progress_bar("site", None) as advance:
        made = build_site(out, workers=workers, progress=advance)
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "index": str(made.index),
                    "products": made.products,
                    "made": made.made,
                    "problems": [asdict(problem) for problem in made.problems],
                },
                indent=2,
            )
        )
    else:
        table = make_table("Cannot be shown completely", "file", "reason")
        for problem in made.problems:
            add_row(table, problem.path, problem.reason)
        show(table)
        typer.echo(f"{made.products} products, {made.made} pages made\nsite: {made.index}")
    exit_with_status(failed=bool(made.problems))

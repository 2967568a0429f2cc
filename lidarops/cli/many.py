"""Commands on many products: aggregates, and the archive browser."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidarops.cli import options
from lidarops.cli.app import (
    command,
    exit_with_status,
    progress_bar,
    say,
    show_rows,
    utc,
)
from lidarops.figures.wording import visible
from lidarops.site.paths import CALENDAR_HEIGHT

if TYPE_CHECKING:
    from lidarops.aggregate.aggregates import AggregateResult


@command()
def aggregate(
    out: options.Output = Path(),
    kind: Annotated[str | None, typer.Option(help="Only this kind of product.")] = None,
    channel: Annotated[str | None, typer.Option(help="Only this channel.")] = None,
    station: Annotated[str | None, typer.Option(help="Only this station.")] = None,
    instrument: Annotated[str | None, typer.Option(help="Only this instrument.")] = None,
    since: options.Since = None,
    until: options.Until = None,
    means: Annotated[
        str | None, typer.Option(help="Also write means over each day or month.", metavar="PERIOD")
    ] = None,
    weights: Annotated[
        str,
        typer.Option(help="Weights of the profiles in a mean: shots, plain or inverse-variance."),
    ] = "shots",
    stac: Annotated[bool, typer.Option("--stac", help="Also write a STAC catalog.")] = False,
    products_at: Annotated[
        str,
        typer.Option(
            help="Address of published products, to which the STAC catalog links them; default:"
            " where they are in the output."
        ),
    ] = "",
    store: Annotated[
        bool,
        typer.Option(
            "--store",
            help="Also add what is new to the stores, one of each kind, as a new snapshot. The"
            " snapshot names runs if a campaign file is given.",
        ),
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Write an index of products, by which they open as one dataset, and means, stores or STAC.

    Writes to the folder aggregates, which can be deleted and made again at any time. Stores are in
    the folder stores, and keep the values of products that were replaced.

    Example: lidarops aggregate demo

    Example: lidarops aggregate demo --kind elastic --means month --weights inverse-variance
    """
    from lidarops.aggregate.aggregates import make_aggregates
    from lidarops.aggregate.facts import Period, Weights, parse_selection

    try:
        period, weighting = means if means is None else Period(means), Weights(weights)
    except ValueError as error:
        choices = f"means of {', '.join(Period)}; weights {', '.join(Weights)}"
        raise typer.BadParameter(f"{error}; there are {choices}") from error
    selection = parse_selection(kind, channel, station, instrument, utc(since), utc(until))
    root, runs = _root(out, with_runs=store)
    with progress_bar("aggregate", "product") as bar:
        made = make_aggregates(
            root,
            selection,
            period=period,
            weights=weighting,
            stac=stac,
            products_at=products_at,
            store=store,
            runs=runs,
            progress=bar.advance,
        )
    if as_json:
        typer.echo(json.dumps(asdict(made), indent=2, default=str))
    else:
        _tell(made)
    exit_with_status(failed=bool(made.refused or made.failed))


def _root(out: Path, *, with_runs: bool) -> tuple[Path, dict[str, str]]:
    """Return the output folder, and product path -> run if the campaign file is given."""
    if not out.is_file():
        return out, {}
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.store import Store

    campaign = load_campaign(out)
    root = Path(campaign.output)
    if not with_runs:
        return root, {}
    below = Path(campaign.products_root).relative_to(root)
    with (
        Store(campaign.catalog_url, campaign.name, create=False) as store,
        store.all_products() as products,
    ):
        return root, {(below / product.path).as_posix(): product.run for product in products}


def _tell(made: AggregateResult) -> None:
    means = ((file.path, file.products, file.periods) for file in made.means)
    show_rows("Means", ("file", "products", "periods"), means)
    stores = ((s.path, s.groups, s.added, s.dropped, s.snapshot) for s in made.stores)
    show_rows("Stores", ("folder", "groups", "added", "dropped", "snapshot"), stores)
    refused = ((product.path, product.reason) for product in made.refused)
    show_rows("Refused", ("file", "reason"), refused)
    for sentence in made.notes:
        say(f"note: {sentence}")
    for sentence in made.failed:
        typer.secho(visible(f"failed: {sentence}"), fg="red", err=True)
    for name, path in (("index", made.index), ("stac", made.stac)):
        if path is not None:
            say(f"{name}: {made.root / path}")


@command()
def site(
    out: options.Output = Path(),
    workers: options.Workers = 1,
    products_at: Annotated[
        str,
        typer.Option(
            help="Where downloads lead: an address, or a place relative to the site, such as .. for"
            " a site that is published beside the products."
        ),
    ] = "../products",
    stac_at: Annotated[
        str,
        typer.Option(
            help="Where links to the STAC catalog lead, for a site that is published: an"
            " address, or a place relative to the site. Default: no link there."
        ),
    ] = "",
    reports_at: Annotated[
        str, typer.Option(help="The same for the folder of the reports of runs.")
    ] = "",
    below: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Height above the station, m, below which a profile with a usable value counts in"
            " the calendar.",
        ),
    ] = CALENDAR_HEIGHT,
    as_json: options.Json = False,
) -> None:
    """Make a static site of all products: calendar, figures, flags, provenance, downloads.

    Writes to OUT/site; the pages need neither server nor network. Run it again to update the site.
    Exit code 1 if a product cannot be shown completely.

    Example: lidarops site demo --workers 2

    Example: lidarops site demo --products-at https://example.org/lidar/products
    """
    from lidarops.figures.wording import counted
    from lidarops.site.build import build_site

    with progress_bar("site", "product") as bar:
        made = build_site(
            _root(out, with_runs=False)[0],
            workers=workers,
            products_at=products_at,
            stac_at=stac_at,
            reports_at=reports_at,
            below=below,
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

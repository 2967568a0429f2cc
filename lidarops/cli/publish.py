"""Command that copies products to an object store."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from lidarops.cli.app import CampaignFile, CatalogOption, JsonOption, OutOption, app, plainly


@app.command()
@plainly
def publish(
    campaign: CampaignFile,
    url: Annotated[str, typer.Argument(help="Where to, such as s3://bucket/prefix or file:///...")],
    out: OutOption = None,
    catalog: CatalogOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring an object store up to date with the products: sends what it lacks, removes nothing.

    Example: lidarops publish catalogs/demo.yaml s3://bucket/demo
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.run.publication import publish_products as copy
    from lidarops.system.stores import without_keys

    settings = load_campaign(campaign, output=out, catalog=catalog)
    done = copy(settings, url)
    if as_json:
        typer.echo(json.dumps(asdict(done), indent=2))
        return
    others = f", {done.others} others in the store left alone" if done.others else ""
    typer.echo(
        f"{without_keys(url)}: {len(done.uploaded)} sent, {done.unchanged} unchanged{others}"
    )

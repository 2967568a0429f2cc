"""The command that copies products to an object store."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from lidarops.cli.app import (
    CampaignFile,
    CatalogOption,
    JsonOption,
    OutOption,
    app,
    with_plain_errors,
)


@app.command()
@with_plain_errors
def publish(
    campaign: CampaignFile,
    url: Annotated[
        str, typer.Argument(help="Destination, such as s3://bucket/prefix or file:///...")
    ],
    out: OutOption = None,
    catalog: CatalogOption = None,
    as_json: JsonOption = False,
) -> None:
    """Copy products to an object store: send what it lacks or has outdated; remove nothing.

    Example: lidarops publish catalogs/demo.yaml s3://bucket/demo
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.run.publication import publish_products
    from lidarops.system.stores import without_keys

    settings = load_campaign(campaign, output=out, catalog=catalog)
    published = publish_products(settings, url)
    if as_json:
        typer.echo(json.dumps(asdict(published), indent=2))
        return
    others = f", {published.others} other files left alone" if published.others else ""
    counts = f"{len(published.uploaded)} sent, {published.unchanged} unchanged{others}"
    typer.echo(f"{without_keys(url)}: {counts}")

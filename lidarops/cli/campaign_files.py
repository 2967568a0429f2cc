"""The command on the format of campaign files."""

from __future__ import annotations

import typer

from lidarops.cli.app import app, with_plain_errors


@app.command()
@with_plain_errors
def schema() -> None:
    """Print the JSON schema of campaign files, for editors.

    Example: lidarops schema > campaign.schema.json
    """
    import json

    from lidarops.campaign.model import campaign_schema

    typer.echo(json.dumps(campaign_schema(), indent=2))

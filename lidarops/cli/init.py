"""The command that writes the first campaign file of an archive."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Annotated, Final

import typer

from lidarops.cli.app import command, no_url, say

_SCHEMA: Final = "campaign.schema.json"
_OUTPUT: Final = "out"


@command()
def init(
    folder: Annotated[
        str, typer.Argument(help="Folder of raw files.", metavar="FOLDER", callback=no_url)
    ],
    campaign: Annotated[
        Path, typer.Argument(help="Campaign file to write.", metavar="CAMPAIGN")
    ] = Path("campaign.yaml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite the campaign file.")] = False,
) -> None:
    """Write a commented campaign file for a folder of raw files, from their headers.

    The JSON schema of its keys is written beside it, so that editors complete them. What headers
    do not state is marked with a question in a comment.

    Example: lidarops init raw harbour.yaml
    """
    from lidarops.campaign.model import campaign_schema
    from lidarops.catalog.folder import read_folder
    from lidarops.errors import CampaignError, CatalogError
    from lidarops.plan.draft import draft_campaign

    if campaign.exists() and not force:
        raise CampaignError(
            "exists", file=campaign, remedy="give another name, or --force", wrong_use=True
        )
    root, base = Path(folder).resolve(), campaign.resolve().parent
    if not root.is_dir():
        raise CatalogError(
            "is not a folder",
            file=folder,
            remedy="give the folder of the raw files",
            wrong_use=True,
        )
    text = draft_campaign(
        read_folder(str(root), guess_pointing=True),
        archive=Path(os.path.relpath(root, base)).as_posix(),
        output=_free_output(campaign),
        name=root.name,
        schema=_SCHEMA,
    )
    base.mkdir(parents=True, exist_ok=True)
    (base / _SCHEMA).write_text(json.dumps(campaign_schema(), indent=2) + "\n", encoding="utf-8")
    campaign.write_text(text, encoding="utf-8")
    questions = sum("# ?" in line or "; ?" in line for line in text.splitlines())
    say(f"{campaign}: {questions} lines have a question; next: lidarops plan {campaign}")


def _free_output(campaign: Path) -> str:
    """Return a folder of output that no other campaign file beside this one states."""
    others = (
        path for path in campaign.resolve().parent.glob("*.yaml") if path != campaign.resolve()
    )
    stated = re.compile(rf"""^output:\s*["']?{_OUTPUT}["']?\s*(#|$)""", re.MULTILINE)
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in others)
    return f"{_OUTPUT}-{campaign.stem}" if any(map(stated.search, texts)) else _OUTPUT

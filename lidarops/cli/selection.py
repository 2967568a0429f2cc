"""The campaign and the selection of a command, from its options."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from lidarops.cli.app import utc
from lidarops.kinds import kinds

if TYPE_CHECKING:
    from lidarops.campaign.model import Campaign
    from lidarops.run.selection import Selection

NO_SCENE: Final = "nothing to do: the selection contains no scene of the archive"

AllStepsOption = Annotated[
    bool,
    typer.Option(
        "--all-steps", help="Run every step, even those without effect, and read files in full."
    ),
]


def loaded_campaign(
    campaign: Path,
    archive: str | None,
    out: str | None,
    catalog: str | None,
    *,
    all_steps: bool = False,
) -> Campaign:
    """Return the campaign of a file, with the places that options override."""
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.access import check_archive_and_catalog

    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    check_archive_and_catalog(settings, archive=archive)
    return settings.model_copy(update={"all_steps": all_steps or settings.all_steps})


def selection_of(
    instruments: list[str] | None,
    stations: list[str] | None,
    products: list[str] | None,
    since: datetime | None,
    until: datetime | None,
) -> Selection:
    """Return the selection that options describe; refuse an unknown kind of product."""
    from lidarops.run.selection import Selection

    for name in products or ():
        if name not in kinds():
            raise typer.BadParameter(
                f"{name!r} is not a kind of product; the kinds are {', '.join(kinds())}"
            )
    return Selection(
        stations=tuple(stations or ()),
        instruments=tuple(instruments or ()),
        kinds=tuple(products or ()),
        since=utc(since),
        until=utc(until),
    )

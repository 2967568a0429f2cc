"""A catalog for commands that must not write: the one of the campaign, or one for the moment."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import sqlalchemy as sa

from lidarops.campaign.model import Campaign
from lidarops.catalog.database import Database


@contextmanager
def without_writing(campaign: Campaign) -> Iterator[Campaign]:
    """Yield a campaign whose catalog may be updated without a trace in its output folder.

    A catalog in a folder that does not exist, or cannot be written, is replaced by a temporary one,
    which starts as its copy. Any other is the campaign's own: its update saves the next run work.
    """
    file = Path(sa.make_url(campaign.catalog_url).database or "")
    in_file = campaign.catalog_url.startswith("sqlite") and file.name
    if not in_file or os.access(file.parent, os.W_OK):
        yield campaign
        return
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        copy = Path(folder, file.name)
        if file.exists():
            with closing(Database(campaign.catalog_url, campaign.name, create=False)) as source:
                source.copy_to(copy)
        yield campaign.model_copy(update={"catalog": f"sqlite:///{copy}"})

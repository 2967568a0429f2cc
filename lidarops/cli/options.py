"""The arguments and options that commands and flows share."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import campaign_file, stated

Campaign = Annotated[
    Path,
    typer.Argument(
        help="Campaign file (YAML), a folder with campaign.yaml, or the output folder of a campaign"
        " that has run; default: the folder here.",
        metavar="CAMPAIGN",
        callback=campaign_file,
        show_default=False,
    ),
]
Output = Annotated[
    Path,
    typer.Argument(
        help="Output folder of a campaign, or what names it: a campaign file, or a folder with"
        " campaign.yaml; default: the folder here.",
        metavar="OUT_OR_CAMPAIGN",
        callback=stated,
        show_default=False,
    ),
]
Archive = Annotated[
    str | None,
    typer.Option("--archive", help="Folder or URL of the raw files; overrides the campaign file."),
]
Out = Annotated[
    # Not a Path: it would turn a URL into a folder name.
    str | None,
    typer.Option(
        "--out", help="Folder of catalog, products and reports; overrides the campaign file."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
Instruments = Annotated[
    list[str] | None, typer.Option("--instrument", help="Only this instrument; may be repeated.")
]
Since = Annotated[
    datetime | None, typer.Option("--since", help="Only scenes that end after this UTC time.")
]
Until = Annotated[
    datetime | None, typer.Option("--until", help="Only scenes that start before this UTC time.")
]
Catalog = Annotated[
    str | None,
    typer.Option(
        "--catalog",
        help="SQLAlchemy URL of catalog and ledger; overrides LIDAROPS_CATALOG and the file.",
        metavar="URL",
    ),
]
Stations = Annotated[
    list[str] | None, typer.Option("--station", help="Only this station; may be repeated.")
]
Products = Annotated[
    list[str] | None, typer.Option("--product", help="Only this kind of product; may be repeated.")
]
Wait = Annotated[
    float,
    typer.Option("--wait", min=0, help="Seconds to wait for another run on the same catalog."),
]
Workers = Annotated[int, typer.Option("--workers", min=1, max=256, help="Number of processes.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of a running dask scheduler to use.")
]
Cluster = Annotated[
    str | None,
    typer.Option("--cluster", help="slurm, kubernetes, or a YAML file that describes a cluster."),
]
AllSteps = Annotated[
    bool,
    typer.Option(
        "--all-steps", help="Run every step, even those without effect, and read files in full."
    ),
]

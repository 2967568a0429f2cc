"""Commands before a run: the schema of campaign files, simulated raw files, compiled code."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from lidarops.cli.app import (
    ArchiveOption,
    CampaignFile,
    OutOption,
    command,
    from_here,
    progress_bar,
    say,
)


@command()
def simulate(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
) -> None:
    """Write the raw Licel files of a simulated campaign, and the truth behind them.

    Example: lidarops simulate catalogs/demo.yaml --workers 2
    """
    from contextlib import nullcontext

    from lidarops.campaign.model import load_campaign
    from lidarops.netcdf.write import write_plain
    from lidarops.run.executor import local_client
    from lidarops.simulate.campaign import plan_simulation, write_simulation

    settings = load_campaign(campaign, archive=archive, output=out)
    planned = plan_simulation(settings)
    cluster = nullcontext() if workers == 1 else local_client(workers)
    with progress_bar("simulate", len(planned.paths)) as bar, cluster as client:
        simulated = write_simulation(planned, client=client, progress=bar.advance)
    write_plain(simulated.truth, settings.truth_path)
    say(f"{len(simulated.paths)} raw files and truth.nc in {from_here(settings.archive)}")


@command()
def schema() -> None:
    """Print the JSON schema of campaign files, for editors.

    Example: lidarops schema > campaign.schema.json
    """
    from lidarops.campaign.model import campaign_schema

    typer.echo(json.dumps(campaign_schema(), indent=2))


@command("compile")
def compile_code() -> None:
    """Compile the retrievals now, so that the first run need not: once after installation.

    Example: lidarops compile
    """
    from lidarops.run.compilation import compile_retrievals

    say("compiling the retrievals: about two minutes")
    say(f"compiled code is kept in {compile_retrievals()}")

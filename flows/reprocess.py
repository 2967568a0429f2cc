"""Flow: reprocess a campaign.

``python -m flows.reprocess catalogs/demo.yaml`` needs no set-up: without a Prefect server in the
environment it starts one for the time of the run.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, TypeVar, cast
from uuid import UUID

import typer
from prefect import flow, get_run_logger, task
from prefect.artifacts import (
    create_image_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.utilities.annotations import quote

from lidarops.campaign import Campaign, load
from lidarops.engine import conclude, make_jobs, process_all
from lidarops.pipeline import prepare, report_run
from lidarops.processing import Job
from lidarops.records import RunRecord, SceneOutcome
from lidarops.reports import page
from lidarops.scenes import Cut

_T = TypeVar("_T")

BATCH = 50
"""Scenes a Prefect task: a task costs tens of milliseconds, so never one a file."""


def _opaque(value: _T) -> _T:
    """Keep Prefect from walking an argument in search of futures: a scene holds thousands."""
    return cast("_T", quote(value))


@task(name="catalog")
def catalog_task(campaign: Campaign, instruments: Sequence[str]) -> Cut:
    """Bring the catalog up to date and cut it into scenes."""
    return prepare(campaign, instruments=instruments)


@task(name="process", retries=2, retry_delay_seconds=[5, 30])
def process_task(jobs: Sequence[Job], workers: int) -> list[SceneOutcome]:
    """Process one batch of scenes."""
    return process_all(jobs, workers=workers)


@task(name="report")
def report_task(campaign: Campaign, record: RunRecord) -> Path:
    """Write the report of a run and publish its table and quicklook."""
    built = report_run(campaign, record)
    key = campaign.name.lower()
    create_table_artifact(
        key=f"{key}-products", table=page.summary_rows(record), description=f"Run {record.id}"
    )
    create_markdown_artifact(
        key=f"{key}-report", markdown=f"Run {record.id}: [{built}]({built.as_uri()})"
    )
    picture = page.quicklook(record, built.parent)
    if picture is not None:
        # The server may stand on another machine, so the picture travels in the artifact.
        encoded = base64.b64encode(picture.read_bytes()).decode()
        create_image_artifact(image_url=f"data:image/png;base64,{encoded}", key=f"{key}-quicklook")
    return built


@flow(name="lidarops-reprocess")
def reprocess(
    campaign: str,
    archive: str | None = None,
    out: str | None = None,
    workers: int = 1,
    instruments: list[str] | None = None,
) -> tuple[RunRecord, Path]:
    """Catalog the archive of a campaign, process its scenes, and write the report.

    Parameters
    ----------
    campaign : str
        Path of the campaign file.
    archive, out : str, optional
        As on the command line.
    workers : int
        Processes.
    instruments : list of str, optional
        Only these.

    Returns
    -------
    record : RunRecord
    report : Path
        The HTML page.
    """
    started = datetime.now(UTC)
    settings = load(campaign, archive=archive, output=out)
    cut = catalog_task(_opaque(settings), _opaque(instruments or []))
    jobs = make_jobs(settings, cut)
    description = f"Scenes of campaign {settings.name}"
    progress = cast("UUID", create_progress_artifact(0.0, description=description))
    outcomes: list[SceneOutcome] = []
    for first in range(0, len(jobs), BATCH):
        outcomes += process_task(_opaque(jobs[first : first + BATCH]), workers)
        update_progress_artifact(progress, 100.0 * len(outcomes) / len(jobs))
    record = conclude(settings, cut, outcomes, started=started)
    built = report_task(_opaque(settings), _opaque(record))
    get_run_logger().info("run %s: %d scenes, report %s", record.id, len(outcomes), built)
    return record, built


def main(
    campaign: str,
    archive: str | None = None,
    out: str | None = None,
    workers: Annotated[int, typer.Option(min=1, max=256)] = 1,
) -> None:
    """Reprocess a campaign as a Prefect flow."""
    record, built = reprocess(campaign, archive, out, workers)
    typer.echo(f"products: {record.products}\nreport:   {built}")
    raise typer.Exit(1 if record.failed else 0)


if __name__ == "__main__":
    typer.run(main)

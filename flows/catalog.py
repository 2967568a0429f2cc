"""Flow: update the catalog of a campaign.

``python -m flows.catalog catalogs/demo.yaml``
"""

from __future__ import annotations

from dataclasses import asdict

import typer
from prefect import flow, get_run_logger
from prefect.artifacts import create_table_artifact

from flows.reprocess import Seconds, Workers
from flows.start import (
    CatalogUrl,
    Location,
    catalog_parameter,
    keep_main_module_out,
    plain_errors,
    tie_to_this_process,
)
from lidarops.campaign.model import load_campaign
from lidarops.catalog.database import check_archive_and_catalog
from lidarops.catalog.raw_files import acknowledged
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import Store
from lidarops.cli import options
from lidarops.run.archive import update_catalog


@flow(name="lidarops-catalog")
def catalog(
    campaign: str,
    archive: Location | None = None,
    out: str | None = None,
    wait: Seconds = 0.0,
    workers: Workers = 1,
    catalog: CatalogUrl | None = None,
) -> ScanSummary:
    """Scan the archive of a campaign, and publish a table of refused files as an artifact.

    Parameters
    ----------
    campaign : str
        Path of the campaign file.
    archive, out : str, optional
        Override the campaign file, as on the command line.
    wait : float
        s to wait for another run on the same archive.
    workers : int, optional
        Number of processes; more than one is used if thousands of files are new.
    catalog : str, optional
        SQLAlchemy URL of catalog and ledger; overrides the campaign file.
    """
    tie_to_this_process()
    keep_main_module_out()
    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    summary = update_catalog(settings, wait=wait, workers=workers)
    with Store(settings.catalog_url, settings.name) as store:
        refused = acknowledged(settings, store.refused())
    get_run_logger().info("catalog of %s: %s", settings.name, asdict(summary))
    create_table_artifact(
        key=f"{settings.name.lower()}-refused",
        table=[{"file": granule.path, "reason": granule.reason} for granule in refused],
        description=f"Files of campaign {settings.name} that the catalog refuses",
    )
    return summary


def main(
    campaign: str,
    archive: options.Archive = None,
    out: options.Out = None,
    url: options.Catalog = None,
    wait: options.Wait = 0.0,
) -> None:
    """Update the catalog of a campaign as a Prefect flow."""
    # Check before the flow, which would start a server first and show tracebacks.
    with plain_errors():
        stored_url = catalog_parameter(url)
        catalog.validate_parameters({"campaign": campaign, "archive": archive, "wait": wait})
        settings = load_campaign(campaign, archive=archive, output=out, catalog=url)
        check_archive_and_catalog(settings, archive=archive)
    tie_to_this_process()
    with plain_errors():
        summary = catalog(campaign, archive, out, wait, catalog=stored_url)
    raise typer.Exit(1 if summary.refused else 0)


if __name__ == "__main__":
    typer.run(main)

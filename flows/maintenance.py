"""End runs whose process is dead.

If a worker loses power, Prefect keeps its run in the state Running for ever. The run occupies the
one slot of its deployment, so that nothing is scheduled any more. Such a run sends no heartbeats.

``python -m flows.maintenance`` checks once. With ``--every 15`` it keeps running and checks every
15 s; this needs no worker, and is what ``deploy/`` starts.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from httpx import HTTPError
from prefect import get_client
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import (
    FlowRunFilter,
    FlowRunFilterDeploymentId,
    FlowRunFilterState,
    FlowRunFilterStateType,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.events.filters import (
    EventFilter,
    EventNameFilter,
    EventOccurredFilter,
    EventResourceFilter,
)
from prefect.exceptions import ObjectNotFound
from prefect.states import Crashed

from lidarops.errors import UNAVAILABLE

HEARTBEAT = "prefect.flow-run.heartbeat"
TAG = "lidarops"
"""Tag of every deployment in ``deploy/prefect.yaml``."""

_PAGE = 200


@dataclass(frozen=True, slots=True)
class Reaped:
    """A run that was ended because its process is dead."""

    id: UUID
    name: str
    silent: float
    """s since its last heartbeat."""


def reap_runs(
    client: SyncPrefectClient, *, silence: float = 90.0, start: float = 600.0
) -> list[Reaped]:
    """End deployed runs with the tag ``lidarops`` that send no heartbeats.

    Parameters
    ----------
    client : SyncPrefectClient
    silence : float
        s without a heartbeat after which a run counts as dead.
    start : float
        s that a claimed run may take to start, e.g. while nodes start.

    Returns
    -------
    list of Reaped
    """
    now = _now()
    reaped = []
    for run in list(_active_runs(client)):
        since = max(_changed(run), _last_heartbeat(client, run))
        silent = (now - since).total_seconds()
        # Heartbeats begin with the state Running; a run may be pending for long.
        if silent <= (start if run.state_type is StateType.PENDING else silence):
            continue
        message = f"no heartbeat for {silent:.0f} s: worker and process are considered dead"
        try:
            # Without force, the server refuses the state for a run that has ended meanwhile.
            client.set_flow_run_state(run.id, Crashed(message=message))
        except ObjectNotFound:
            continue
        reaped.append(Reaped(run.id, run.name, silent))
    return reaped


def _now() -> datetime:
    return datetime.now(UTC)


def _active_runs(client: SyncPrefectClient) -> Iterator[FlowRun]:
    active = [StateType.RUNNING, StateType.PENDING, StateType.CANCELLING]
    run_filter = FlowRunFilter(
        state=FlowRunFilterState(type=FlowRunFilterStateType(any_=active)),
        # Runs without a deployment hold no slot; runs of others may send no heartbeats.
        deployment_id=FlowRunFilterDeploymentId(is_null_=False),
        tags=FlowRunFilterTags(all_=[TAG]),
    )
    offset = 0
    while page := client.read_flow_runs(flow_run_filter=run_filter, limit=_PAGE, offset=offset):
        yield from page
        offset += len(page)


def _changed(run: FlowRun) -> datetime:
    return run.state.timestamp if run.state is not None else _now()


def _last_heartbeat(client: SyncPrefectClient, run: FlowRun) -> datetime:
    page = client.read_events(
        EventFilter(
            event=EventNameFilter(name=[HEARTBEAT]),
            resource=EventResourceFilter(id=[f"prefect.flow-run.{run.id}"]),
            occurred=EventOccurredFilter(since=_changed(run)),
        ),
        limit=1,
    )
    return page.events[0].occurred if page.events else _changed(run)


def main(
    every: Annotated[
        float | None, typer.Option(min=5, help="Keep running and check every so many seconds.")
    ] = None,
    silence: Annotated[
        # At least two heartbeats, because one may be late.
        float, typer.Option(min=60, help="Seconds without heartbeat until a run is dead.")
    ] = 90.0,
    start: Annotated[
        float, typer.Option(min=60, help="Seconds that a claimed run may take to start.")
    ] = 600.0,
    sign_of_life: Annotated[
        Path | None, typer.Option(help="File that is touched after each check, for a probe.")
    ] = None,
) -> None:
    """End runs whose process is dead, once or repeatedly."""
    while True:
        try:
            with get_client(sync_client=True) as client:
                for run in reap_runs(client, silence=silence, start=start):
                    typer.echo(f"run {run.name} ended: silent for {run.silent:.0f} s")
        except HTTPError as error:
            typer.echo(f"the server does not answer: {error!r}", err=True)
            # It may be restarting; repeated maintenance must survive that.
            if every is None:
                raise typer.Exit(UNAVAILABLE) from error
        if sign_of_life is not None:
            sign_of_life.touch()
        if every is None:
            return
        time.sleep(every)


if __name__ == "__main__":
    typer.run(main)

"""Flow: end the runs whose process is dead.

A worker that loses power leaves its run in the state Running for ever, where it occupies the one
slot of its deployment: nothing is scheduled any more. Such a run gives no sign of life.

``python -m flows.maintenance`` looks once; with ``--every 15`` it stays and looks every 15 s,
which needs no worker and is what ``deploy/`` starts.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated
from uuid import UUID

import typer
from httpx import HTTPError
from prefect import flow, get_client, get_run_logger
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
from pydantic import Field

HEARTBEAT = "prefect.flow-run.heartbeat"
TAG = "lidarops"
"""On every deployment of ``deploy/prefect.yaml``."""

_PAGE = 200

Silence = Annotated[float, Field(ge=60, le=86_400)]
"""s; two heartbeats at least, as one may be late."""


@dataclass(frozen=True, slots=True)
class Reaped:
    """A run that was ended."""

    id: UUID
    name: str
    silent: float
    """s since its last sign of life."""


def reap_runs(
    client: SyncPrefectClient, *, silence: float = 90.0, start: float = 600.0
) -> list[Reaped]:
    """End the deployed runs, tagged as lidarops', that give no sign of life.

    Parameters
    ----------
    client : SyncPrefectClient
    silence : float
        s without a heartbeat after which a run counts as dead.
    start : float
        s that a claimed run may take until it runs, as nodes may have to be started.

    Returns
    -------
    list of Reaped
    """
    now = _now()
    reaped = []
    for run in list(_active_runs(client)):
        since = max(_changed(run), _last_heartbeat(client, run))
        silent = (now - since).total_seconds()
        # The first heartbeat comes with the state Running; what precedes may take long.
        if silent <= (start if run.state_type is StateType.PENDING else silence):
            continue
        message = f"no sign of life for {silent:.0f} s: worker and process are taken for dead"
        try:
            # Not forced: the server refuses it for a run that has ended in the meantime.
            client.set_flow_run_state(run.id, Crashed(message=message))
        except ObjectNotFound:
            continue
        reaped.append(Reaped(run.id, run.name, silent))
    return reaped


def _now() -> datetime:
    return datetime.now(UTC)


def _active_runs(client: SyncPrefectClient) -> Iterator[FlowRun]:
    active = [StateType.RUNNING, StateType.PENDING, StateType.CANCELLING]
    chosen = FlowRunFilter(
        state=FlowRunFilterState(type=FlowRunFilterStateType(any_=active)),
        # Runs without a deployment hold no slot, and those of others may give no heartbeat.
        deployment_id=FlowRunFilterDeploymentId(is_null_=False),
        tags=FlowRunFilterTags(all_=[TAG]),
    )
    offset = 0
    while page := client.read_flow_runs(flow_run_filter=chosen, limit=_PAGE, offset=offset):
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


@flow(name="lidarops-maintenance", retries=2, retry_delay_seconds=10)
def maintenance(silence: Silence = 90.0, start: Silence = 600.0) -> int:
    """End the runs whose process is dead.

    Parameters
    ----------
    silence : float
        s without a heartbeat after which a run counts as dead.
    start : float
        s that a claimed run may take until it runs.

    Returns
    -------
    int
        How many runs were ended.
    """
    with get_client(sync_client=True) as client:
        reaped = reap_runs(client, silence=silence, start=start)
    for run in reaped:
        get_run_logger().warning("run %s ended: silent for %.0f s", run.name, run.silent)
    return len(reaped)


def main(
    every: Annotated[float | None, typer.Option(min=5, help="s; stay and look again")] = None,
    silence: Annotated[float, typer.Option(min=60, help="s without a heartbeat")] = 90.0,
    start: Annotated[float, typer.Option(min=60, help="s until a claimed run runs")] = 600.0,
) -> None:
    """End the runs whose process is dead, once or for as long as this process lives."""
    if every is None:
        maintenance(silence, start)
        return
    while True:
        try:
            with get_client(sync_client=True) as client:
                for run in reap_runs(client, silence=silence, start=start):
                    typer.echo(f"run {run.name} ended: silent for {run.silent:.0f} s")
        except HTTPError as error:
            # The server may be restarting; who watches over runs must not end with it.
            typer.echo(f"the server does not answer: {error!r}", err=True)
        time.sleep(every)


if __name__ == "__main__":
    typer.run(main)

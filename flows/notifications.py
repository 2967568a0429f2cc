"""Set up, once, who is told of a night that failed or did not come.

``python -m flows.notifications https://hooks.example.org/lidar`` makes two automations on the
Prefect server, which post ``{"text": ...}`` to that address; called again, it replaces them. Chat
services understand this; mail and others are chosen in Prefect's pages, for the same automations.
``--failures`` makes a third, of runs that ended in the state `flows.WITH_FAILURES`.
"""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated, cast
from uuid import UUID

import typer
from prefect.automations import Automation
from prefect.blocks.notifications import CustomWebhookNotificationBlock
from prefect.events import EventTrigger, Posture, ResourceSpecification
from prefect.events.actions import SendNotification

from flows import WITH_FAILURES

BLOCK = "lidarops-operators"
FAILED = "lidarops: a run failed"
ABSENT = "lidarops: no night was completed"
TROUBLED = "lidarops: a run completed with failures"

_BODY = "{{ flow_run.name }} is {{ flow_run.state.name }}: {{ flow_run.state.message }}"


def automations(block: UUID, *, within: timedelta, failures: bool = False) -> list[Automation]:
    """Describe the automations.

    Parameters
    ----------
    block : UUID
        The notification block that is used.
    within : timedelta
        Time in which one nightly run must be completed.
    failures : bool
        Whether to tell too of runs that are completed, with something refused or failed.

    Returns
    -------
    list of Automation
    """
    absent = EventTrigger(
        expect=_events("Completed", WITH_FAILURES),
        match_related=_tagged("nightly"),
        posture=Posture.Proactive,
        threshold=1,
        within=within,
    )
    troubled = [_ended(block, TROUBLED, WITH_FAILURES)] if failures else []
    return [
        _ended(block, FAILED, "Failed", "Crashed", "TimedOut"),
        *troubled,
        Automation(
            name=ABSENT,
            trigger=absent,
            actions=[
                SendNotification(
                    block_document_id=block,
                    subject=ABSENT,
                    body=f"No nightly run was completed for {within}: look for a worker.",
                )
            ],
        ),
    ]


def _ended(block: UUID, name: str, *states: str) -> Automation:
    """Describe what tells of every run that ends in one of some states."""
    trigger = EventTrigger(
        expect=_events(*states),
        match_related=_tagged("lidarops"),
        posture=Posture.Reactive,
        threshold=1,
    )
    told = SendNotification(block_document_id=block, subject=name, body=_BODY)
    return Automation(name=name, trigger=trigger, actions=[told])


def _events(*states: str) -> set[str]:
    return {f"prefect.flow-run.{state}" for state in states}


def _tagged(tag: str) -> ResourceSpecification:
    return ResourceSpecification.model_validate(
        {"prefect.resource.id": f"prefect.tag.{tag}", "prefect.resource.role": "tag"}
    )


def main(
    url: Annotated[str, typer.Argument(help="of a web hook")],
    hours: Annotated[float, typer.Option(min=1, help="in which a night must be completed")] = 26.0,
    *,
    failures: Annotated[
        bool, typer.Option("--failures", help="tell of runs completed with failures too")
    ] = False,
) -> None:
    """Tell somebody of runs that fail, and of nights without a run."""
    hook = CustomWebhookNotificationBlock(
        name=BLOCK, url=url, json_data={"text": "{{subject}}\n{{body}}"}
    )
    # Prefect types what may also be awaited as either.
    block = cast("UUID", hook.save(BLOCK, overwrite=True))
    wanted = automations(block, within=timedelta(hours=hours), failures=failures)
    there = {name for name in (FAILED, TROUBLED, ABSENT) if _removed(name)}
    for automation in wanted:
        if automation.name not in there:
            typer.echo(f"new: {automation.name}")
        automation.create()


def _removed(name: str) -> bool:
    """Remove an automation; return whether there was one."""
    try:
        cast("Automation", Automation.read(name=name)).delete()
    except ValueError:
        return False
    return True


if __name__ == "__main__":
    typer.run(main)

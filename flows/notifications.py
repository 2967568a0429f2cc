"""Set up, once, who is told of a night that failed or did not come.

``python -m flows.notifications https://hooks.example.org/lidar`` makes two automations on the
Prefect server, which post ``{"text": ...}`` to that address; called again, it replaces them. Chat
services understand this; mail and others are chosen in Prefect's pages, for the same automations.
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

BLOCK = "lidarops-operators"
FAILED = "lidarops: a run failed"
ABSENT = "lidarops: no night was completed"

_BODY = "{{ flow_run.name }} is {{ flow_run.state.name }}: {{ flow_run.state.message }}"


def automations(block: UUID, *, within: timedelta) -> list[Automation]:
    """Describe the automations.

    Parameters
    ----------
    block : UUID
        The notification block that is used.
    within : timedelta
        Time in which one nightly run must be completed.

    Returns
    -------
    list of Automation
    """
    ended_badly = EventTrigger(
        expect={f"prefect.flow-run.{state}" for state in ("Failed", "Crashed", "TimedOut")},
        match_related=_tagged("lidarops"),
        posture=Posture.Reactive,
        threshold=1,
    )
    absent = EventTrigger(
        expect={"prefect.flow-run.Completed"},
        match_related=_tagged("nightly"),
        posture=Posture.Proactive,
        threshold=1,
        within=within,
    )
    return [
        Automation(
            name=FAILED,
            trigger=ended_badly,
            actions=[SendNotification(block_document_id=block, subject=FAILED, body=_BODY)],
        ),
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


def _tagged(tag: str) -> ResourceSpecification:
    return ResourceSpecification.model_validate(
        {"prefect.resource.id": f"prefect.tag.{tag}", "prefect.resource.role": "tag"}
    )


def main(
    url: Annotated[str, typer.Argument(help="of a web hook")],
    hours: Annotated[float, typer.Option(min=1, help="in which a night must be completed")] = 26.0,
) -> None:
    """Tell somebody of runs that fail, and of nights without a run."""
    hook = CustomWebhookNotificationBlock(
        name=BLOCK, url=url, json_data={"text": "{{subject}}\n{{body}}"}
    )
    # Prefect types what may also be awaited as either.
    block = cast("UUID", hook.save(BLOCK, overwrite=True))
    for automation in automations(block, within=timedelta(hours=hours)):
        try:
            cast("Automation", Automation.read(name=automation.name)).delete()
        except ValueError:
            typer.echo(f"new: {automation.name}")
        automation.create()


if __name__ == "__main__":
    typer.run(main)

"""Set up notifications of nightly runs that failed or are missing.

``python -m flows.notifications https://hooks.example.org/lidar`` creates three automations on the
Prefect server, which post ``{"text": ...}`` to that address; a further call replaces them. Chat
services accept this format; mail and others can be selected in Prefect's pages, for the same
automations. ``--failures`` adds a fourth, for runs in the state `flows.WITH_FAILURES`.
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

from flows import NO_FILES, WITH_FAILURES

BLOCK = "lidarops-operators"
FAILED = "lidarops: a run failed"
ABSENT = "lidarops: no nightly run was completed"
MISSING = "lidarops: an instrument has no new files"
COMPLETED_WITH_FAILURES = "lidarops: a run completed with failures"

_NO_FILES = (
    "{{ event.payload.instrument }} of {{ event.payload.campaign }}: {{ event.payload.message }}"
)
_BODY = "{{ flow_run.name }} is {{ flow_run.state.name }}: {{ flow_run.state.message }}"


def automations(block: UUID, *, within: timedelta, failures: bool = False) -> list[Automation]:
    """Return the automations.

    Parameters
    ----------
    block : UUID
        Id of the notification block to use.
    within : timedelta
        Time after a completed nightly run within which the next one must be completed.
    failures : bool
        Whether to report also runs that were completed with failures.

    Returns
    -------
    list of Automation
    """
    completed = _events("Completed", WITH_FAILURES)
    # After each completed run of an archive the next one is expected: time counts from that run,
    # and another archive that runs hides nothing.
    absent = EventTrigger(
        after=completed,
        expect=completed,
        for_each={"related:deployment:prefect.resource.id"},
        match_related=_tagged("nightly"),
        posture=Posture.Proactive,
        threshold=1,
        within=within,
    )
    return [
        _told(block, FAILED, _events("Failed", "Crashed", "TimedOut")),
        _told(block, MISSING, {NO_FILES}, _NO_FILES),
        *([_told(block, COMPLETED_WITH_FAILURES, _events(WITH_FAILURES))] if failures else []),
        Automation(
            name=ABSENT,
            trigger=absent,
            actions=[
                SendNotification(
                    block_document_id=block,
                    subject=ABSENT,
                    body="{{ deployment.name }} completed no run for "
                    f"{within} after {{{{ flow_run.name }}}}: check that a worker runs.",
                )
            ],
        ),
    ]


def _told(block: UUID, name: str, events: set[str], body: str = _BODY) -> Automation:
    """Return an automation that reports every one of some events."""
    trigger = EventTrigger(
        expect=events,
        match_related=_tagged("lidarops"),
        posture=Posture.Reactive,
        threshold=1,
    )
    notification = SendNotification(block_document_id=block, subject=name, body=body)
    return Automation(name=name, trigger=trigger, actions=[notification])


def _events(*states: str) -> set[str]:
    return {f"prefect.flow-run.{state}" for state in states}


def _tagged(tag: str) -> ResourceSpecification:
    return ResourceSpecification.model_validate(
        {"prefect.resource.id": f"prefect.tag.{tag}", "prefect.resource.role": "tag"}
    )


def main(
    url: Annotated[str, typer.Argument(help="URL of a web hook.")],
    hours: Annotated[
        float, typer.Option(min=1, help="Hours within which a nightly run must be completed.")
    ] = 26.0,
    *,
    failures: Annotated[
        bool, typer.Option("--failures", help="Also report runs that were completed with failures.")
    ] = False,
) -> None:
    """Send notifications of failed runs, and of nights without a run."""
    hook = CustomWebhookNotificationBlock(
        name=BLOCK, url=url, json_data={"text": "{{subject}}\n{{body}}"}
    )
    # Prefect types the result as value or awaitable.
    block = cast("UUID", hook.save(BLOCK, overwrite=True))
    new = automations(block, within=timedelta(hours=hours), failures=failures)
    replaced = {name for name in (FAILED, COMPLETED_WITH_FAILURES, ABSENT) if _removed(name)}
    for automation in new:
        if automation.name not in replaced:
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

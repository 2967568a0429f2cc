"""What `lidarops plan` shows of a scene by default: a screen of text, whose words stay whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

from lidarops.cli.app import say, wrapped
from lidarops.figures.wording import counted
from lidarops.kinds import kinds

if TYPE_CHECKING:
    from lidarops.records import Plan
    from lidarops.run.staleness import Judgement

_REASONS: Final = 3
"""Reasons of refused files that fit on the screen."""


def scene_title(judged: Judgement) -> str:
    """Return the name of a scene with its numbers of files."""
    scene = judged.scene
    return f"{scene.id}: {len(scene.granules)} granules, {len(scene.dark)} dark"


def show_scene(judged: Judgement, needs: str, *, plan: bool) -> None:
    """Print a scene: what is to be made and why, its steps, and what is left out.

    Parameters
    ----------
    judged : Judgement
    needs : str
        Memory.
    plan : bool
        Whether steps are shown; a scene without anything to be made is left out otherwise.
    """
    stale = list(
        grouped((product.kind, product.reason, product.channel) for product in judged.stale)
    )
    if not plan and not stale and not judged.failure:
        return
    _say(f"{scene_title(judged)}, plan {judged.requested.hash[:12]}", "")
    _say(needs, "  ")
    _say("to be made:" if stale else "to be made: nothing", "  ")
    for kind, channels, reason in stale:
        _say(f"{kind} {channels}: {reason}", "    ")
    if judged.failure:
        held = "; not tried again, because nothing has changed" if judged.held else ""
        _say(f"failed before{held}: {judged.failure.error}", "  ")
    if plan:
        _say_steps(judged.requested)


def _say_steps(plan: Plan) -> None:
    from lidarops.scene.case import REQUEST
    from lidarops.scene.channels import READ_STEP

    names = dict.fromkeys(step.name for step in plan.steps)
    if names:
        _say(f"steps: {', '.join(names)}", "  ")
    missed = [left for left in plan.left_out if left.name in kinds() and left.rule != REQUEST]
    for name, channels, reason in grouped(
        (left.name, left.reason, left.channel) for left in missed
    ):
        _say(f"requested, but left out: {name} {channels}: {reason}", "  ")
    for channels, reason in _unread(plan, {left.channel for left in missed}):
        _say(f"without product: {channels}: {reason}", "  ")
    warned = [step for step in plan.steps if step.warning]
    for name, channels, warning in grouped(
        (step.name, step.warning, step.channel) for step in warned
    ):
        _say(f"warning: {name} {channels}: {warning}", "  ")
    shown = {*kinds(), READ_STEP}
    others = dict.fromkeys(left.name for left in plan.left_out if left.name not in shown)
    if others:
        _say(f"left out, of some channels: {', '.join(others)}", "  ")


def _unread(plan: Plan, told: Container[str]) -> Iterator[tuple[str, str]]:
    """Yield channels that the campaign names and that are not read, with the reason.

    Without those of which a product is shown as left out.
    """
    from lidarops.scene.case import REQUEST
    from lidarops.scene.channels import READ_STEP

    unread = (
        left
        for left in plan.left_out
        if left.name == READ_STEP and left.rule != REQUEST and left.channel not in told
    )
    for _, channels, reason in grouped((left.name, left.reason, left.channel) for left in unread):
        yield channels, reason


def show_refused(reasons: Sequence[str]) -> None:
    """Print the number of refused files, and of each reason."""
    if not reasons:
        return
    _say(f"{counted(len(reasons), 'file')} refused (lidarops catalog names them):", "")
    frequent = Counter(reasons).most_common(_REASONS)
    for reason, count in frequent:
        _say(f"{counted(count, 'file')}: {reason}", "  ")
    rest = len(reasons) - sum(count for _, count in frequent)
    if rest:
        _say(f"{counted(rest, 'file')}: other reasons", "  ")


def show_count(stale: int, scenes: int | None) -> None:
    """Print how many scenes are stale, of how many if all were judged, and how to see more."""
    _say(f"{counted(stale, 'stale scene')}{'' if scenes is None else f' of {scenes}'}", "")
    _say("--all shows settings and reasons of every step; --json shows everything.", "")


def grouped(lines: Iterable[tuple[str, str, str]]) -> Iterator[tuple[str, str, str]]:
    """Yield name, channels and text for lines of name, text and channel, grouped by name."""
    channels: dict[str, dict[str, dict[str, None]]] = {}
    for name, text, channel in lines:
        channels.setdefault(name, {}).setdefault(text, {})[channel] = None
    for name, texts in channels.items():
        for text, names in texts.items():
            yield name, ", ".join(filter(None, names)), text


def _say(text: str, indent: str) -> None:
    for line in wrapped(text, indent):
        say(line)

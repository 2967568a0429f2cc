"""The command that shows scenes, their plans, and what is stale.

By default a screen of text, with a block for each instrument and period of its facts; with --all
tables of all steps of each scene.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer

from lidarops.cli import options
from lidarops.cli.app import (
    NO_SCENE,
    Table,
    command,
    exit_with_status,
    finding_tables,
    findings_document,
    loaded_campaign,
    say,
    say_wrapped,
    selection_of,
    show_rows,
    show_tables,
    wrapped,
)
from lidarops.figures.wording import counted, listed
from lidarops.kinds import kinds
from lidarops.records import without_numbers

if TYPE_CHECKING:
    from lidarops.campaign.model import Campaign
    from lidarops.records import Granule, LeftOut, Plan, PlannedStep, Scene
    from lidarops.run.options import Selection
    from lidarops.run.staleness import Judgement, Stale


_REASONS: Final = 3
"""Reasons of refused files that fit on the screen."""
_SCREEN: Final = 25
"""Lines about scenes, without --all."""
_LEAST: Final = 4
"""Lines about one instrument in one period, at least."""
_NUMBER: Final = re.compile(r"(?<![\w.])-?\d[\d.]*")
"""A number, but not that in the name of a channel or a file."""
_FEW: Final = 5
"""Rows of a table of findings, without --all."""
_LINES: Final = 45
"""Lines about scenes, refused files and in tables, without --all."""


@command("plan")
def show_plan(
    campaign: options.Campaign = Path(),
    archive: options.Archive = None,
    out: options.Out = None,
    catalog: options.Catalog = None,
    instrument: options.Instruments = None,
    station: options.Stations = None,
    product: options.Products = None,
    since: options.Since = None,
    until: options.Until = None,
    stale: Annotated[
        bool, typer.Option("--stale", help="Show only the products to be made, and why.")
    ] = False,
    everything: Annotated[
        bool,
        typer.Option("--all", help="Show settings and reasons of every step, and all left out."),
    ] = False,
    wait: options.Wait = 0.0,
    all_steps: options.AllSteps = False,
    as_json: options.Json = False,
) -> None:
    """Show scenes, their steps, what is left out and what is stale, and why. Keeps nothing.

    Makes no folder: without an output folder the catalog is made for the moment. Of each instrument
    with something to be made, the first files are processed: what has no usable value in them is
    named with the setting.

    Shows a screen of summaries, one for each instrument and period of its facts, with the memory
    that a process needs for a scene; with --all every step of each scene with its settings and
    reasons. Exit code 1 if a file is refused, a scene cannot be planned, failed before or gave no
    usable value, a pattern or channel is in no file, or headers contradict a station.

    Example: lidarops plan catalogs/demo.yaml
    """
    settings = loaded_campaign(campaign, archive, out, catalog, all_steps=all_steps)
    selection = selection_of(instrument, station, product, since, until)
    shown = Shown(stale=stale, everything=everything, as_json=as_json)
    show_scenes(settings, selection, shown, wait=wait)


class Shown(NamedTuple):
    """What is shown of scenes, and whether fresh or frozen ones would be made, too."""

    stale: bool = False
    everything: bool = False
    as_json: bool = False
    force: bool = False
    thaw: bool = False


def show_scenes(campaign: Campaign, selection: Selection, shown: Shown, *, wait: float) -> None:
    """Show scenes, and exit with 1 where something is not as it should be; see `show_plan`."""
    from lidarops.catalog.database import without_writing

    with without_writing(campaign) as planned:
        _plan(planned, selection, shown, wait)


def _plan(settings: Campaign, selection: Selection, shown: Shown, wait: float) -> None:
    from lidarops.catalog.raw_files import acknowledged
    from lidarops.catalog.store import Store
    from lidarops.run.archive import assess, earlier_problems, survey
    from lidarops.run.options import selects_no_scene

    findings = survey(settings, selection=selection, wait=wait)
    with Store(settings.catalog_url, settings.name) as store:
        refused = acknowledged(settings, store.refused())
    set_aside: list[Granule] = []
    judgements = assess(
        settings,
        selection=selection,
        everything=not shown.stale,
        update=False,
        force=shown.force,
        thaw=shown.thaw,
        set_aside=set_aside,
    )
    earlier = earlier_problems(settings, selection)
    scenes = []
    first: dict[str, Scene] = {}
    blocks: dict[tuple[str, datetime | None], list[Judgement]] = {}
    count = to_be_made = 0
    failed = False
    for judged in judgements:
        count += 1
        to_be_made += bool(judged.stale)
        if judged.stale and judged.scene.granules and not judged.scene.members:
            first.setdefault(judged.scene.instrument, judged.scene)
        failed |= judged.held or not judged.planned
        if judged.due or judged.held:
            for problems in earlier:
                problems.pop(judged.scene.id, None)
        if shown.as_json:
            scenes.append(_plain(judged))
        elif shown.everything:
            _show_judged(judged, stale=shown.stale)
        elif not shown.stale or judged.stale or judged.failure:
            period = _period(settings, judged.scene)
            blocks.setdefault((judged.scene.instrument, period), []).append(judged)
    empty = _empty(settings, first.values())
    no_scene = not count and selects_no_scene(settings, selection)
    if shown.as_json:
        document = {
            "scenes": scenes,
            "no_scene_selected": no_scene,
            "failed_before": earlier[0],
            "without_a_usable_value": list(earlier[1]),
            "refused_files": {granule.path: granule.reason for granule in refused},
            "files_set_aside": {granule.path: granule.reason for granule in set_aside},
            **findings_document(findings),
            "lacking_metadata": list(settings.metadata.lacking),
            "empty_in_first_file": empty,
        }
        typer.echo(json.dumps(document, indent=2))
    else:
        printed = _show_blocks([_block(group, shown) for group in blocks.values()])
        if no_scene:
            say(NO_SCENE)
        printed += _show_refused([granule.reason for granule in refused])
        columns = "product", "flag", "values", "settings"
        tables: list[Table] = [
            ("Without a usable value in the first files", columns, empty),
            ("Not used", ("file", "reason"), ((one.path, one.reason) for one in set_aside)),
        ]
        tables += [*finding_tables(findings), *_earlier(*earlier)]
        show_tables(tables, None if shown.everything else _FEW, _LINES - printed)
        lacking = ", ".join(settings.metadata.lacking)
        words = f"metadata of the campaign: products will lack {lacking}"
        say_wrapped(words if lacking else "", "")
        # With --stale, fresh scenes are not judged.
        say_wrapped(
            counted(to_be_made, "stale scene") + ("" if shown.stale else f" of {count}"), ""
        )
        say_wrapped("--all shows settings and reasons of every step; --json shows everything.", "")
    unexpected = (not granule.is_expected for granule in (*refused, *set_aside))
    exit_with_status(failed=any((failed, *unexpected, *earlier, findings.failed)))


def _empty(campaign: Campaign, scenes: Collection[Scene]) -> list[tuple[str, str, str, str]]:
    """Return what the first files of some scenes leave empty, and why; not of a store."""
    if not scenes or "://" in campaign.archive:
        return []
    from lidarops.run.first_look import empty_in_first_files

    return list(empty_in_first_files(campaign, scenes))


def _earlier(failed: Mapping[str, str], unusable: Mapping[str, str]) -> Iterator[Table]:
    """Yield the scenes that are not tried again."""
    unchanged = "not tried again, because nothing has changed"
    yield f"Failed before; {unchanged}", ("scene", "error"), failed.items()
    yield f"Without a usable value; {unchanged}", ("scene", "problem"), unusable.items()


def _memory(judged: Judgement) -> dict[str, float]:
    """Return the memory that a scene needs, in bytes, for what is to be made and for everything."""
    from lidarops.scene.job import scene_memory

    return {
        "to_be_made": scene_memory(judged.scene, judged.needed()).total,
        "everything": scene_memory(judged.scene, judged.requested).total,
    }


def _show_judged(judged: Judgement, *, stale: bool) -> None:
    """Print all of a scene."""
    memory = _memory(judged)["to_be_made" if stale else "everything"]
    scene = judged.scene
    title = f"{scene.id}: {len(scene.granules)} files, {len(scene.dark)} dark"
    title += f", about {memory / 1e6:.0f} MB of memory"
    if not stale:
        _show_plan(title, judged.requested)
    rows = _stale_rows(judged)
    if judged.failure:
        unchanged = "not tried again, because nothing has changed: " if judged.held else ""
        rows.append(("none", "", f"{unchanged}{judged.failure.error}"))
    show_rows(f"{title}: to be made", ("product", "channels", "reason"), rows)
    for what, products in _kept(judged):
        rows = [(product.kind, product.channel, product.reason) for product in products]
        show_rows(f"{scene.id}: {what}", ("product", "channel", "reason"), rows)


def _show_plan(title: str, plan: Plan) -> None:
    """Print the steps of a plan, and what it leaves out; equal lines of channels are one."""
    columns = ("step", "channels", "what, and why")
    steps = _grouped(
        (step.name, _words(_effect(step, plan), step, needs), step.channel)
        for step, needs in zip(plan.steps, _needs(plan), strict=True)
    )
    show_rows(f"{title}, plan {plan.hash[:12]}", columns, steps)
    left_out = _grouped((left.name, _words("", left, ""), left.channel) for left in plan.left_out)
    show_rows("Left out", columns, left_out)


def _words(effect: str, entry: PlannedStep | LeftOut, needs: str) -> str:
    from lidarops.figures.wording import decided_on
    from lidarops.records import PlannedStep

    number = decided_on(entry.number)
    rule = f"[{entry.rule} {number}]" if number else f"[{entry.rule}]" if entry.rule else ""
    member = f"of {entry.instrument}" if entry.instrument else ""
    warning = entry.warning if isinstance(entry, PlannedStep) else ""
    words = "; ".join(filter(None, (entry.reason, warning)))
    reason = " ".join(filter(None, (words, rule)))
    return "; ".join(filter(None, (member, effect, reason, needs)))


def _needs(plan: Plan) -> Iterator[str]:
    """Yield, for each step, the steps whose outputs it takes, with the channel if it is another.

    For a product, also the channels with which it is compared.
    """
    from lidarops.records import products_of
    from lidarops.scene.dependence import needed_places

    for step, places in zip(plan.steps, needed_places(plan.steps), strict=True):
        others = [plan.steps[place] for place in places]
        names = [
            other.name if other.channel in ("", step.channel) else f"{other.channel}/{other.name}"
            for other in others
            if other not in plan.products
        ]
        compared = [other.channel for other in products_of(others)]
        words = {"after": names, "compared with": compared}
        yield "; ".join(f"{word} {', '.join(those)}" for word, those in words.items() if those)


def _effect(step: PlannedStep, plan: Plan) -> str:
    from lidarops.reports.rejections import settings_in_words
    from lidarops.scene.retrieval import idle_window

    idle = idle_window(step, plan.steps)
    return f"no effect: {idle}" if idle else ", ".join(settings_in_words(step))


def _stale_rows(judged: Judgement) -> list[tuple[str, str, str]]:
    """Return kind, channels and reason of what is to be made."""
    return list(_grouped((made.kind, made.reason, made.channel) for made in judged.stale))


def _kept(judged: Judgement) -> tuple[tuple[str, Sequence[Stale]], ...]:
    """Return the stale products that are not replaced, with the reason."""
    return (
        ("frozen, would be replaced with --thaw", judged.frozen),
        ("kept, because raw files are lost", judged.kept),
    )


def _plain(judged: Judgement) -> dict[str, Any]:
    from lidarops.records import entry_as_dict
    from lidarops.scene.retrieval import idle_window

    stale, frozen, kept = (
        [{"kind": each.kind, "channel": each.channel, "reason": each.reason} for each in products]
        for products in (judged.stale, judged.frozen, judged.kept)
    )
    plan = judged.requested
    idle = [idle_window(step, plan.steps) for step in plan.steps]
    steps = [
        {**entry_as_dict(step), **({"no_effect": why} if why else {})}
        for step, why in zip(plan.steps, idle, strict=True)
    ]
    return {
        **plan.as_dict(),
        "hash": plan.hash,
        "steps": steps,
        "stale": stale,
        "frozen": frozen,
        "kept": kept,
        "fresh": judged.fresh,
        "failure": asdict(judged.failure) if judged.failure else None,
        "held": judged.held,
        "estimated_memory_bytes": _memory(judged),
    }


def _period(campaign: Campaign, scene: Scene) -> datetime | None:
    """Return the begin of the facts that apply to a scene; None of a network or a month."""
    if scene.instrument not in campaign.instruments or not scene.granules:
        return None
    start = scene.granules[0].start or scene.start
    return campaign.instruments[scene.instrument].facts_at(start).valid_from


def _block(group: Sequence[Judgement], shown: Shown) -> list[str]:
    """Return title and lines about the scenes of one instrument in one period of its facts."""
    first, last = group[0].scene, group[-1].scene
    title = f"{first.id}: "
    if len(group) > 1:
        title = f"{first.id} to {last.id}: {counted(len(group), 'scene')}, "
    files = zip(*((j.scene.granules, j.scene.dark) for j in group), strict=True)
    granules, dark = (sum(map(len, part)) for part in files)
    memory = max(_memory(j)["to_be_made" if shown.stale else "everything"] for j in group)
    title += f"{granules} files, {dark} dark, about {memory / 1e6:.0f} MB of memory"
    alike: dict[str, dict[str, list[tuple[str, datetime]]]] = {}
    for judged in group:
        for line in _scene_lines(judged, plan=not shown.stale):
            kinds_of_line = alike.setdefault(line.partition(":")[0], {})
            here = line, judged.scene.start
            kinds_of_line.setdefault(_NUMBER.sub("#", line), []).append(here)
    lines = []
    for told in (told for kinds_of_line in alike.values() for told in kinds_of_line.values()):
        said, starts = zip(*told, strict=True)
        others = ", and the like" if len(set(said)) > 1 else ""
        share = f" ({len(said)} of {len(group)} scenes)" if len(said) < len(group) else ""
        if share and said[0].startswith("warning"):
            share = f"{share[:-1]}: {listed({f'{start:%Y-%m-%d}' for start in starts})})"
        lines.append(f"{said[0]}{others}{share}")
    return [title, *lines]


def _show_blocks(blocks: Sequence[Sequence[str]]) -> int:
    """Print blocks of a title and lines each, until the screen is full: so many lines."""
    printed = 0
    room = max(_SCREEN // max(len(blocks), 1), _LEAST)
    for place, (title, *lines) in enumerate(blocks):
        if printed >= _SCREEN:
            words = f"{counted(len(blocks) - place, 'further block')} like these (--all)"
            return printed + say_wrapped(words, "")
        printed += say_wrapped(title, "")
        end = printed + room
        for number, line in enumerate(lines):
            if number and printed + len(wrapped(line, "  ")) > end:
                left = counted(len(lines) - number, "further line")
                printed += say_wrapped(f"{left} (--all)", "  ")
                break
            printed += say_wrapped(line, "  ")
    return printed


def _scene_lines(judged: Judgement, *, plan: bool) -> Iterator[str]:
    """Yield what is to be made of a scene and why; with `plan` its steps and what is left out."""
    stale = _stale_rows(judged)
    if not stale:
        yield "to be made: nothing"
    for kind, channels, reason in stale:
        yield f"to be made: {kind} {channels}: {reason}"
    if judged.failure:
        held = "; not tried again, because nothing has changed" if judged.held else ""
        yield f"failed before{held}: {judged.failure.error}"
    if plan:
        yield from _step_lines(judged.requested)
    for what, products in _kept(judged):
        for kind, channels, reason in _grouped((p.kind, p.reason, p.channel) for p in products):
            yield f"{what}: {kind} {channels}: {reason}"


def _step_lines(plan: Plan) -> Iterator[str]:
    from lidarops.reports.rejections import settings_in_words
    from lidarops.scene.case import READ_STEP, REQUEST

    requested = [left for left in plan.left_out if left.rule != REQUEST]
    missed = [left for left in requested if left.name in kinds()]
    told = {left.channel for left in missed}
    unread = [left for left in requested if left.name == READ_STEP and left.channel not in told]
    warned = [step for step in plan.steps if step.warning]
    for words, entries in (
        ("requested, but left out: {0} {1}: {2}", missed),
        ("without product: {1}: {2}", unread),
    ):
        for row in _grouped((left.name, left.reason, left.channel) for left in entries):
            yield f"{words.format(*row)}"
    for name, channels, warning in _grouped((w.name, w.warning, w.channel) for w in warned):
        yield f"warning: {name} {channels}: {warning}"
    names = dict.fromkeys(step.name for step in plan.steps)
    if names:
        yield f"steps: {', '.join(names)}"
    near = (step for step in plan.steps if step.name == "overlap")
    states = (", ".join((*settings_in_words(step), step.reason)) for step in near)
    yield from dict.fromkeys(f"overlap: {each}" for each in states)
    shown = {*kinds(), READ_STEP}
    others = dict.fromkeys(left.name for left in plan.left_out if left.name not in shown)
    if others:
        yield f"skipped for some channels: {', '.join(others)}"


def _show_refused(reasons: Sequence[str]) -> int:
    """Print the number of refused files, and of each reason, in so many lines."""
    if not reasons:
        return 0
    said = say_wrapped(
        f"{counted(len(reasons), 'file')} refused (lidarops catalog --all names them):", ""
    )
    kinds_of_reason = Counter(map(without_numbers, reasons))
    examples = {without_numbers(reason): reason for reason in reversed(reasons)}
    frequent = kinds_of_reason.most_common(_REASONS)
    for kind, count in frequent:
        others = ", and the like" if reasons.count(examples[kind]) < count else ""
        said += say_wrapped(f"{counted(count, 'file')}: {examples[kind]}{others}", "  ")
    rest = len(reasons) - sum(count for _, count in frequent)
    return said + (say_wrapped(f"{counted(rest, 'file')}: other reasons", "  ") if rest else 0)


def _grouped(lines: Iterable[tuple[str, str, str]]) -> Iterator[tuple[str, str, str]]:
    """Yield name, channels and text for lines of name, text and channel, grouped by name."""
    channels: dict[str, dict[str, dict[str, None]]] = {}
    for name, text, channel in lines:
        channels.setdefault(name, {}).setdefault(text, {})[channel] = None
    for name, texts in channels.items():
        for text, names in texts.items():
            yield name, ", ".join(filter(None, names)), text

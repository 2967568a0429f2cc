"""The tables of a run's report, made from the run record alone; no files are read."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Final, TypeVar

from lidarops.figures.wording import (
    SEVERITIES,
    change_in_words,
    counted,
    decided_on,
    duration,
    listed,
    percent,
    size,
    verdicts_in_words,
)
from lidarops.flags import PLACES
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.variables import is_retrieved
from lidarops.records import (
    Grade,
    Granule,
    LeftOut,
    PlannedStep,
    Role,
    RunRecord,
    SceneOutcome,
    Verdicts,
)
from lidarops.reports.findings import disagreement_rows, finding_rows, scene_note_rows, unmade_words
from lidarops.scene.retrieval import idle_window

_T = TypeVar("_T")
_UNKNOWN: Final = "bit unknown to this version of lidarops"
_LAST: Final = 1 << PLACES
"""Place of unknown bits in a table."""

Row = dict[str, Any]
"""Values of a row of a table, by column."""


def changed_products(record: RunRecord) -> list[Row]:
    """Return how products differ from those that they replace, the largest changes first."""
    changed = [
        (product.change, scene, product)
        for scene in record.scenes
        for product in scene.products
        if product.change is not None
    ]
    order = list(Grade)
    return [
        {
            "scene": scene.scene,
            "product": f"{product.kind} {product.channel}",
            "version": product.stamp.version,
            "change": change.grade.value,
            "difference": change_in_words(change),
            "cause": "; ".join(change.causes),
        }
        for change, scene, product in sorted(changed, key=lambda row: -order.index(row[0].grade))
    ]


def summary(record: RunRecord) -> list[tuple[str, str]]:
    """Return the terms and values at the head of the report."""
    done = [scene for scene in record.scenes if not scene.error]
    failed, internal = len(failed_scenes(record)), len(internal_errors(record))
    took = sum(scene.cpu_seconds for scene in record.scenes)
    ended_internally = f", {internal:,} with an internal error" if internal else ""
    processed = sum(
        scene.granules - sum(file.role is Role.SIGNAL for file in scene.refused) for scene in done
    )
    products = Counter(p.kind for scene in record.scenes for p in scene.products)
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in sorted(products.items()))
    return [
        ("Campaign", f"{record.title} ({record.campaign})"),
        ("Run", record.id),
        ("Version", record.version),
        ("Started", moment(record.started)),
        ("Duration", duration((record.finished - record.started).total_seconds())),
        *([("CPU time of scenes", duration(took))] if took else []),
        (
            "Scenes",
            counted(len(record.scenes), "scene") + f", {failed:,} failed{ended_internally}",
        ),
        ("Products", f"{products.total():,}" + (f": {kinds}" if kinds else "")),
        ("Files", f"{processed:,} processed, {_number_refused(record):,} refused"),
        *(
            (
                f"Quality, {kind}",
                f"{verdicts_in_words(verdicts)} of {counted(verdicts.values, 'value')}",
            )
            for kind, verdicts in _verdicts_by_kind(record)
        ),
    ]


def findings(record: RunRecord) -> list[tuple[str, str, str, str]]:
    """Return instrument, subject and finding, and "yes" where it fails the run."""
    rows = (
        *finding_rows(record.findings),
        *disagreement_rows(record.scenes),
        *scene_note_rows(record.scenes),
    )
    return [(r.instrument, r.subject, r.problem, "yes" if r.fails else "") for r in rows]


def hashes(record: RunRecord) -> list[tuple[str, str, str, str]]:
    """Return scene, plan or product, size and sha256."""
    rows = []
    for scene in record.scenes:
        if scene.plan:
            rows.append((scene.scene, "plan", "", scene.plan.hash))
        rows += [(scene.scene, p.path, size(p.size), p.sha256) for p in scene.products]
    return rows


def failed_scenes(record: RunRecord) -> list[SceneOutcome]:
    """Return the scenes that failed, without those that ended with an internal error."""
    return [scene for scene in record.scenes if scene.error and not scene.internal]


def failed_rows(record: RunRecord) -> list[Row]:
    """Return the failed scenes with their reasons."""
    return [
        {"scene": scene.scene, "station": scene.station, "instrument": scene.instrument,
         "granules": scene.granules, "reason": scene.error}
        for scene in failed_scenes(record)
    ]  # fmt: skip


def internal_errors(record: RunRecord) -> list[SceneOutcome]:
    """Return the scenes that ended with an internal error, a bug of lidarops."""
    return [scene for scene in record.scenes if scene.internal]


def verdict(record: RunRecord) -> str:
    """Return the outcome of the run in words: problems, what to look at, and what went well."""
    *first, last = [*_problems(record)] or [""]
    sentences = [f"{', '.join(first)} and {last}" if first else last, *_cautions(record)]
    if not record.scenes:
        sentences.append("There was no scene to process")
    elif not last:
        sentences.append("All files were read")
    return " ".join(f"{words[0].upper()}{words[1:]}." for words in sentences if words)


def outcome_class(record: RunRecord) -> str:
    """Return ``bad`` for a run with problems, ``care`` where there is something to look at."""
    if record.failed:
        return "bad"
    return "care" if any(_cautions(record)) else "good"


def _problems(record: RunRecord) -> Iterator[str]:
    """Yield what makes a run fail."""
    if record.cut_short:
        yield "the run was killed or met a full disk, so that only scenes that ended are listed"
    failed, internal = len(failed_scenes(record)), len(internal_errors(record))
    if internal:
        yield f"{counted(internal, 'scene')} ended with an internal error"
    if failed:
        yield f"{counted(failed, 'scene')} failed"
    refused = _number_refused(record)
    if refused:
        yield f"{counted(refused, 'file')} refused"
    unusable = [scene.scene for scene in record.scenes if scene.unusable]
    if unusable:
        yield f"{counted(len(unusable), 'scene')} without a usable value: {listed(unusable)}"
    no_product = len(record.empty_scenes) + record.more_empty_scenes
    if no_product:
        yield f"{counted(no_product, 'scene')} without product"
    unmet = record.findings.unmet
    nowhere = {(request.instrument, request.channel) for request in unmet if request.nowhere}
    if nowhere:
        channels = listed({channel for _, channel in nowhere})
        yield f"{counted(len(nowhere), 'requested channel')} in no file: {channels}"
    contradicting = {row.instrument for row in finding_rows(record.findings) if row.fails}
    if contradicting:
        yield f"the archive is not what the campaign states of {listed(contradicting)}"


def _cautions(record: RunRecord) -> Iterator[str]:
    """Yield what fails no run, but needs a look."""
    products = [product for scene in record.scenes for product in scene.products]
    empty = sum(product.usable == 0 for product in products)
    if empty:
        have = "has" if empty == 1 else "have"
        yield f"{empty:,} of {counted(len(products), 'product')} {have} no usable value"
    disagreeing = sorted({row.subject for row in disagreement_rows(record.scenes)})
    if disagreeing:
        yield f"Channels that measure the same disagree: {listed(disagreeing)}"
    yield from (f"{row.instrument}: {row.problem}" for row in scene_note_rows(record.scenes))
    unmade = unmade_words(record.findings)
    if unmade:
        yield f"Requested, but made in no scene: {listed(unmade)}"


def _number_refused(record: RunRecord) -> int:
    """Return the number of refused files; several scenes may have refused a dark file."""
    of_scenes = (scene.refused for scene in record.scenes)
    return len({granule.path for granule in itertools.chain(record.refused, *of_scenes)})


def instruments(record: RunRecord) -> list[Row]:
    """Return one row per instrument with a scene or a refused granule."""
    scenes: dict[str, list[SceneOutcome]] = defaultdict(list)
    for scene in record.scenes:
        scenes[scene.instrument].append(scene)
    refused = Counter(granule.instrument for granule in record.refused)
    return [
        _instrument_row(name, scenes[name], refused[name]) for name in sorted({*scenes, *refused})
    ]


def left_out(record: RunRecord) -> list[Row]:
    """Group steps that were left out by step and reason, the most frequent of a step first."""
    return _decisions(record, _left_out)


def carried_out(record: RunRecord) -> list[Row]:
    """Group steps that were carried out by step and reason, the most frequent of a step first."""
    return _decisions(record, _carried_out)


def _carried_out(scene: SceneOutcome) -> Iterator[PlannedStep]:
    steps = scene.plan.steps if scene.plan else ()
    for step in steps:
        idle = idle_window(step, steps)
        words = (step.reason, step.warning, idle and f"no effect: {idle}")
        yield replace(step, reason="; ".join(filter(None, words)))


def _left_out(scene: SceneOutcome) -> Iterator[LeftOut]:
    yield from scene.plan.left_out if scene.plan else ()
    yield from scene.left_out


def _decisions(
    record: RunRecord, items_of: Callable[[SceneOutcome], Iterable[PlannedStep | LeftOut]]
) -> list[Row]:
    groups = defaultdict[tuple[str, str, str], list[tuple[SceneOutcome, PlannedStep | LeftOut]]](
        list
    )
    for scene in record.scenes:
        for item in items_of(scene):
            groups[item.name, item.reason, item.rule].append((scene, item))
    rows = []
    for (step, reason, rule), alike in groups.items():
        numbers = [item.number for _, item in alike if item.number is not None]
        # One value, or the range over these scenes.
        ends = [decided_on(end(numbers)) for end in (min, max) if numbers]
        rows.append(
            {
                "step": step,
                "reason": reason,
                "rule": rule,
                "number": " to ".join(dict.fromkeys(ends)),
                "channels": listed({item.channel for _, item in alike}),
                "instruments": listed({scene.instrument for scene, _ in alike}),
                "scenes": len({scene.scene for scene, _ in alike}),
            }
        )
    return sorted(rows, key=lambda row: (row["step"], -row["scenes"], row["reason"]))


def flags(record: RunRecord) -> list[Row]:
    """Return one row per product kind and quality bit that its values carry."""
    products = [product for scene in record.scenes for product in scene.products]
    rows = []
    for kind in sorted({product.kind for product in products}):
        own = [product for product in products if product.kind == kind]
        values = sum(product.values for product in own)
        bits = {bit.word: bit for bit in (flags_of(kind) if kind in kinds() else ())}
        counts: dict[str, list[int]] = defaultdict(list)
        for name, count in (item for product in own for item in product.flagged.items()):
            if count:
                counts[name.lower()].append(count)
        for name in sorted(counts, key=lambda name: (bits.get(name, _LAST), name)):
            bit = bits.get(name)
            rows.append(
                {
                    "kind": kind,
                    "bit": name,
                    "severity": SEVERITIES[bit.severity if bit else None],
                    "description": bit.description if bit else _UNKNOWN,
                    "count": sum(counts[name]),
                    "share": percent(sum(counts[name]) / values) if values else "no value",
                    "products": len(counts[name]),
                }
            )
    return rows


def refused(record: RunRecord) -> list[Row]:
    """Group refused granules by reason, the most frequent first, with the UTC days of starts."""
    granules: dict[tuple[str, str], list[Granule]] = defaultdict(list)
    for granule in record.refused:
        granules[granule.reason, "while cataloguing"].append(granule)
    for scene in record.scenes:
        for granule in scene.refused:
            granules[granule.reason, "while processing"].append(granule)
    return [
        {
            "reason": reason or "no reason was recorded",
            "refused": when,
            "days": listed({f"{granule.start:%Y-%m-%d}" for granule in alike if granule.start})
            or "not known",
            "files": sorted({granule.path for granule in alike}),
        }
        for (reason, when), alike in _most_frequent_first(granules)
    ]


def scenes_without_product(record: RunRecord) -> list[tuple[str, list[str]]]:
    """Return each reason with the scenes that have no product for it, the most frequent first."""
    scenes: dict[str, list[str]] = defaultdict(list)
    for scene, reason in sorted(record.empty_scenes.items()):
        scenes[reason].append(scene)
    return _most_frequent_first(scenes)


def _most_frequent_first(groups: Mapping[Any, list[_T]]) -> list[tuple[Any, list[_T]]]:
    return sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))


def moment(time: datetime) -> str:
    """Return a time in UTC to the second."""
    zoned = time if time.tzinfo is None else time.astimezone(UTC)
    return f"{zoned:%Y-%m-%d %H:%M:%S} UTC"


def outcome_word(scene: SceneOutcome) -> str:
    """Return the outcome of a scene in a word or two."""
    if scene.error:
        return "internal error" if scene.internal else "failed"
    if scene.unusable:
        return "no usable value"
    return "done" if scene.products else "no product"


def _verdicts_by_kind(record: RunRecord) -> list[tuple[str, Verdicts]]:
    products = [product for scene in record.scenes for product in scene.products]
    sums = {
        kind: Verdicts.total(product.verdicts for product in products if product.kind == kind)
        for kind in sorted({product.kind for product in products})
    }
    return [(kind, verdicts) for kind, verdicts in sums.items() if verdicts.values]


def _instrument_row(name: str, scenes: Sequence[SceneOutcome], refused_before: int) -> Row:
    """Return counts of an instrument; failed scenes are those without an internal error."""
    products = [product for scene in scenes for product in scene.products]
    retrieved = [product for product in products if is_retrieved(product.kind)]
    return {
        "station": scenes[0].station if scenes else "",
        "instrument": name,
        "scenes": len(scenes),
        "failed": sum(bool(scene.error) and not scene.internal for scene in scenes),
        "internal errors": sum(bool(scene.internal) for scene in scenes),
        "granules": sum(scene.granules for scene in scenes),
        "refused": refused_before + sum(len(scene.refused) for scene in scenes),
        "products": len(products),
        "retrieved values": sum(product.values for product in retrieved),
        "quality": verdicts_in_words(Verdicts.total(product.verdicts for product in retrieved)),
    }

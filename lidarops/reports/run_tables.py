"""The tables of a run's report, made from the run record alone; no files are read."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Final, NamedTuple

from lidarops.figures.wording import (
    change_in_words,
    counted,
    decided_on,
    duration,
    percent,
    verdicts_in_words,
)
from lidarops.flags import PLACES, FlagBit, Severity
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
from lidarops.scene.choices import idle_window

_MOST_NAMES: Final = 8
"""Most names listed in one cell."""
_LAST: Final = 1 << PLACES
"""Place of unknown bits in a table."""


@dataclass(frozen=True, slots=True)
class DecisionRow:
    """A step that was carried out or left out for one reason, over all scenes where it was."""

    step: str
    reason: str
    rule: str
    """Name of the rule that decided."""
    number: str
    """Number that the rule decided on: a value, or the range over these scenes."""
    channels: str
    instruments: str
    scenes: int


@dataclass(frozen=True, slots=True)
class FlagRow:
    """Counts of one quality bit over all products of a kind."""

    kind: str
    bit: str
    severity: str
    description: str
    count: int
    share: str
    products: int


@dataclass(frozen=True, slots=True)
class RefusedRow:
    """Files that were refused for the same reason."""

    reason: str
    when: str
    """``while cataloguing`` or ``while processing``."""
    files: tuple[str, ...]
    days: str
    """UTC days on which they start, as far as their headers tell."""


@dataclass(frozen=True, slots=True)
class NoProductRow:
    """Scenes without product for the same reason."""

    reason: str
    scenes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StageRow:
    """Time of one stage over all scenes."""

    stage: str
    total: str
    share: str
    longest: str
    longest_scene: str


@dataclass(frozen=True, slots=True)
class InstrumentRow:
    """Counts over the scenes of one instrument."""

    station: str
    instrument: str
    scenes: int
    failed: int
    """Without those that ended with an internal error."""
    internal: int
    granules: int
    refused: int
    products: int
    values: int
    verdicts: Verdicts
    """Of the retrieved values."""
    seconds: float

    @property
    def quality(self) -> str:
        """Shares of good values, of those to be used with care, and of rejected ones."""
        return verdicts_in_words(self.verdicts)


class ChangeRow(NamedTuple):
    """How a product differs from the one that it replaces."""

    scene: str
    label: str
    version: int
    grade: str
    difference: str
    cause: str


def changes(record: RunRecord) -> list[ChangeRow]:
    """Return the products that were made again, the largest changes first."""
    rows = [
        (
            change.grade,
            ChangeRow(
                scene.scene,
                f"{product.kind} {product.channel}",
                product.stamp.version,
                change.grade.value,
                change_in_words(change),
                "; ".join(change.causes),
            ),
        )
        for scene in record.scenes
        for product in scene.products
        for change in [product.change]
        if change is not None
    ]
    order = list(Grade)
    return [row for _, row in sorted(rows, key=lambda pair: -order.index(pair[0]))]


def summary(record: RunRecord) -> list[tuple[str, str]]:
    """Return the terms and values at the head of the report."""
    done = [scene for scene in record.scenes if not scene.error]
    failed, internal = len(failed_scenes(record)), len(internal_errors(record))
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
        *_cpu_time(record),
        (
            "Scenes",
            counted(len(record.scenes), "scene") + f", {failed:,} failed{ended_internally}",
        ),
        ("Products", f"{products.total():,}" + (f": {kinds}" if kinds else "")),
        ("Granules", f"{processed:,} processed, {_number_refused(record):,} refused"),
        *(
            (
                f"Quality, {kind}",
                f"{verdicts_in_words(verdicts)} of {counted(verdicts.values, 'value')}",
            )
            for kind, verdicts in _verdicts_by_kind(record)
        ),
    ]


def failed_scenes(record: RunRecord) -> list[SceneOutcome]:
    """Return the scenes that failed, without those that ended with an internal error."""
    return [scene for scene in record.scenes if scene.error and not scene.internal]


def internal_errors(record: RunRecord) -> list[SceneOutcome]:
    """Return the scenes that ended with an internal error, a bug of lidarops."""
    return [scene for scene in record.scenes if scene.internal]


def _cpu_time(record: RunRecord) -> list[tuple[str, str]]:
    """Return the CPU time of scenes, if it was measured."""
    took = sum(scene.cpu_seconds for scene in record.scenes)
    return [("CPU time of scenes", duration(took))] if took else []


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
    refused = _refused_granules(record)
    if refused:
        yield refused
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


def _refused_granules(record: RunRecord) -> str:
    refused = _number_refused(record)
    return f"{counted(refused, 'granule')} refused" if refused else ""


def _number_refused(record: RunRecord) -> int:
    """Return the number of refused files; several scenes may have refused a dark file."""
    of_scenes = (scene.refused for scene in record.scenes)
    return len({granule.path for granule in itertools.chain(record.refused, *of_scenes)})


def instruments(record: RunRecord) -> list[InstrumentRow]:
    """Return one row per instrument with a scene or a refused granule."""
    stations: dict[str, str] = {}
    scenes: dict[str, list[SceneOutcome]] = defaultdict(list)
    for scene in record.scenes:
        stations.setdefault(scene.instrument, scene.station)
        scenes[scene.instrument].append(scene)
    refused = Counter(granule.instrument for granule in record.refused)
    return [
        _instrument_row(stations.get(name, ""), name, scenes[name], refused[name])
        for name in sorted({*scenes, *refused})
    ]


def left_out(record: RunRecord) -> list[DecisionRow]:
    """Group steps that were left out by step and reason, the most frequent of a step first."""
    return _decisions(record, _left_out)


def carried_out(record: RunRecord) -> list[DecisionRow]:
    """Group steps that were carried out by step and reason, the most frequent of a step first."""
    return _decisions(record, _carried_out)


def _carried_out(scene: SceneOutcome) -> Iterator[PlannedStep]:
    steps = scene.plan.steps if scene.plan else ()
    for step in steps:
        idle = idle_window(step, steps)
        reason = f"{step.words}; no effect: {idle}" if idle else step.words
        yield replace(step, reason=reason)


def _left_out(scene: SceneOutcome) -> Iterator[LeftOut]:
    yield from scene.plan.left_out if scene.plan else ()
    yield from scene.left_out


def _decisions(
    record: RunRecord, items_of: Callable[[SceneOutcome], Iterable[PlannedStep | LeftOut]]
) -> list[DecisionRow]:
    scenes: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    channels: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    names: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    numbers: dict[tuple[str, str, str], set[float]] = defaultdict(set)
    for scene in record.scenes:
        for item in items_of(scene):
            key = (item.name, item.reason, item.rule)
            scenes[key].add(scene.scene)
            channels[key].add(item.channel)
            names[key].add(scene.instrument)
            if item.number is not None:
                numbers[key].add(item.number)
    return [
        DecisionRow(
            step=key[0],
            reason=key[1],
            rule=key[2],
            number=" to ".join(dict.fromkeys(decided_on(end(numbers[key])) for end in (min, max)))
            if numbers[key]
            else "",
            channels=listed(channels[key]),
            instruments=listed(names[key]),
            scenes=len(scenes[key]),
        )
        for key in sorted(scenes, key=lambda key: (key[0], -len(scenes[key]), key[1]))
    ]


def flags(record: RunRecord) -> list[FlagRow]:
    """Return one row per product kind and quality bit that its values carry."""
    values: Counter[str] = Counter()
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    products: Counter[tuple[str, str]] = Counter()
    for scene in record.scenes:
        for product in scene.products:
            values[product.kind] += product.values
            for name, count in product.flagged.items():
                if count:
                    counts[product.kind][name.lower()] += count
                    products[product.kind, name.lower()] += 1
    rows = []
    for kind in sorted(counts):
        known = flags_of(kind) if kind in kinds() else ()
        bits = {bit.word: bit for bit in known}
        for name in sorted(counts[kind], key=lambda name: (bits.get(name, _LAST), name)):
            count = counts[kind][name]
            severity, description = _about(bits.get(name))
            rows.append(
                FlagRow(
                    kind=kind,
                    bit=name,
                    severity=severity,
                    description=description,
                    count=count,
                    share=percent(count / values[kind]) if values[kind] else "no value",
                    products=products[kind, name],
                )
            )
    return rows


def refused(record: RunRecord) -> list[RefusedRow]:
    """Group refused granules by reason, the most frequent first."""
    granules: dict[tuple[str, str], list[Granule]] = defaultdict(list)
    for granule in record.refused:
        granules[granule.reason, "while cataloguing"].append(granule)
    for scene in record.scenes:
        for granule in scene.refused:
            granules[granule.reason, "while processing"].append(granule)
    return [
        RefusedRow(
            reason or "no reason was recorded",
            when,
            tuple(sorted({granule.path for granule in alike})),
            listed({f"{granule.start:%Y-%m-%d}" for granule in alike if granule.start}),
        )
        for (reason, when), alike in sorted(
            granules.items(), key=lambda item: (-len(item[1]), item[0])
        )
    ]


def scenes_without_product(record: RunRecord) -> list[NoProductRow]:
    """Group scenes without product by reason, the most frequent first."""
    scenes: dict[str, list[str]] = defaultdict(list)
    for scene, reason in record.empty_scenes.items():
        scenes[reason].append(scene)
    return [
        NoProductRow(reason, tuple(sorted(names)))
        for reason, names in sorted(scenes.items(), key=lambda item: (-len(item[1]), item[0]))
    ]


def stages(record: RunRecord) -> list[StageRow]:
    """Return the time of each stage, in the order in which scenes list them."""
    times: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for scene in record.scenes:
        for stage, seconds in scene.seconds.items():
            times[stage].append((seconds, scene.scene))
    all_seconds = sum(seconds for rows in times.values() for seconds, _ in rows)
    rows = []
    for stage, spent in times.items():
        total = sum(seconds for seconds, _ in spent)
        longest, scene_id = max(spent, key=lambda row: row[0])
        rows.append(
            StageRow(
                stage=stage,
                total=duration(total),
                share=percent(total / all_seconds) if all_seconds > 0 else "0 %",
                longest=duration(longest),
                longest_scene=scene_id,
            )
        )
    return rows


def listed(names: Iterable[str]) -> str:
    """Return sorted names on one line, cut after the first few."""
    ordered = sorted(names)
    more = f" and {len(ordered) - _MOST_NAMES} more" if len(ordered) > _MOST_NAMES else ""
    return ", ".join(ordered[:_MOST_NAMES]) + more


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


def quality_words(scene: SceneOutcome) -> Mapping[str, str]:
    """Return the shares of good, care and reject values of each product of a scene, by path."""
    return {product.path: verdicts_in_words(product.verdicts) for product in scene.products}


def _verdicts_by_kind(record: RunRecord) -> list[tuple[str, Verdicts]]:
    products = [product for scene in record.scenes for product in scene.products]
    sums = {
        kind: _sum(product.verdicts for product in products if product.kind == kind)
        for kind in sorted({product.kind for product in products})
    }
    return [(kind, verdicts) for kind, verdicts in sums.items() if verdicts.values]


def _sum(several: Iterable[Verdicts]) -> Verdicts:
    return Verdicts(*(sum(counts) for counts in zip((0, 0, 0), *several, strict=True)))


def _instrument_row(
    station: str, name: str, scenes: Sequence[SceneOutcome], refused_before: int
) -> InstrumentRow:
    retrieved = [
        product for scene in scenes for product in scene.products if is_retrieved(product.kind)
    ]
    return InstrumentRow(
        station=station,
        instrument=name,
        scenes=len(scenes),
        failed=sum(bool(scene.error) and not scene.internal for scene in scenes),
        internal=sum(bool(scene.internal) for scene in scenes),
        granules=sum(scene.granules for scene in scenes),
        refused=refused_before + sum(len(scene.refused) for scene in scenes),
        products=sum(len(scene.products) for scene in scenes),
        values=sum(product.values for product in retrieved),
        verdicts=_sum(product.verdicts for product in retrieved),
        seconds=sum(sum(scene.seconds.values()) for scene in scenes),
    )


def _about(bit: FlagBit | None) -> tuple[str, str]:
    if bit is None:
        return "unknown", "bit unknown to this version of lidarops"
    word = "do not use" if bit.severity is Severity.REJECT else "use with care"
    return word, bit.description

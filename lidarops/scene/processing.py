"""Process one scene: open its files, retrieve, build its products and write them.

A scene is the unit of work. It gives its product files, or an outcome that states why not.
"""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.campaign.model import channel_facts
from lidarops.errors import ProductError, RawFormatError
from lidarops.flags import Quality
from lidarops.kinds import kinds
from lidarops.netcdf.context import Context, product_of_path, product_path
from lidarops.netcdf.product_file import ProductWriter, create_product
from lidarops.netcdf.stored import open_stored, reading
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.raw.header import Stretches
from lidarops.records import (
    Disagreement,
    Grade,
    Granule,
    InputRecord,
    PlannedStep,
    ProductRecord,
    Role,
    Scene,
    SceneOutcome,
    file_channels,
    mode_of_signal,
)
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.scene.agreement import Retrieved, compare_channels
from lidarops.scene.case import (
    READ_STEP,
    channel_ranges,
    counted_channels,
    member_channel,
    product_channel,
)
from lidarops.scene.dependence import ancillary_files, read_products, scene_facts
from lidarops.scene.input_files import check_files, local_files, open_granules
from lidarops.scene.job import NO_PLACE, Failure, Job, guarded, nothing_to_do, product_context
from lidarops.scene.pipe import AIR, channel_signal
from lidarops.scene.profiles import (
    LIGHTLESS,
    ChannelSignal,
    Source,
    chunks,
    in_one_batch,
    lightless_profiles,
    profiles_together,
)
from lidarops.scene.retrieval import (
    Derivation,
    InputProduct,
    Member,
    NetworkRetrieval,
    making,
    product_settings,
    read_windows,
    streams_of,
)
from lidarops.system.files import sha256_of


def process_scene(job: Job) -> SceneOutcome:
    """Process one scene and return its products, or why there are none.

    Returns
    -------
    SceneOutcome
        Also for damaged data, a failing disk or a bug, which do not raise: `error` states the
        cause, and `internal` the traceback of a bug.
    """
    return attempt(job)[0]


def attempt(job: Job) -> tuple[SceneOutcome, bool]:
    """Process one scene, and return whether a retry would give the same outcome.

    Returns
    -------
    outcome : SceneOutcome
    final : bool
        False where a disk, a network or memory failed, so that a retry may succeed.
    """
    begin = time.thread_time()
    result = guarded(partial(_process, job))
    if isinstance(result, Failure):
        return result.outcome(job.scene, job.plan), result.final
    outcome, final = result
    final &= not outcome.refused
    return replace(outcome, cpu_seconds=time.thread_time() - begin), final


def _process(job: Job) -> tuple[SceneOutcome, bool]:
    began = time.perf_counter()
    failure = Failure("").outcome(job.scene, job.plan)
    order = job.plan.product_keys
    if not order:
        return replace(failure, error=nothing_to_do(job.plan)), True
    with local_files(job.campaign.archive, job.scene) as (root, denied):
        read_all = job.campaign.all_steps
        usable, inputs, refused = check_files(job.scene, root, read_all=read_all, denied=denied)
        seconds = {"digest": time.perf_counter() - began}
        failure = replace(failure, refused=refused, inputs=inputs)
        if refused:
            # Without them the scene is another one, of another plan.
            lost = "" if usable.granules else "no granule of the scene can be read"
            return replace(failure, error=lost), not lost
        process = _Network if usable.members else _Instrument
        work = process(job, usable, inputs, root, seconds)
        failed = guarded(work.all_products)
    outcome = replace(
        failure,
        inputs=work.inputs,
        refused=work.refused,
        seconds=work.seconds,
        notes=tuple(work.notes),
        disagreements=work.disagreements,
        # Also those before a failure: they are on the disk, so that the ledger must know them.
        products=tuple(sorted(work.made, key=lambda made: order.index((made.kind, made.channel)))),
    )
    if failed is None:
        return outcome, True
    error = "" if work.refused else failed.error
    return replace(outcome, error=error, internal=failed.internal), failed.final


class _Work(ABC):
    """What the processing of a scene of an instrument and of a network share."""

    def __init__(
        self,
        job: Job,
        scene: Scene,
        inputs: tuple[InputRecord, ...],
        root: Path,
        seconds: dict[str, float],
    ) -> None:
        self.job, self.inputs = job, inputs
        self.scene, self.root = scene, root
        self.seconds = seconds
        """Wall time by stage."""
        self.began = time.perf_counter()
        self.made: list[ProductRecord] = []
        """Products that are written, in the order in which they were complete."""
        self.notes: dict[str, None] = {}
        """What the data did not give, each once."""
        self.disagreements: tuple[Disagreement, ...] = ()
        self.refused: tuple[Granule, ...] = ()
        """Files of the scene that cannot be used, of which one turned out when steps read it."""

    def all_products(self) -> None:
        """Make all products."""
        try:
            self.products()
        except RawFormatError:
            # A file of known content was not checked, and differs from it or cannot be read now.
            self.refused = check_files(self.job.scene, self.root, read_all=True)[2]
            raise

    @abstractmethod
    def products(self) -> None:
        """Make the products."""

    def end(self, stage: str) -> None:
        """Add the time since the end of the last stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.began
        self.began = now

    def _source(
        self,
        scene: Scene,
        steps: Sequence[PlannedStep],
        stretches: Mapping[str, Stretches] | None = None,
    ) -> Source:
        """Open the data that steps work on: only the channels that they read.

        All bins, but those of `stretches` for the channels that it names.
        """
        job = self.job
        read = {step.channel for step in steps if step.name == READ_STEP}
        subtracted = [step.channel for step in steps if step.name == "dark"]
        layout = [channel.name for channel in scene.layout if channel.bins]
        held = [name for name in layout if name in read]
        opened = partial(open_granules, job.campaign, scene, root=self.root)
        archive = opened(scene.granules, channels=held, stretches=stretches, before=True)
        # All channels and bins tell, whatever is made of them.
        lightless = (
            lightless_profiles(opened(scene.granules, channels=layout), job.profiles_per_chunk)
            if len(scene.granules) >= COMMON.fewest_profiles
            else {}
        )
        for name in [name for name in held if name in lightless]:
            dark, shots = lightless[name], archive[f"{name}_shots"]
            unlit = {f"{name}_{LIGHTLESS}": ("time", dark), shots.name: shots.where(~dark, 0)}
            archive = archive.assign(unlit)
            words = f"{dark.sum()} of {dark.size} profiles of {name}"
            self.notes[f"without light: {words}"] = None
        source = Source(
            archive=archive,
            dark=(
                opened(scene.dark, channels=subtracted, before=True)
                if subtracted and scene.dark
                else None
            ),
            ancillaries=Ancillaries.read(job.campaign.folder, ancillary_files(steps)),
            station_altitude=job.campaign.stations[scene.station].altitude,
        )
        self.inputs += tuple(file for file in source.ancillaries.inputs if file not in self.inputs)
        return source

    @contextmanager
    def _writer(self, frame: xr.Dataset, context: Context) -> Iterator[ProductWriter]:
        """Yield a writer of a product, which is complete at the end."""
        target = self.job.campaign.products_root / context.path
        place = self.job.places.get((context.kind, context.channel), NO_PLACE)
        with create_product(frame, context, target, place.sha256) as writer:
            yield writer
        record = writer.record
        stays = record.change is not None and record.change.grade is Grade.NONE
        self.made.append(replace(record, stamp=place.former) if stays else record)
        self.end("write")

    def _write(self, context: Context, results: Iterator[xr.Dataset]) -> None:
        """Write a product from its frame and the rows that follow."""
        with self._writer(next(results), context) as writer:
            for rows in results:
                self._add(rows, writer)

    def _add(self, rows: xr.Dataset, writer: ProductWriter) -> None:
        self.end("retrieve")
        flags = {str(name): rows[name] for name in rows if str(name).endswith(QUALITY_FLAG)}
        dark, missing = int(Quality.NO_SIGNAL), int(Quality.INPUT_MISSING)
        # Where there is no light, no data are missing.
        flags = {n: f.where((f & dark) == 0, f & ~missing) for n, f in flags.items()}
        writer.add(rows.assign(flags))
        self.end("write")


class _Instrument(_Work):
    """The processing of a scene of one instrument."""

    def products(self) -> None:
        """Make the products of all channels."""
        steps = self.job.plan.steps
        products = self.job.plan.products
        derived = [step for step in products if read_products(step)]
        channels = dict.fromkeys(step.channel for step in products if step not in derived)
        compared: list[Retrieved] = []
        if channels:
            source = self._source(self.scene, steps, read_windows(steps))
            for channel in channels:
                self._make_products(source, channel, compared)
        judged, pairs = compare_channels(compared) if compared else ([], ())
        self.end("retrieve")
        # Pairs of two products that stand were reported when these were made.
        self.disagreements = tuple(
            pair
            for pair in pairs
            if any(self.job.writes(pair.kind, name) for name in pair.channels)
        )
        for product in judged:
            if self.job.writes(product.context.kind, product.context.channel):
                self._write(product.context, iter([product.frame, *product.batches]))
        # Last, and in the order of the plan: of products that are on the disk.
        for step in derived:
            self._derive(step)

    def _derive(self, step: PlannedStep) -> None:
        """Write a product that is made of others."""
        job, kind = self.job, step.product
        read = [self._read(path) for path in self._paths_read(step)]
        first = next(product.file for product in read if product.channel == step.channel)
        with reading(first), open_stored(first) as product:
            wavelength = float(product["wavelength"][...]) * 1e-9
            stated = product.attrs["lidarops_detection_mode"]
        mode = mode_of_signal(step.channel, stated)
        channel = product_channel(step.channel, mode, wavelength)
        context = product_context(job, self.scene, kind, channel, wavelength, self.inputs)
        settings = product_settings(job.plan.steps, kind, step.channel)
        self._write(context, making(kind, Derivation).derive(settings, read))

    def _paths_read(self, step: PlannedStep) -> list[str]:
        """Return the paths of the products that a step reads, of its scene or its month."""
        scene, keys = self.scene, read_products(step)
        if scene.granules:
            owner = (scene.station, scene.instrument)
            return sorted(product_path((*owner, *key), scene.id, scene.start) for key in keys)
        paths = (product.path for product in scene.products)
        return sorted(path for path in paths if product_of_path(path) in keys)

    def _read(self, path: str) -> InputProduct:
        """Return a product that is read, and state its content as an input."""
        file = self.job.campaign.products_root / path
        try:
            record = InputRecord(path, Role.PRODUCT, sha256_of(file))
        except OSError as error:
            raise ProductError(
                f"cannot be read: {error.strerror or error}",
                file=file,
                remedy="run lidarops reprocess again, which makes it",
            ) from error
        if record not in self.inputs:
            self.inputs += (record,)
        return InputProduct(*product_of_path(path), file)

    def _make_products(self, source: Source, channel: str, compared: list[Retrieved]) -> None:
        """Write the products of a channel, but for those to be compared with other channels."""
        steps = self.job.plan.steps
        signal = channel_signal(source, steps, channel)
        streams = streams_of(steps, signal)
        if any(self.job.writes(kind, channel) for kind in streams):
            for part in signal.channels.values():
                self.notes.update(dict.fromkeys(part.notes))
        layout = member_channel(self.scene.layout, channel)
        contexts = {
            kind: product_context(
                self.job, self.scene, kind, layout, signal.wavelength, self.inputs
            )
            for kind in streams
        }
        with ExitStack() as until_written:
            writers: dict[str, ProductWriter] = {}
            channels = counted_channels(steps, channel)
            profiles = profiles_together(source, channels, self.job.profiles_per_chunk)
            for chunk in chunks(source, channels, streams.values(), profiles):
                for kind, rows in ((k, rows) for k, s in streams.items() for rows in s.add(chunk)):
                    if kind in writers:
                        self._add(rows, writers[kind])
                    else:
                        self.end("retrieve")
                        frame = _with_words(rows, contexts[kind], signal)
                        writer = self._writer(frame, contexts[kind])
                        writers[kind] = until_written.enter_context(writer)
        for kind in [kind for kind in streams if kind not in writers]:
            results = streams[kind].results()
            frame = _with_words(next(results), contexts[kind], signal)
            common = kinds()[kind].common
            if self.job.writes(kind, channel):
                self.notes.update(dict.fromkeys(streams[kind].notes))
            if common:
                compared.append(Retrieved(common, contexts[kind], frame, tuple(results)))
            else:
                self._write(contexts[kind], itertools.chain([frame], results))


def _with_words(frame: xr.Dataset, context: Context, signal: ChannelSignal) -> xr.Dataset:
    """Return the frame of a product that states what steps decided from the data."""
    parts = counted_channels(context.plan.steps, signal.channel)
    words = [words for part in parts for words in signal.channels[part].statements]
    if signal.air and signal.air_error and any(step.name == AIR for step in context.plan.steps):
        words.append(signal.air.words(signal.air_error))
    stated = [frame.attrs["steps"]] if frame.attrs.get("steps") else []
    return frame.assign_attrs(steps="; ".join([*words, *stated])) if words else frame


class _Network(_Work):
    """The processing of a scene of a network."""

    def products(self) -> None:
        """Make the products of the network."""
        plan = self.job.plan
        for step in plan.products:
            members = list(self._members(step))
            settings = product_settings(plan.steps, step.product, step.channel)
            stream = making(step.product, NetworkRetrieval).stream(settings, members)
            for member in members:
                if member.signal is not None:
                    source = member.signal.source
                    channels = file_channels(step.channel)
                    requested = self.job.profiles_per_chunk
                    profiles = profiles_together(source, channels, requested)
                    for chunk in chunks(source, channels, (), profiles):
                        stream.add(member, chunk)
            made = stream.result()
            self.end("retrieve")
            first = next(m for m in self.job.scene.members if m.instrument == members[0].instrument)
            context = product_context(
                self.job,
                self.scene,
                step.product,
                member_channel(first.layout, step.channel),
                stream.wavelength,
                self.inputs,
            )
            self._write(context, in_one_batch(made))

    def _members(self, product: PlannedStep) -> Iterator[Member[Any]]:
        """Yield the instruments that take part, with the data of the channel of a product."""
        job = self.job
        for planned, usable in zip(job.scene.members, self.scene.members, strict=True):
            steps = [s for s in job.plan.steps if s.instrument == planned.instrument]
            if not steps:
                continue
            signal = None
            if usable.granules:
                # Products of the whole network may need more bins than a member states.
                concerned = ("", planned.instrument)
                of_member = [s for s in job.plan.steps if s.instrument in concerned]
                source = self._source(usable, steps, read_windows(of_member))
                signal = channel_signal(source, steps, product.channel)
            layout = member_channel(planned.layout, product.channel)
            yield Member(
                planned.instrument,
                job.campaign.stations[planned.station],
                signal,
                product_settings(steps, product.product, product.channel, planned.instrument),
                channel_ranges(
                    layout, channel_facts(scene_facts(job.campaign, planned), layout.name)
                ),
            )

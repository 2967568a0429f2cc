"""Process one scene: open its files, retrieve, build its products and write them.

A scene is the unit of work. It gives its product files, or an outcome that states why not.
"""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import dask.config
import dask.local
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.errors import RawFormatError
from lidarops.kinds import kind_of
from lidarops.netcdf.context import Context, product_path
from lidarops.netcdf.product_file import ProductWriter, create_product
from lidarops.raw.archive import count_bytes_read
from lidarops.raw.header import Stretches
from lidarops.records import (
    Disagreement,
    Grade,
    Granule,
    InputRecord,
    Plan,
    PlannedStep,
    ProductRecord,
    Scene,
    SceneOutcome,
)
from lidarops.scene import data
from lidarops.scene.agreement import Retrieved, compare_channels
from lidarops.scene.channels import (
    READ_STEP,
    channel_ranges,
    counted_channels,
    file_channels,
    member_channel,
)
from lidarops.scene.context import product_context
from lidarops.scene.data import ChannelSignal, ProductStream, Source, WholeProduct, in_one_batch
from lidarops.scene.dependence import (
    ancillary_files,
    is_product,
    plan_closure,
    scene_facts,
)
from lidarops.scene.guard import Failure, guarded
from lidarops.scene.input_files import check_files, local_files, open_granules
from lidarops.scene.job import Job, nothing_to_do
from lidarops.scene.pipe import channel_signal
from lidarops.scene.profiles import Chunk
from lidarops.scene.retrieval import Member, network_retrieval, product_settings, streams_of
from lidarops.scene.windows import read_windows


def process_scene(job: Job) -> SceneOutcome:
    """Process one scene and return its products, or why there are none.

    Parameters
    ----------
    job : Job

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

    def process() -> tuple[SceneOutcome, bool]:
        with local_files(job.campaign.archive, job.scene) as (root, denied):
            return _process(job, root, denied)

    result = guarded(process)
    if isinstance(result, Failure):
        return result.outcome(job.scene, job.plan), result.final
    outcome, final = result
    final &= not outcome.refused
    return replace(outcome, cpu_seconds=time.thread_time() - begin), final


def _process(job: Job, root: Path, denied: Mapping[str, str]) -> tuple[SceneOutcome, bool]:
    clock = _Clock()
    if not any(is_product(step) for step in job.plan.steps):
        return Failure(nothing_to_do(job.plan)).outcome(job.scene, job.plan), True
    read_all = job.campaign.all_steps
    usable, inputs, refused, read = check_files(job.scene, root, read_all=read_all, denied=denied)
    clock.lap("digest")
    failure = Failure("").outcome(job.scene, job.plan)
    failure = replace(failure, refused=refused, inputs=inputs, bytes_read=read)
    if refused:
        # Without them the scene is another one, of another plan.
        lost = "" if usable.granules else "no granule of the scene can be read"
        return replace(failure, error=lost), not lost
    # Of a scheduler by its name, dask loads `distributed`, which takes 0.3 s.
    with dask.config.set(scheduler=dask.local.get_sync), count_bytes_read() as tally:
        process = _Network if usable.members else _Instrument
        work = process(job, usable, inputs, root, clock)
        products = guarded(work.all_products)
    outcome = replace(
        failure,
        plan=work.job.plan,
        inputs=work.inputs,
        refused=work.refused,
        seconds=clock.laps,
        notes=tuple(work.notes),
        disagreements=work.disagreements,
        bytes_read=read + tally.bytes,
    )
    if isinstance(products, Failure):
        # Those before the failure are on the disk, so that the ledger must know them.
        error = "" if work.refused else products.error
        failed = replace(outcome, error=error, internal=products.internal)
        return replace(failed, products=tuple(work.made)), products.final
    return replace(outcome, products=products), True


class _Clock:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now


class _Work(ABC):
    """What the processing of a scene of an instrument and of a network share."""

    def __init__(
        self,
        job: Job,
        scene: Scene,
        inputs: tuple[InputRecord, ...],
        root: Path,
        clock: _Clock,
    ) -> None:
        self.job, self.inputs = job, inputs
        self._scene, self._root, self._clock = scene, root, clock
        self.made: list[ProductRecord] = []
        """Products that are written, in the order in which they were complete."""
        self.notes: dict[str, None] = {}
        """What the data did not give, each once."""
        self.disagreements: tuple[Disagreement, ...] = ()
        self.refused: tuple[Granule, ...] = ()
        """Files of the scene that cannot be used, of which one turned out when steps read it."""

    def all_products(self) -> tuple[ProductRecord, ...]:
        """Make all products, and return their records."""
        try:
            return tuple(self.products())
        except RawFormatError:
            # A file of known content was not checked, and differs from it or cannot be read now.
            self.refused = check_files(self.job.scene, self._root, read_all=True)[2]
            raise

    @abstractmethod
    def products(self) -> Iterator[ProductRecord]:
        """Make the products, and yield their records."""

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
        bins = {channel.name: channel.bins for channel in scene.layout if channel.name in read}
        profiles = data.chunk_profiles(max(bins.values()), job.profiles_per_chunk)
        open_files = (job.campaign, scene)
        source = Source(
            archive=open_granules(
                *open_files,
                scene.granules,
                self._root,
                list(bins),
                profiles_per_chunk=max(1, profiles // data.READ_TOGETHER),
                stretches=stretches,
            ),
            dark=(
                open_granules(*open_files, scene.dark, self._root, subtracted)
                if subtracted and scene.dark
                else None
            ),
            ancillaries=Ancillaries.read(job.campaign.folder, ancillary_files(steps)),
            station_altitude=job.campaign.stations[scene.station].altitude,
        )
        self.inputs += tuple(file for file in source.ancillaries.inputs if file not in self.inputs)
        return source

    def _chunk_profiles(self, source: Source, channels: Sequence[str]) -> int:
        """Return the number of profiles of channels of the files that are processed together."""
        counts = [source.archive[name] for name in channels]
        requested = self.job.profiles_per_chunk
        if requested is None and sum(array.nbytes for array in counts) <= data.IN_MEMORY:
            return int(source.archive.sizes["time"])
        bins = sum(int(array.shape[1]) for array in counts)
        return data.chunk_profiles(bins, requested)

    @contextmanager
    def _writer(self, frame: xr.Dataset, context: Context) -> Iterator[ProductWriter]:
        """Yield a writer of a product, which is complete at the end."""
        target = self.job.campaign.products_root / product_path(context)
        former = self.job.place(context.kind, context.channel).sha256
        with create_product(frame, context, target, former) as writer:
            yield writer
        self.made.append(self._record(context, writer))
        self._clock.lap("write")

    def _written(self, context: Context, results: Iterator[xr.Dataset]) -> ProductRecord:
        """Write a product from its frame and the rows that follow."""
        with self._writer(next(results), context) as writer:
            for rows in results:
                self._clock.lap("retrieve")
                writer.add(rows)
                self._clock.lap("write")
        return self._record(context, writer)

    def _record(self, context: Context, writer: ProductWriter) -> ProductRecord:
        written = writer.written
        stays = written.change is not None and written.change.grade is Grade.NONE
        former = self.job.place(context.kind, context.channel).former
        return ProductRecord(
            product_path(context),
            context.kind,
            context.channel,
            **{item.name: getattr(written, item.name) for item in fields(written)},
            stamp=former if stays else context.stamp,
        )


class _Instrument(_Work):
    """The processing of a scene of one instrument."""

    def products(self) -> Iterator[ProductRecord]:
        """Make the products of all channels, and yield their records."""
        steps = self.job.plan.steps
        channels = dict.fromkeys(step.channel for step in steps if is_product(step))
        source = self._source(self._scene, steps, read_windows(steps))
        compared: list[Retrieved] = []
        for channel in channels:
            yield from self._channel_products(source, channel, compared)
        judged, pairs = compare_channels(compared) if compared else ([], ())
        self._clock.lap("retrieve")
        # Pairs of two products that stand were reported when these were made.
        self.disagreements = tuple(
            pair
            for pair in pairs
            if any(self.job.writes(pair.kind, name) for name in pair.channels)
        )
        for product in judged:
            if self.job.writes(product.context.kind, product.context.channel):
                yield self._written(product.context, iter([product.frame, *product.batches]))

    def _channel_products(
        self, source: Source, channel: str, compared: list[Retrieved]
    ) -> Iterator[ProductRecord]:
        """Write the products of a channel, but for those to be compared with other channels."""
        steps = self.job.plan.steps
        signal = channel_signal(source, steps, channel)
        streams = streams_of(steps, signal)
        if any(self.job.writes(kind, channel) for kind in streams):
            for part in signal.channels.values():
                self.notes.update(dict.fromkeys(part.notes))
        layout = member_channel(self._scene.layout, channel)
        contexts = {
            kind: product_context(
                self.job, self._scene, kind, layout, signal.wavelength, self.inputs
            )
            for kind in streams
        }
        words = {kind: _words(self.job.plan, kind, signal) for kind in streams}
        with ExitStack() as until_written:
            writers: dict[str, ProductWriter] = {}
            channels = counted_channels(steps, channel)
            profiles = self._chunk_profiles(source, channels)
            for chunk in data.chunks(source, channels, streams.values(), profiles):
                for kind, rows in _taken(chunk, streams):
                    self._clock.lap("retrieve")
                    if kind in writers:
                        writers[kind].add(rows)
                        self._clock.lap("write")
                    else:
                        writer = self._writer(_with_words(rows, words[kind]), contexts[kind])
                        writers[kind] = until_written.enter_context(writer)
        yield from (self._record(contexts[kind], writer) for kind, writer in writers.items())
        for kind, stream in streams.items():
            if isinstance(stream, WholeProduct):
                results = stream.results()
                frame = _with_words(next(results), words[kind])
                common = kind_of(kind).common
                if self.job.writes(kind, channel):
                    self.notes.update(dict.fromkeys(stream.notes))
                if common:
                    compared.append(Retrieved(common, contexts[kind], frame, tuple(results)))
                else:
                    yield self._written(contexts[kind], itertools.chain([frame], results))


def _words(plan: Plan, product: str, signal: ChannelSignal) -> list[str]:
    """Return what steps decided from the data of all channels from which a product is made."""
    steps = plan_closure(plan, [(product, signal.channel)]).steps
    parts = counted_channels(steps, signal.channel)
    return [words for part in parts for words in signal.channels[part].statements]


def _with_words(frame: xr.Dataset, words: Sequence[str]) -> xr.Dataset:
    """Return the frame of a product that states what steps decided from the data."""
    stated = [frame.attrs["steps"]] if frame.attrs.get("steps") else []
    return frame.assign_attrs(steps="; ".join([*words, *stated])) if words else frame


def _taken(chunk: Chunk, streams: Mapping[str, ProductStream]) -> Iterator[tuple[str, xr.Dataset]]:
    """Give a chunk to all products, and yield the rows that are complete, with their kinds."""
    for kind, stream in streams.items():
        if isinstance(stream, WholeProduct):
            stream.add(chunk)
        else:
            yield from ((kind, rows) for rows in stream.rows(chunk))


class _Network(_Work):
    """The processing of a scene of a network."""

    def products(self) -> Iterator[ProductRecord]:
        """Make the products of the network, and yield their records."""
        plan = self.job.plan
        for step in [step for step in plan.steps if is_product(step)]:
            members = list(self._members(step))
            settings = product_settings(plan.steps, step.product, step.channel)
            stream = network_retrieval(step.product).stream(settings, members)
            for member in members:
                if member.signal is not None:
                    source = member.signal.source
                    channels = file_channels(step.channel)
                    profiles = self._chunk_profiles(source, channels)
                    for chunk in data.chunks(source, channels, (), profiles):
                        stream.add(member, chunk)
            made = stream.result()
            self._clock.lap("retrieve")
            first = next(m for m in self.job.scene.members if m.instrument == members[0].instrument)
            context = product_context(
                self.job,
                self._scene,
                step.product,
                member_channel(first.layout, step.channel),
                stream.wavelength,
                self.inputs,
            )
            yield self._written(context, in_one_batch(made))

    def _members(self, product: PlannedStep) -> Iterator[Member[Any]]:
        """Yield the instruments that take part, with the data of the channel of a product."""
        job = self.job
        for planned, usable in zip(job.scene.members, self._scene.members, strict=True):
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
                channel_ranges(layout, scene_facts(job.campaign, planned)),
            )

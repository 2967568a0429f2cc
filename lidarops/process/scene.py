"""Process one scene: open -> retrieve -> build -> write.

A scene is the unit of work: it becomes its product files or a stated failure.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import dask.config
import numpy as np
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.campaign.model import Campaign, InstrumentFacts, Station, as_settings
from lidarops.errors import LidarOpsError, ProductError, SceneError
from lidarops.flags import Quality
from lidarops.netcdf import provenance, write
from lidarops.netcdf.context import Context, product_path
from lidarops.plan import network_plan, product_dependence
from lidarops.plan.availability import glued_channels
from lidarops.plan.preview import refine_plan
from lidarops.plan.signal_rules import StepName, read_windows
from lidarops.process import channel_steps, network_steps
from lidarops.products.layouts import build_product
from lidarops.raw import licel
from lidarops.raw.archive import counting, open_archive
from lidarops.raw.model import Stretches
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    Granule,
    InputRecord,
    Plan,
    ProductKind,
    ProductRecord,
    Provenance,
    Scene,
    SceneOutcome,
    Status,
    Step,
)
from lidarops.system.stores import RemoteStore

# What broken data, a broken disk or a broken library can raise; a bug in lidarops itself that
# raises anything else must be seen, not entered in a report.
_FAILURES = (
    LidarOpsError,
    OSError,
    ValueError,
    ArithmeticError,
    LookupError,
    RuntimeError,
    MemoryError,
)


_VANISHED: Final = "vanished after it was catalogued (run lidarops catalog again)"


@dataclass(frozen=True, slots=True)
class Job:
    """Everything that a worker needs to process one scene."""

    campaign: Campaign
    scene: Scene
    plan: Plan
    profiles_per_chunk: int | None = None
    only: str | None = None
    """The channel whose products are wanted; all where None."""

    def concerns(self, step: Step) -> bool:
        """Whether the products of the step's channel are wanted."""
        return self.only in (None, step.channel)

    @property
    def facts(self) -> InstrumentFacts:
        """What is known of the instrument at the time of the scene."""
        instrument = self.campaign.instruments[self.scene.instrument]
        return instrument.facts_at(self.scene.granules[0].start or self.scene.start)


def process_scene(job: Job) -> SceneOutcome:
    """Process one scene: its products, or why there are none.

    Parameters
    ----------
    job : Job

    Returns
    -------
    SceneOutcome
        Never raises for bad data or a bad disk; the outcome tells.
    """
    return attempt(job)[0]


def attempt(job: Job) -> tuple[SceneOutcome, bool]:
    """Process one scene, and tell whether the same inputs cannot but give the same outcome.

    Returns
    -------
    outcome : SceneOutcome
    final : bool
        False where a disk, a network or memory failed: another try may do better.
    """
    begin = time.thread_time()
    try:
        with _Archive.of(job.campaign.archive).local(job.scene) as root:
            outcome = _process(job, root)
        return replace(outcome, cpu_seconds=time.thread_time() - begin), True
    except _FAILURES as error:
        text = str(error) if isinstance(error, LidarOpsError | OSError) else repr(error)
        return failed(job, text), not isinstance(error, ProductError | OSError | MemoryError)


def failed(job: Job, error: str) -> SceneOutcome:
    """Return the outcome of a scene that gave no product."""
    scene = job.scene
    return SceneOutcome(
        scene=scene.id,
        station=scene.station,
        instrument=scene.instrument,
        start=scene.start,
        granules=len(scene.granules),
        plan=job.plan,
        error=error,
    )


def _process(job: Job, root: Path) -> SceneOutcome:
    clock = _Clock()
    wanted = [step for step in job.plan.steps if step.name in tuple(ProductKind)]
    if not wanted:
        return failed(job, nothing_to_do(job.plan))
    usable, inputs, refused, read = _digest(job, root)
    clock.lap("digest")
    failure = replace(failed(job, ""), refused=refused, inputs=inputs, bytes_read=read)
    if not usable.granules:
        return replace(failure, error="no granule of the scene can be read")
    with dask.config.set(scheduler="synchronous"), counting() as tally:
        if usable.members:
            inputs, product = _network_product(job, usable, inputs, root, clock)
            products: tuple[ProductRecord, ...] = (product,)
        else:
            channels = list(dict.fromkeys(step.channel for step in wanted if job.concerns(step)))
            bench = _bench(job, usable, job.plan, root)
            job, bench = _refined(job, usable, bench, root)
            clock.lap("look")
            inputs += bench.ancillaries.inputs
            products = tuple(
                product
                for channel in channels
                for product in _channel_products(job, usable, inputs, bench, channel, clock)
            )
    return replace(
        failure,
        plan=job.plan,
        products=products,
        inputs=inputs,
        seconds=clock.laps,
        bytes_read=read + tally.bytes,
    )


def nothing_to_do(plan: Plan) -> str:
    """Say why a plan gives no product: what was asked for first, what nobody asked for not."""
    kinds = tuple(ProductKind)
    unasked = ("does not ask", "no product of the campaign asks")
    asked = [left for left in plan.left_out if not any(word in left.reason for word in unasked)]
    told = sorted(asked or plan.left_out, key=lambda left: left.name not in kinds)
    reasons = dict.fromkeys(f"{left.name} of {left.channel}: {left.reason}" for left in told)
    return "nothing to do: " + "; ".join(reasons)


def _refined(
    job: Job, scene: Scene, bench: channel_steps.Bench, root: Path
) -> tuple[Job, channel_steps.Bench]:
    """Leave out what a look at some profiles says will give nothing."""

    def profiles(channel: str, granules: Sequence[Granule]) -> xr.Dataset:
        some = _open(job, scene, granules, root, [channel])
        looked_at = channel_steps.at_hand(replace(bench, archive=some), [channel])
        return channel_steps.Plain(looked_at, channel).profiles().compute()

    plan = refine_plan(job.plan, scene.granules, profiles)
    return replace(job, plan=plan), replace(bench, plan=plan)


class _Clock:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now


def _digest(
    job: Job, root: Path
) -> tuple[Scene, tuple[InputRecord, ...], tuple[Granule, ...], int]:
    """Take the digest of every file, and say whether it is still what the catalog says.

    A file of the size and modification time of the catalog's has the digest that it noted, where
    it did, and its header need not be read. Returns the bytes that were read at the end.
    """
    scene = job.scene
    usable: dict[str, Granule] = {}
    inputs: list[InputRecord] = []
    refused: list[Granule] = []
    read = 0
    for granule in (*scene.granules, *scene.dark):
        try:
            same = not job.campaign.all_steps and _is_unchanged(granule, root)
            known = granule.sha256 if same else None
            if known is None:
                read += granule.size
                known = _read_digest(granule, root)
        except FileNotFoundError:
            refused.append(replace(granule, status=Status.REFUSED, reason=_VANISHED))
        except (LidarOpsError, OSError) as error:
            reason = str(error).removeprefix(f"{granule.path}: ")
            refused.append(replace(granule, status=Status.REFUSED, reason=reason))
        else:
            usable[granule.path] = granule if same else replace(granule, header_digest=None)
            inputs.append(InputRecord(granule.path, granule.role, known))
    return _without(scene, usable), tuple(inputs), tuple(refused), read


def _is_unchanged(granule: Granule, root: Path) -> bool:
    """Tell whether a file is the one whose header was read, by its size and time of change."""
    about = os.stat(f"{root}/{granule.path}")  # noqa: PTH116 - a Path takes twice as long
    return (about.st_size, about.st_mtime_ns) == (granule.size, granule.mtime_ns)


def _read_digest(granule: Granule, root: Path) -> str:
    data = (root / granule.path).read_bytes()
    if len(data) != granule.size:
        raise SceneError(
            f"holds {len(data)} bytes, the catalog says {granule.size}",
            remedy="run lidarops catalog again",
        )
    licel.parse_header(data, file=granule.path, size=len(data))
    return hashlib.sha256(data).hexdigest()


def _without(scene: Scene, usable: Mapping[str, Granule]) -> Scene:
    """Return a scene of its usable granules alone, as they were found."""
    return replace(
        scene,
        granules=tuple(usable[g.path] for g in scene.granules if g.path in usable),
        dark=tuple(usable[g.path] for g in scene.dark if g.path in usable),
        members=tuple(_without(member, usable) for member in scene.members),
    )


def _open(
    job: Job,
    scene: Scene,
    granules: Sequence[Granule],
    root: Path,
    channels: list[str],
    stretches: Mapping[str, Stretches] | None = None,
) -> xr.Dataset:
    archive = open_archive(
        list(granules),
        root=root,
        channels=channels,
        mask_and_scale=False,
        profiles_per_chunk=job.profiles_per_chunk,
        header_position="ignore",
        stretches=stretches,
    )
    # What the campaign says of the pointing wins over the headers.
    facts = product_dependence.facts_of(job.campaign, scene)
    told = {"zenith_angle": facts.zenith_angle, "azimuth": facts.azimuth}
    pointing = {
        name: xr.full_like(archive["zenith_angle"], angle)
        for name, angle in told.items()
        if angle is not None
    }
    return archive.assign_coords(pointing) if pointing else archive


def _bench(job: Job, scene: Scene, plan: Plan, root: Path) -> channel_steps.Bench:
    """Open what the steps of a scene work on: of the raw files only the channels they read."""
    read = dict.fromkeys(step.channel for step in plan.steps if step.name == StepName.READ)
    present = {channel.name for channel in scene.layout}
    subtracted = [step.channel for step in plan.steps if step.name == StepName.DARK]
    return channel_steps.Bench(
        plan=plan,
        archive=_open(
            job,
            scene,
            scene.granules,
            root,
            [name for name in read if name in present],
            read_windows(plan.steps),
        ),
        dark=_open(job, scene, scene.dark, root, subtracted) if subtracted and scene.dark else None,
        ancillaries=Ancillaries.read(job.campaign.folder, plan),
        station_altitude=job.campaign.stations[scene.station].altitude,
    )


def _channel_products(
    job: Job,
    scene: Scene,
    inputs: tuple[InputRecord, ...],
    bench: channel_steps.Bench,
    name: str,
    clock: _Clock,
) -> Iterator[ProductRecord]:
    layout = _layout(job, scene, name)
    computed = channel_steps.process_channel(bench, name)
    clock.lap("retrieve")
    for kind, data in computed.items():
        colour = bench.steps(name)[StepName.READ].settings["wavelength"]
        context = _context(job, scene, kind, layout, colour, inputs)
        yield _written(job, context, data, clock)


def _written(job: Job, context: Context, data: xr.Dataset, clock: _Clock) -> ProductRecord:
    path = product_path(context)
    written = write.write_product(build_product(data, context), job.campaign.products_root / path)
    clock.lap("write")
    return _record(context.kind, context.channel, path, written, data)


def _network_product(
    job: Job, scene: Scene, inputs: tuple[InputRecord, ...], root: Path, clock: _Clock
) -> tuple[tuple[InputRecord, ...], ProductRecord]:
    """Make the product of a network; return its inputs with the ancillary ones, and its record."""
    joint = {step.name: step for step in job.plan.steps if not step.instrument}
    asked = joint[StepName.VISIBILITY]
    members = []
    for planned, usable in zip(job.scene.members, scene.members, strict=True):
        part = tuple(step for step in job.plan.steps if step.instrument == planned.instrument)
        if not part:
            continue
        bench = None
        if usable.granules:
            bench = _bench(job, usable, Plan(job.plan.scene, part, ()), root)
            inputs += tuple(used for used in bench.ancillaries.inputs if used not in inputs)
        grid = network_plan.ranges_of(
            network_plan.channel_of(planned, asked.channel),
            product_dependence.facts_of(job.campaign, planned),
        )
        station = job.campaign.stations[planned.station]
        members.append(network_steps.Member(planned.instrument, station, bench, grid))
    data = network_steps.process_network(members, joint)
    clock.lap("retrieve")
    first = next(m for m in job.scene.members if m.instrument == members[0].instrument)
    layout = network_plan.channel_of(first, asked.channel)
    colour = asked.settings["wavelength"]
    context = _context(job, scene, ProductKind.VISIBILITY, layout, colour, inputs)
    return inputs, _written(job, context, data, clock)


def _layout(job: Job, scene: Scene, name: str) -> ChannelLayout:
    instrument = job.campaign.instruments[scene.instrument]
    known = (*scene.layout, *glued_channels(scene.layout, instrument))
    return next(channel for channel in known if channel.name == name)


def _context(
    job: Job,
    scene: Scene,
    kind: ProductKind,
    channel: ChannelLayout,
    wavelength: float,
    inputs: tuple[InputRecord, ...],
) -> Context:
    campaign = job.campaign
    # What the product does not depend on must not stand in it.
    mine = product_dependence.plan_closure(job.plan, [(kind, channel.name)])
    return Context(
        kind=kind,
        channel=channel.name,
        mode=DetectionMode(channel.mode),
        wavelength=wavelength,
        station_key=scene.station,
        station=_station(campaign, scene),
        instrument_key=scene.instrument,
        instrument_name=_instrument_name(campaign, scene),
        metadata=campaign.metadata,
        campaign=campaign.name,
        title=campaign.title,
        summary=campaign.summary,
        scene=scene.id,
        start=scene.start,
        stop=scene.stop,
        provenance=Provenance(
            campaign=campaign.name,
            scene=scene.id,
            kind=kind,
            channel=channel.name,
            inputs=product_dependence.inputs(mine, inputs),
            plan=mine,
            settings={
                **_of_campaign(job, mine, kind, channel.name),
                "metadata": as_settings(campaign.metadata),
                "keys": {"station": scene.station, "instrument": scene.instrument},
                "campaign": {"title": campaign.title, "summary": campaign.summary},
                "window": [scene.start.isoformat(), scene.stop.isoformat()],
            },
            versions=provenance.package_versions(),
            code_version=provenance.code_version(),
        ),
    )


def _of_campaign(job: Job, plan: Plan, kind: ProductKind, channel: str) -> dict[str, Any]:
    """Return what a product depends on of the stations and instruments of the campaign."""
    campaign, scene = job.campaign, job.scene
    if not scene.members:
        instrument = campaign.instruments[scene.instrument]
        return {
            "station": as_settings(campaign.stations[scene.station]),
            "facts": product_dependence.facts(job.facts, plan, channel),
            # What else `lidarops reproduce` needs to make the same bytes again.
            "instrument": instrument.name,
            "products": product_dependence.asked(
                as_settings(instrument.products).get(kind.value), channel
            ),
        }
    return {
        "network": as_settings(campaign.networks[scene.instrument]),
        "members": {
            member.instrument: {
                "station": as_settings(campaign.stations[member.station]),
                "facts": product_dependence.facts(
                    product_dependence.facts_of(campaign, member), plan, channel
                ),
                "instrument": campaign.instruments[member.instrument].name,
                "keys": {"station": member.station, "instrument": member.instrument},
                "files": sorted(used.path for used in (*member.granules, *member.dark)),
            }
            for member in scene.members
        },
    }


def _station(campaign: Campaign, scene: Scene) -> Station:
    """Return where a scene was taken: of a network, the middle of its stations."""
    if not scene.members:
        return campaign.stations[scene.station]
    places = [campaign.stations[member.station] for member in scene.members]
    latitude, longitude, altitude = (
        sum(getattr(place, name) for place in places) / len(places)
        for name in ("latitude", "longitude", "altitude")
    )
    return Station(
        name=campaign.networks[scene.instrument].name or scene.instrument,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
    )


def _instrument_name(campaign: Campaign, scene: Scene) -> str:
    if scene.members:
        return "network of " + ", ".join(_instrument_name(campaign, m) for m in scene.members)
    return campaign.instruments[scene.instrument].name or scene.instrument


def _record(
    kind: ProductKind, channel: str, path: str, written: write.Written, data: xr.Dataset
) -> ProductRecord:
    flags = data["quality_flag"].to_numpy()
    # Few bits occur in a product: the others need no look at every value.
    occurring = Quality(int(np.bitwise_or.reduce(flags, axis=None)))
    return ProductRecord(
        path=path,
        kind=kind,
        channel=channel,
        sha256=written.sha256,
        size=written.size,
        values=int(flags.size),
        flagged={str(bit.name): int(np.count_nonzero(flags & np.int32(bit))) for bit in occurring},
        unflagged=flags.size - int(np.count_nonzero(flags)),
        usable=flags.size - int(np.count_nonzero(flags & np.int32(Quality.rejecting()))),
    )


class _Archive:
    """The raw files of a scene, on a local disk."""

    def __init__(self, root: str) -> None:
        self._root = root

    @staticmethod
    def of(archive: str) -> _Archive:
        return _RemoteArchive(archive) if "://" in archive else _Archive(archive)

    @contextmanager
    def local(self, scene: Scene) -> Iterator[Path]:  # noqa: ARG002 - the remote one needs it
        """Give the folder under which the scene's granules can be opened."""
        yield Path(self._root)


class _RemoteArchive(_Archive):
    """Raw files behind an fsspec URL: fetched for the time of the scene."""

    @contextmanager
    def local(self, scene: Scene) -> Iterator[Path]:
        paths = [granule.path for granule in (*scene.granules, *scene.dark)]
        with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
            RemoteStore(self._root).fetch(paths, Path(folder))
            yield Path(folder)

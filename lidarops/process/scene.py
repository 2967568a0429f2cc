"""Process one scene: open its files, retrieve, build its products and write them.

A scene is the unit of work. It gives its product files, or an outcome that states why not.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import dask.config
import xarray as xr

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.campaign.model import Campaign, InstrumentFacts, Station, as_settings
from lidarops.errors import CatalogError, LidarOpsError, ProductError, SceneError
from lidarops.kinds import kinds
from lidarops.netcdf import provenance
from lidarops.netcdf.code_version import code_version
from lidarops.netcdf.context import Context, product_path
from lidarops.netcdf.product_file import create_product
from lidarops.plan import network_plan, product_dependence
from lidarops.plan.availability import glued_channels
from lidarops.plan.preview import refine_plan
from lidarops.plan.rules import NO_PRODUCT, NOT_REQUESTED, StepName
from lidarops.plan.signal_rules import read_windows
from lidarops.process import channel_steps, network_steps
from lidarops.raw import licel
from lidarops.raw.archive import count_bytes_read, open_archive
from lidarops.raw.model import Stretches
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    Granule,
    InputRecord,
    Plan,
    ProductRecord,
    Provenance,
    Scene,
    SceneOutcome,
    Status,
    Step,
)
from lidarops.system.stores import RemoteStore, without_keys

_VANISHED: Final = "vanished after it was catalogued (run lidarops catalog again)"


@dataclass(frozen=True, slots=True)
class Job:
    """Everything that a worker needs to process one scene."""

    campaign: Campaign
    scene: Scene
    plan: Plan
    profiles_per_chunk: int | None = None
    only: str | None = None
    """The channel whose products are made; all channels where None."""

    def concerns(self, step: Step) -> bool:
        """Whether the products of the step's channel are made."""
        return self.only in (None, step.channel)

    @property
    def facts(self) -> InstrumentFacts:
        """Facts about the instrument at the time of the scene."""
        instrument = self.campaign.instruments[self.scene.instrument]
        return instrument.facts_at(self.scene.granules[0].start or self.scene.start)


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
    try:
        with _Archive.of(job.campaign.archive).local(job.scene) as root:
            outcome = _process(job, root)
    except LidarOpsError as error:
        may_pass = isinstance(error, CatalogError | ProductError) and not error.wrong_use
        return failed_outcome(job, str(error)), not may_pass
    except MemoryError as error:
        return failed_outcome(job, str(_too_large(error))), False
    except Exception as error:  # noqa: BLE001 - a bug in one scene must not stop the others
        # A disk may have failed where its error is not expected.
        return internal_error(job, error), not isinstance(error, OSError)
    return replace(outcome, cpu_seconds=time.thread_time() - begin), True


def failed_outcome(job: Job, error: str) -> SceneOutcome:
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


def internal_error(job: Job, error: BaseException) -> SceneOutcome:
    """Return the outcome of a scene that was ended by a bug of lidarops, with its traceback."""
    words = _storable("".join(traceback.format_exception_only(error)).strip())
    outcome = failed_outcome(job, f"internal error: {words} (a bug of lidarops, not of the data)")
    return replace(outcome, internal=_storable("".join(traceback.format_exception(error))))


def _storable(text: str) -> str:
    """Return a text without keys, and with escapes for what a database cannot hold."""
    return without_keys(text).encode("utf-8", "backslashreplace").decode().replace("\0", r"\0")


def _too_large(error: MemoryError) -> SceneError:
    return SceneError(
        f"the scene does not fit in memory: {error or 'no memory left'}",
        remedy="process fewer profiles at a time with a smaller --profiles-per-chunk, or give each"
        " worker more memory",
    )


def _process(job: Job, root: Path) -> SceneOutcome:
    clock = _Clock()
    product_steps = [step for step in job.plan.steps if step.name in tuple(kinds())]
    if not product_steps:
        return failed_outcome(job, nothing_to_do(job.plan))
    usable, inputs, refused, read = _digest(job, root)
    clock.lap("digest")
    failure = replace(failed_outcome(job, ""), refused=refused, inputs=inputs, bytes_read=read)
    if not usable.granules:
        return replace(failure, error="no granule of the scene can be read")
    with dask.config.set(scheduler="synchronous"), count_bytes_read() as tally:
        if usable.members:
            inputs, product = _network_product(job, usable, inputs, root, clock)
            products: tuple[ProductRecord, ...] = (product,)
        else:
            channels = list(
                dict.fromkeys(step.channel for step in product_steps if job.concerns(step))
            )
            scene_data = _open_data(job, usable, job.plan, root)
            job, scene_data = _refined(job, usable, scene_data, root)
            clock.lap("look")
            inputs += scene_data.ancillaries.inputs
            products = tuple(
                product
                for channel in channels
                for product in _channel_products(job, usable, inputs, scene_data, channel, clock)
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
    """Return why a plan makes no product: omissions of requested steps, those of products first."""
    names = tuple(kinds())
    requested = [
        omission
        for omission in plan.left_out
        if not any(words in omission.reason for words in (NOT_REQUESTED, NO_PRODUCT))
    ]
    omissions = sorted(requested or plan.left_out, key=lambda omission: omission.name not in names)
    reasons = dict.fromkeys(
        f"{omission.name} of {omission.channel}: {omission.reason}" for omission in omissions
    )
    return "nothing to do: " + "; ".join(reasons)


def _refined(
    job: Job, scene: Scene, scene_data: channel_steps.SceneData, root: Path
) -> tuple[Job, channel_steps.SceneData]:
    """Return job and data with the plan refined from some profiles of the scene."""

    def profiles(channel: str, granules: Sequence[Granule]) -> xr.Dataset:
        archive = _open(job, scene, granules, root, [channel])
        sample = channel_steps.load_small(replace(scene_data, archive=archive), [channel])
        return channel_steps.FileChannel(sample, channel).profiles().compute()

    plan = refine_plan(job.plan, scene.granules, profiles)
    return replace(job, plan=plan), replace(scene_data, plan=plan)


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
    """Check every file against the catalog, and take its digest.

    A file of unchanged size and modification time keeps the digest in the catalog, if there is
    one, and its header is not read again.

    Returns
    -------
    scene : Scene
        With usable granules only.
    inputs : tuple of InputRecord
    refused : tuple of Granule
    read : int
        Number of bytes read.
    """
    scene = job.scene
    usable: dict[str, Granule] = {}
    inputs: list[InputRecord] = []
    refused: list[Granule] = []
    read = 0
    for granule in (*scene.granules, *scene.dark):
        try:
            same = not job.campaign.all_steps and _is_unchanged(granule, root)
            sha256 = granule.sha256 if same else None
            if sha256 is None:
                read += granule.size
                sha256 = _read_digest(granule, root)
        except FileNotFoundError:
            refused.append(replace(granule, status=Status.REFUSED, reason=_VANISHED))
        except (LidarOpsError, OSError) as error:
            reason = str(error).removeprefix(f"{granule.path}: ")
            refused.append(replace(granule, status=Status.REFUSED, reason=reason))
        else:
            usable[granule.path] = granule if same else replace(granule, header_digest=None)
            inputs.append(InputRecord(granule.path, granule.role, sha256))
    return _without(scene, usable), tuple(inputs), tuple(refused), read


def _is_unchanged(granule: Granule, root: Path) -> bool:
    """Return whether a file has the size and modification time of the catalog."""
    status = os.stat(f"{root}/{granule.path}")  # noqa: PTH116 - a Path takes twice as long
    return (status.st_size, status.st_mtime_ns) == (granule.size, granule.mtime_ns)


def _read_digest(granule: Granule, root: Path) -> str:
    data = (root / granule.path).read_bytes()
    if len(data) != granule.size:
        raise SceneError(
            f"holds {len(data)} bytes, {granule.size} according to the catalog",
            remedy="run lidarops catalog again",
        )
    licel.parse_header(data, file=granule.path, size=len(data))
    return hashlib.sha256(data).hexdigest()


def _without(scene: Scene, usable: Mapping[str, Granule]) -> Scene:
    """Return a scene with its usable granules only."""
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
    # Facts of the campaign override the pointing in the headers.
    facts = product_dependence.scene_facts(job.campaign, scene)
    fixed = {"zenith_angle": facts.zenith_angle, "azimuth": facts.azimuth}
    pointing = {
        name: xr.full_like(archive["zenith_angle"], angle)
        for name, angle in fixed.items()
        if angle is not None
    }
    return archive.assign_coords(pointing) if pointing else archive


def _open_data(job: Job, scene: Scene, plan: Plan, root: Path) -> channel_steps.SceneData:
    """Open the data that the steps of a scene work on: only the channels that they read."""
    read = dict.fromkeys(step.channel for step in plan.steps if step.name == StepName.READ)
    present = {channel.name for channel in scene.layout}
    subtracted = [step.channel for step in plan.steps if step.name == StepName.DARK]
    return channel_steps.SceneData(
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
    scene_data: channel_steps.SceneData,
    name: str,
    clock: _Clock,
) -> Iterator[ProductRecord]:
    layout = _layout(job, scene, name)
    computed = channel_steps.process_channel(scene_data, name)
    clock.lap("retrieve")
    for kind, data in computed.items():
        wavelength = scene_data.steps(name)[StepName.READ].settings["wavelength"]
        context = _context(job, scene, kind, layout, wavelength, inputs)
        yield _written(job, context, data, clock)


def _written(job: Job, context: Context, data: xr.Dataset, clock: _Clock) -> ProductRecord:
    path = product_path(context)
    with create_product(data, context, job.campaign.products_root / path) as writer:
        writer.add(data)
    clock.lap("write")
    return ProductRecord(path, context.kind, context.channel, **asdict(writer.written))


def _network_product(
    job: Job, scene: Scene, inputs: tuple[InputRecord, ...], root: Path, clock: _Clock
) -> tuple[tuple[InputRecord, ...], ProductRecord]:
    """Make the product of a network; return its inputs, with ancillary files, and its record."""
    joint = {step.name: step for step in job.plan.steps if not step.instrument}
    retrieval = joint[StepName.VISIBILITY]
    members = []
    for planned, usable in zip(job.scene.members, scene.members, strict=True):
        steps = tuple(step for step in job.plan.steps if step.instrument == planned.instrument)
        if not steps:
            continue
        scene_data = None
        if usable.granules:
            scene_data = _open_data(job, usable, Plan(job.plan.scene, steps, ()), root)
            inputs += tuple(file for file in scene_data.ancillaries.inputs if file not in inputs)
        grid = network_plan.channel_ranges(
            network_plan.member_channel(planned, retrieval.channel),
            product_dependence.scene_facts(job.campaign, planned),
        )
        station = job.campaign.stations[planned.station]
        members.append(network_steps.Member(planned.instrument, station, scene_data, grid))
    data = network_steps.process_network(members, joint)
    clock.lap("retrieve")
    first = next(m for m in job.scene.members if m.instrument == members[0].instrument)
    layout = network_plan.member_channel(first, retrieval.channel)
    wavelength = retrieval.settings["wavelength"]
    context = _context(job, scene, "visibility", layout, wavelength, inputs)
    return inputs, _written(job, context, data, clock)


def _layout(job: Job, scene: Scene, name: str) -> ChannelLayout:
    instrument = job.campaign.instruments[scene.instrument]
    known = (*scene.layout, *glued_channels(scene.layout, instrument))
    return next(channel for channel in known if channel.name == name)


def _context(
    job: Job,
    scene: Scene,
    kind: str,
    channel: ChannelLayout,
    wavelength: float,
    inputs: tuple[InputRecord, ...],
) -> Context:
    campaign = job.campaign
    # A product states only what it depends on.
    closure = product_dependence.plan_closure(job.plan, [(kind, channel.name)])
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
            inputs=product_dependence.product_inputs(closure, inputs),
            plan=closure,
            settings={
                **_campaign_settings(job, closure, kind, channel.name),
                "metadata": as_settings(campaign.metadata),
                "keys": {"station": scene.station, "instrument": scene.instrument},
                "campaign": {"title": campaign.title, "summary": campaign.summary},
                "window": [scene.start.isoformat(), scene.stop.isoformat()],
            },
            versions=provenance.package_versions(),
            code_version=code_version(kind),
        ),
    )


def _campaign_settings(job: Job, plan: Plan, kind: str, channel: str) -> dict[str, Any]:
    """Return the settings of stations and instruments on which a product depends."""
    campaign, scene = job.campaign, job.scene
    if not scene.members:
        instrument = campaign.instruments[scene.instrument]
        return {
            "station": as_settings(campaign.stations[scene.station]),
            "facts": product_dependence.facts_settings(job.facts, plan, channel),
            # `lidarops reproduce` also needs these to make the same bytes.
            "instrument": instrument.name,
            "products": product_dependence.single_channel_settings(
                as_settings(instrument.products).get(kind), channel
            ),
        }
    return {
        "network": as_settings(campaign.networks[scene.instrument]),
        "members": {
            member.instrument: {
                "station": as_settings(campaign.stations[member.station]),
                "facts": product_dependence.facts_settings(
                    product_dependence.scene_facts(campaign, member), plan, channel
                ),
                "instrument": campaign.instruments[member.instrument].name,
                "keys": {"station": member.station, "instrument": member.instrument},
                "files": sorted(file.path for file in (*member.granules, *member.dark)),
            }
            for member in scene.members
        },
    }


def _station(campaign: Campaign, scene: Scene) -> Station:
    """Return the station of a scene; for a network, the mean position of its stations."""
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


class _Archive:
    """An archive of raw files on a local disk."""

    def __init__(self, root: str) -> None:
        self._root = root

    @staticmethod
    def of(archive: str) -> _Archive:
        return _RemoteArchive(archive) if "://" in archive else _Archive(archive)

    @contextmanager
    def local(self, scene: Scene) -> Iterator[Path]:  # noqa: ARG002 - the remote one needs it
        """Yield the folder under which the scene's granules can be opened."""
        yield Path(self._root)


class _RemoteArchive(_Archive):
    """An archive behind an fsspec URL: files are fetched for the time of the scene."""

    @contextmanager
    def local(self, scene: Scene) -> Iterator[Path]:
        paths = [granule.path for granule in (*scene.granules, *scene.dark)]
        with self._temporary_folder() as folder:
            RemoteStore(self._root).fetch(paths, Path(folder))
            yield Path(folder)

    @staticmethod
    def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
        try:
            # What cannot be removed does not make the products wrong.
            return tempfile.TemporaryDirectory(prefix="lidarops-", ignore_cleanup_errors=True)
        except OSError as error:
            raise CatalogError(
                f"no temporary folder for fetched raw files can be made: {error}",
                remedy="make space, or set TMPDIR to a folder you can write to",
            ) from error

"""A job: everything that a worker needs to process one scene, the memory, and how its work fails.

Whatever fails ends that scene only. The memory is estimated from the plan: process, profiles in
work, and what is held.
"""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Self, TypeVar

from lidarops.campaign.model import Campaign, Station
from lidarops.errors import (
    CatalogError,
    LidarOpsError,
    ProductError,
    SceneError,
    UnreadableFileError,
)
from lidarops.kinds import Scope, kinds, kinds_of
from lidarops.netcdf.context import Context, package_versions
from lidarops.raw.formats import raw_formats
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    InputRecord,
    Plan,
    PlannedStep,
    Scene,
    SceneOutcome,
    Stamp,
    products_of,
)
from lidarops.retrieve.signal.labeled_gluing import LAG_PROFILES
from lidarops.retrieve.signal.lag import PROFILES_AT_ONCE
from lidarops.scene import dependence
from lidarops.scene.case import REQUEST, counted_channels, prepared_channels
from lidarops.scene.dependence import ProductKey
from lidarops.scene.profiles import CHUNK_BYTES
from lidarops.scene.retrieval import Making, Workload, making, product_settings
from lidarops.system.code_version import code_version
from lidarops.system.stores import without_keys

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Place:
    """What stands at the place of a product that is made."""

    stamp: Stamp
    """Of the product to be made."""
    sha256: str = ""
    """Of the product that it replaces; empty where it replaces none."""
    former: Stamp = field(default_factory=Stamp)
    """Of that product."""


NO_PLACE: Final = Place(Stamp())
"""Of a new product."""


@dataclass(frozen=True, slots=True)
class Job:
    """Everything that a worker needs to process one scene."""

    campaign: Campaign
    scene: Scene
    plan: Plan
    profiles_per_chunk: int | None = None
    products: tuple[ProductKey, ...] | None = None
    """Those to write; all of the plan where None. The others are only compared with them."""
    places: Mapping[ProductKey, Place] = field(default_factory=dict)
    """Of products that were made before."""

    def writes(self, kind: str, channel: str) -> bool:
        """Whether a product is written."""
        return self.products is None or (kind, channel) in self.products


def nothing_to_do(plan: Plan) -> str:
    """Return why a plan makes no product: omissions of requested steps, those of products first."""
    requested = [omission for omission in plan.left_out if omission.rule != REQUEST]
    omissions = requested or plan.left_out
    reasons = dict.fromkeys(
        f"{omission.name} of {omission.channel}: {omission.reason}"
        for omission in (*products_of(omissions), *omissions)
    )
    return "nothing to do: " + "; ".join(reasons)


def product_context(
    job: Job,
    scene: Scene,
    kind: str,
    channel: ChannelLayout,
    wavelength: float,
    inputs: tuple[InputRecord, ...],
) -> Context:
    """Return the context of one product.

    Parameters
    ----------
    job : Job
        With the plan as it is carried out.
    scene : Scene
        With usable granules only.
    kind : str
        Kind of product.
    channel : ChannelLayout
    wavelength : float
        m.
    inputs : tuple of InputRecord
        Files of the scene.
    """
    campaign = job.campaign
    # A product states only what it depends on.
    closure = dependence.plan_closure(job.plan, [(kind, channel.name)])
    settings = recorded_settings(job, scene, closure, (kind, channel.name))
    station, instrument = _owner(campaign, scene)
    return Context(
        campaign=campaign.name,
        scene=scene.id,
        kind=kind,
        channel=channel.name,
        inputs=dependence.product_inputs(closure, inputs),
        plan=closure,
        settings=settings,
        versions=package_versions(),
        code_version=code_version(kind),
        mode=DetectionMode(channel.mode),
        wavelength=wavelength,
        station_key=scene.station,
        station=station,
        instrument_key=scene.instrument,
        instrument_name=instrument,
        metadata=campaign.metadata,
        title=campaign.title,
        summary=campaign.summary,
        start=scene.start,
        stop=scene.stop,
        notes=tuple(settings["notes"]),
        unused=dependence.product_unused(scene, closure),
        raw_format=" and ".join(
            sorted(
                {raw_formats()[granule.format].title for granule in (*scene.granules, *scene.dark)}
                if dependence.reads_files(closure)
                else ()
            )
        ),
        stamp=job.places.get((kind, channel.name), NO_PLACE).stamp,
    )


def recorded_settings(
    job: Job, scene: Scene, plan: Plan, product: dependence.ProductKey
) -> dict[str, Any]:
    """Return what a product states of the campaign: all that is needed to make it again.

    Parameters
    ----------
    job : Job
    scene : Scene
        With usable granules only.
    plan : Plan
        Plan of the product, from `plan_closure`.
    product : (str, str)
        Its kind and channel.
    """
    campaign, whole, (kind, channel) = job.campaign, job.scene, product
    unused = dependence.product_unused(scene, plan)
    others = {held.name for member in scene.members or (scene,) for held in member.layout}
    others -= {step.channel for step in plan.steps} | {channel}
    # Without those on channels that the product lacks.
    notes = [note for note in scene.notes if others.isdisjoint(note.split(": "))]
    if whole.members:
        dependent = _network_settings(campaign, whole, plan, kind, channel)
    else:
        instrument = campaign.instruments[whole.instrument]
        request = instrument.products.requested[kind]
        dependent = {
            "station": campaign.stations[whole.station].model_dump(mode="json"),
            "facts": dependence.facts_settings(campaign, whole, plan, channel),
            # `lidarops reproduce` also needs these to make the same bytes.
            "instrument": instrument.name,
            # As if only this product were requested, here and below.
            "products": {**request.model_dump(mode="json"), "channels": [channel]},
        }
    return {
        **dependent,
        "metadata": campaign.metadata.model_dump(mode="json"),
        "keys": {"station": scene.station, "instrument": scene.instrument},
        "campaign": {"title": campaign.title, "summary": campaign.summary},
        "window": [scene.start.isoformat(), scene.stop.isoformat()],
        "notes": notes if dependence.reads_files(plan) else [],
        **({dependence.UNUSED: [file._asdict() for file in unused]} if unused else {}),
    }


def _network_settings(
    campaign: Campaign, scene: Scene, plan: Plan, kind: str, channel: str
) -> dict[str, Any]:
    """Return the settings of the members of a network on which a product depends."""
    network = campaign.networks[scene.instrument].model_dump(mode="json")
    others = {other.name for other in kinds_of(Scope.NETWORK)} - {kind}
    return {
        "network": {key: value for key, value in network.items() if key not in others},
        "members": {
            member.instrument: {
                "station": campaign.stations[member.station].model_dump(mode="json"),
                "facts": dependence.facts_settings(campaign, member, plan, channel),
                "instrument": campaign.instruments[member.instrument].name,
                "keys": {"station": member.station, "instrument": member.instrument},
                "files": sorted(file.path for file in (*member.granules, *member.dark)),
            }
            for member in scene.members
        },
    }


def _owner(campaign: Campaign, scene: Scene) -> tuple[Station, str]:
    """Return station and name of an instrument; of a network, the mean of its stations."""
    owner = (campaign.networks if scene.members else campaign.instruments)[scene.instrument]
    name = owner.name or scene.instrument
    if not scene.members:
        return campaign.stations[scene.station], name
    places = [campaign.stations[member.station] for member in scene.members]
    mean = {
        key: sum(getattr(place, key) for place in places) / len(places)
        for key in ("latitude", "longitude", "altitude")
    }
    members = (
        campaign.instruments[member.instrument].name or place.name
        for member, place in zip(scene.members, places, strict=True)
    )
    return Station(name=name, **mean), f"network of {', '.join(members)}"


@dataclass(frozen=True, slots=True)
class Failure:
    """Why the work of a scene failed."""

    error: str
    internal: str = ""
    """Traceback of a bug of lidarops; else empty."""
    final: bool = True
    """Whether a retry would fail in the same way: no disk, network or memory was at fault."""

    @classmethod
    def of_bug(cls, error: BaseException, *, final: bool = True) -> Self:
        """Return the internal error that an exception means."""
        words = _storable("".join(traceback.format_exception_only(error)).strip())
        return cls(
            f"internal error: {words} (a bug of lidarops, not of the data)",
            _storable("".join(traceback.format_exception(error))),
            final,
        )

    def outcome(self, scene: Scene, plan: Plan | None) -> SceneOutcome:
        """Return the outcome of a scene that gave no product."""
        return SceneOutcome(
            scene=scene.id,
            station=scene.station,
            instrument=scene.instrument,
            start=scene.start,
            granules=len(scene.granules),
            plan=plan,
            error=self.error,
            internal=self.internal,
        )


def guarded(work: Callable[[], T]) -> T | Failure:
    """Return the result of some work on a scene, or why it failed: by bad data or by a bug."""
    try:
        return work()
    except LidarOpsError as error:
        passing = isinstance(error, CatalogError | ProductError | UnreadableFileError)
        may_pass = passing and not error.wrong_use
        return Failure(str(error), final=not may_pass)
    except MemoryError as error:
        problem = SceneError(
            f"the scene does not fit in memory: {error or 'no memory left'}",
            remedy="process fewer profiles at a time with a smaller --profiles-per-chunk, or give"
            " each process more memory",
        )
        return Failure(str(problem), final=False)
    except Exception as error:  # noqa: BLE001 - a bug in one scene must not stop the others
        # A disk may have failed where its error is not expected.
        return Failure.of_bug(error, final=not isinstance(error, OSError))


def _storable(text: str) -> str:
    """Return a text without keys, and with escapes for what a database cannot hold."""
    return without_keys(text).encode("utf-8", "backslashreplace").decode().replace("\0", r"\0")


PROCESS: Final = 420_000_000
"""Bytes of a process with the code of all kinds loaded; above what ``benchmarks throughput --case
memory`` measures, like all sizes here."""
OF_A_COUNT: Final = 26.0
"""Bytes at the peak of a chunk of ``signal``, for each byte of its counts; other kinds take
less."""
OF_A_FILE: Final = 5_000
"""Bytes of the facts about a raw file."""
OF_A_RESULT: Final = 0.1
"""Bytes of a product that waits for those with which it is compared, for each byte of its
retrieval: 38 of 430 for an altitude of a beam."""
_OF_A_DARK_BIN: Final = 24.0
"""Bytes per bin of a dark file: three arrays of float64 while sessions are averaged."""
_OF_AN_ESTIMATE: Final = 105.0
"""Bytes per bin of a profile of a group from which a dead time is estimated, at the peak; raw
counts of all groups are held besides."""
_OF_A_LAG_BIN: Final = 65.0
"""Bytes per bin of a profile from which a lag is estimated; gluing takes four times as many."""
_COUNT: Final = 4
"""Bytes of a raw count."""


@dataclass(frozen=True, slots=True)
class SceneMemory:
    """Memory of a process that processes a scene, bytes."""

    held: float
    """Held for the whole scene, besides the process."""
    profile: float
    """Raw counts of one profile of the widest channel."""
    profiles: int
    """Number of profiles."""
    together: int = 1
    """Largest number of profiles that a chunk must not part."""
    process: float = PROCESS

    @property
    def total(self) -> float:
        """Bytes with chunks of the usual size."""
        return self.of(max(1, int(CHUNK_BYTES // max(self.profile, 1))))

    def of(self, profiles: int) -> float:
        """Return the bytes with chunks of some profiles."""
        together = min(max(profiles, self.together), self.profiles)
        return self.process + self.held + OF_A_COUNT * self.profile * together

    def profiles_within(self, limit: float) -> int:
        """Return the largest number of profiles of a chunk within a limit; 0 where none fits."""
        if self.of(1) > limit:
            return 0
        left = limit - self.process - self.held
        return max(1, int(left // max(OF_A_COUNT * self.profile, 1)))


def scene_memory(scene: Scene, plan: Plan) -> SceneMemory:
    """Return the estimated memory of a scene."""
    held: defaultdict[str, float] = defaultdict(float)
    together = 1
    members = {member.instrument: member for member in scene.members}
    for step in plan.steps:
        work = Workload(members.get(step.instrument, scene), step.channel)
        if step in plan.products:
            known = making(step.product, Making)
            settings = product_settings(plan.steps, step.product, step.channel)
            held[step.channel] += known.held(settings, work)
            together = max(together, known.together(settings, work))
        elif not step.product:
            held[step.channel] += _held_by_stage(step, work)
    files = len(scene.granules) + len(scene.dark)
    compared = [held[step.channel] for step in plan.products if kinds()[step.product].common]
    # Channels are processed one after the other.
    channels = [prepared_channels(plan.steps, step.channel) for step in plan.products]
    most = max((sum(held[name] for name in names) for names in channels), default=0.0)
    return SceneMemory(
        held=OF_A_FILE * files + most + OF_A_RESULT * sum(compared),
        profile=float(_COUNT * _most_bins(scene, plan)),
        together=together,
        profiles=max((len(member.granules) for member in scene.members or (scene,)), default=0),
    )


def _held_by_stage(step: PlannedStep, work: Workload) -> float:
    """Return the bytes that a stage of the pipe holds for the whole scene."""
    profiles = min(PROFILES_AT_ONCE, work.profiles)
    match step.name:
        case "dark":
            return _OF_A_DARK_BIN * len(work.scene.dark) * work.bins
        case "dead_time" if "analog" in step.settings:
            counts = _COUNT * min(LAG_PROFILES, work.profiles)
            return (_OF_AN_ESTIMATE * profiles + counts) * work.bins
        case "glue":
            return _OF_A_LAG_BIN * profiles * work.bins
        case _:
            return 0.0


def _most_bins(scene: Scene, plan: Plan) -> int:
    """Return the largest number of bins that a profile of a product is made from."""
    layouts = [
        {channel.name: channel.bins for channel in member.layout}
        for member in scene.members or (scene,)
    ]
    return max(
        (
            sum(bins.get(name, 0) for name in counted_channels(plan.steps, step.channel))
            for step in plan.products
            for bins in layouts
        ),
        default=0,
    )

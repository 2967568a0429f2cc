"""The product ``visibility`` of a network: its beams, its decision, and its making."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import ChannelFacts, InstrumentFacts, Station, channel_facts
from lidarops.flags import Quality
from lidarops.products.visibility import NAME, VisibilityProductSettings
from lidarops.products.visibility.variables import LAYOUT
from lidarops.records import (
    DetectionMode,
    Granule,
    LeftOut,
    PlannedStep,
    Scene,
    file_channels,
    is_glued,
)
from lidarops.retrieve.air.visibility import VisibilityDefinition
from lidarops.retrieve.background.estimate import window_before
from lidarops.retrieve.network import geometry, labeled
from lidarops.retrieve.network.labeled import BeamAverages
from lidarops.retrieve.network.settings import NetworkAssumptions
from lidarops.retrieve.network.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled_averaging import joined
from lidarops.scene.case import (
    ALL_STEPS,
    READ_STEP,
    ChannelCase,
    Entries,
    Entry,
    NoSettings,
    channel_ranges,
    joined_layout,
    member_channel,
    product_channel,
)
from lidarops.scene.dependence import scene_facts
from lidarops.scene.pipe import NO_WAVELENGTH, plan_stages
from lidarops.scene.profiles import Averages, Chunk, Indices
from lidarops.scene.retrieval import (
    ANALOG_NOISE,
    WINDOW,
    AverageSettings,
    BackgroundSettings,
    Member,
    NetworkCase,
    NetworkRetrieval,
    NetworkStream,
    WindowSettings,
    Workload,
    average,
    background,
    bins_within,
    merged,
    tail,
)
from lidarops.settings import SettingsModel, VisibilitySettings

Case = ChannelCase[VisibilityProductSettings]

_SAME_POINTING: Final = 0.1
"""degree; pointings of one instrument within this angle are one beam (resolution of headers)."""
_SAME_WAVELENGTH: Final = 1e-9
"""m; largest difference between equal wavelengths of instruments."""
_EPOCH: Final = np.datetime64("1970-01-01T00:00:00", "ns")


# Beams of members ---------------------------------------------------------------------------------


class BeamPlan(SettingsModel):
    """One beam of one member of a network."""

    instrument: str
    zenith_angle: float
    """degree."""
    azimuth: float
    """degree."""
    nearest: float
    """m, smallest range at which the signal is used."""
    farthest: float
    """m."""
    exponent: float


def _member(case: NetworkCase[VisibilityProductSettings], scene: Scene, name: str) -> Case:
    """Return the case of a channel of an instrument, given its scene."""
    facts, channel = scene_facts(case.campaign, scene), member_channel(scene.layout, name)
    return ChannelCase(
        scene,
        channel,
        facts,
        channel_facts(facts, name),
        case.request,
        all_steps=case.campaign.all_steps,
        member=scene.instrument,
        requesters=(NAME,),
    )


def _why_not(case: Case) -> tuple[str, float | None]:
    """Return why a member cannot take part (empty where it can), and the deciding number."""
    facts, channel, limits = case.facts, case.channel, case.request.background_range
    if math.isnan(case.facts_of_channel.wavelength or channel.wavelength):
        return NO_WAVELENGTH, None
    if not (facts.overlap_profile or facts.full_overlap_range > 0):
        return (
            "the campaign gives neither full_overlap_range nor overlap_profile: an overlap"
            " error of 1 percent at the nearest crossing changes extinction there by 5 percent"
        ), facts.full_overlap_range
    last = channel.bins * channel.bin_width
    if limits and limits[0] >= last:
        return f"background_range begins beyond the last bin, which ends at {last:g} m", last
    if any(_granule_pointing(granule, facts) is None for granule in case.scene.granules):
        return "neither headers nor campaign give the pointing of all beams", None
    return "", None


def _pointings(case: Case) -> Iterator[BeamPlan]:
    """Yield the beams of a member, each once."""
    found = (_granule_pointing(granule, case.facts) for granule in case.scene.granules)
    end = float(channel_ranges(case.channel, case.facts_of_channel)[-1])
    instrument, settings = case.scene.instrument, case.request
    distinct: list[tuple[float, float]] = []
    for direction in sorted({direction for direction in found if direction is not None}):
        if not any(angle_between(direction, other) <= _SAME_POINTING for other in distinct):
            distinct.append(direction)
    for zenith, azimuth in distinct:
        yield BeamPlan(
            instrument=instrument,
            zenith_angle=zenith,
            azimuth=azimuth,
            nearest=case.facts.full_overlap_range,
            farthest=min(end, settings.farthest or end),
            exponent=settings.exponents.get(instrument, settings.exponent),
        )


def _granule_pointing(granule: Granule, facts: InstrumentFacts) -> tuple[float, float] | None:
    """Return zenith angle and azimuth of a granule; facts of the campaign override headers."""
    zenith = granule.zenith_angle if facts.zenith_angle is None else facts.zenith_angle
    azimuth = granule.azimuth if facts.azimuth is None else facts.azimuth
    if zenith is None or azimuth is None:
        return None
    return zenith, azimuth % 360.0


def angle_between(pointing: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the angle between two pointings (zenith angle, azimuth), all in degree."""
    first, second = (
        (
            math.sin(math.radians(zenith)) * math.sin(math.radians(azimuth)),
            math.sin(math.radians(zenith)) * math.cos(math.radians(azimuth)),
            math.cos(math.radians(zenith)),
        )
        for zenith, azimuth in (pointing, other)
    )
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * math.dist(first, second))))


def crossings(
    beams: Sequence[BeamPlan], stations: Mapping[str, Station], settings: NetworkAssumptions
) -> geometry.Network:
    """Return the crossings of beams of instruments at stations; see `geometry.build_network`."""
    owners = [stations[beam.instrument] for beam in beams]
    places = [(owner.latitude, owner.longitude, owner.altitude) for owner in owners]
    return geometry.build_network(
        [
            geometry.Beam(*place, beam.azimuth, 90.0 - beam.zenith_angle)
            for place, beam in zip(places, beams, strict=True)
        ],
        tolerance=settings.tolerance,
        nearest=[beam.nearest for beam in beams],
        farthest=[beam.farthest for beam in beams],
        smallest_angle=settings.smallest_angle,
    )


# Decision -----------------------------------------------------------------------------------------


def _window(case: Case, farthest: float) -> Entry:
    """Return the bins that the crossings of an instrument and its background need.

    Some bins are not needed in photon counting beyond the farthest crossing, given in m.
    """
    rule, channel = "member_window", case.channel
    if is_glued(channel.name) or channel.mode is not DetectionMode.PHOTON:
        return case.leave(WINDOW, ANALOG_NOISE, rule=rule)
    if case.all_steps:
        return case.leave(WINDOW, ALL_STEPS, rule=rule)
    width, (start, stop) = channel.bin_width, tail(case, case.request.background_range)
    low, high = window_before(start + width)
    near = bins_within(0.0, farthest + THRESHOLDS.bins_beyond * width, case)
    ends = (low - width, high), (start, stop)
    far = (bins_within(*limits, case, averaged=True) for limits in ends)
    kept = merged((first, min(past, channel.bins)) for first, past in (near, *far))
    number = float(sum(past - first for first, past in kept))
    if len(kept) == 1 and number == channel.bins:
        reason = "crossings and background need all bins"
        return case.leave(WINDOW, reason, number=number, rule=rule)
    reason = "bins between the farthest crossing and the background range are not needed"
    settings = WindowSettings(bins=tuple(kept))
    return case.run(WINDOW, reason, settings, number=number, rule=rule)


def _prior(case: Case) -> Entry:
    """Use a prior that the profiles of a block share, unless the campaign requests none."""
    settings = case.request
    if settings.multiplier is not None:
        reason = "a multiplier is requested: triangles of beams are solved without prior"
        return case.leave("prior", reason)
    if settings.prior == "none":
        reason = "the campaign requests no prior: gradients along beams mimic attenuation"
        return case.leave("prior", reason)
    reason = "decided from the data: how much the field of a block changes"
    return case.run("prior", reason, number=settings.block / settings.average)


class NetworkSettings(VisibilitySettings, NetworkAssumptions):
    """Settings of the entry ``visibility``."""

    beams: tuple[BeamPlan, ...]
    wavelength: float
    """m."""
    block_seconds: float

    @property
    def definition(self) -> VisibilityDefinition:
        """Definition of visibility."""
        values = {name: getattr(self, name) for name in VisibilitySettings.model_fields}
        return VisibilityDefinition(self.wavelength, **values)


class VisibilityPlan(SettingsModel):
    """What a plan states of a product for the whole network."""

    average: AverageSettings
    prior: NoSettings | None = None
    visibility: NetworkSettings


class MemberPlan(SettingsModel):
    """What a plan states of a product for one instrument."""

    background: BackgroundSettings
    range_window: WindowSettings | None = None


def _held(settings: VisibilityPlan, work: Workload) -> float:
    """Return the bytes of the averages of all beams."""
    bins = max(channel.bins for member in work.scene.members for channel in member.layout)
    seconds, beams = settings.average.seconds, settings.visibility.beams
    averages = sum(work.intervals(seconds, beam.instrument) for beam in beams)
    return _BYTES_OF_A_BIN * bins * averages


_BYTES_OF_A_BIN: Final = 60.0
"""Bytes per bin of an average of a beam: power, variance and quality, and copies; assumed, not
measured."""


def _needs(case: NetworkCase[VisibilityProductSettings]) -> Entries:
    """Retrieve extinction and visibility where the beams of a network cross.

    The entries of the members that take part come first, then those of the whole network.
    """
    scene, name = case.scene, case.request.channel
    joint = ChannelCase(
        scene, product_channel(name), InstrumentFacts(), ChannelFacts(), case.request, product=NAME
    )
    able: list[Case] = []
    for member in _members(case, joint):
        if isinstance(member, ChannelCase):
            able.append(member)
        else:
            yield member
    prepared = [entry for own in able for entry in _prepared(case, own)]
    yield from (entry for entry in prepared if isinstance(entry, LeftOut))
    steps = [entry for entry in prepared if isinstance(entry, PlannedStep)]
    wavelengths = [step.settings["wavelength"] for step in steps if step.name == READ_STEP]
    beams = [beam for own in able for beam in _pointings(own)]
    stations = {m.instrument: case.campaign.stations[m.station] for m in scene.members}
    reason = _why_none(joint, beams, wavelengths)
    if reason is None:
        yield from _without_lonely_beams(joint, beams, stations)
        if not beams:
            why_none = "no beam has two crossings with other beams, between which it is attenuated"
            reason = joint.leave(NAME, why_none, number=0.0, rule="some_meet")
    if reason is not None:
        yield reason
        return
    used = {beam.instrument for beam in beams}
    yield from (step for step in steps if step.instrument in used)
    network = crossings(beams, stations, joint.request)
    for own in able:
        numbers = [n for n, beam in enumerate(beams) if beam.instrument == own.member]
        if numbers:
            farthest = max(float(network.on_beam(n)[1][-1]) for n in numbers)
            yield _window(replace(own, product=NAME), farthest)
    yield from _joint(joint, beams, network, min(wavelengths))


def _members(case: NetworkCase[VisibilityProductSettings], joint: Case) -> Iterator[Case | Entry]:
    """Yield the cases of the members that can take part, and why others cannot."""
    scenes, name = {scene.instrument: scene for scene in case.scene.members}, case.request.channel
    for member in case.campaign.networks[case.scene.instrument].instruments:
        if member not in scenes:
            yield _left(joint, member, "no granule in the window", 0.0, "member_present")
    for member, scene in scenes.items():
        held = [c.name for c in (*scene.layout, *joined_layout(scene.layout, [name]))]
        if name not in held:
            why = f"the files hold no {name}, only {', '.join(held)}"
            yield _left(joint, member, why, None, "member")
            continue
        own = _member(case, scene, name)
        why, number = _why_not(own)
        yield _left(joint, member, why, number, "member") if why else own


def _left(joint: Case, member: str, reason: str, number: float | None, rule: str) -> Entry:
    return replace(joint, member=member).leave(NAME, reason, number=number, rule=rule)


def _prepared(case: NetworkCase[VisibilityProductSettings], own: Case) -> Entries:
    """Yield the steps from the counts of an instrument to its signal."""
    name = own.channel.name
    for channel in dict.fromkeys((*file_channels(name), name)):
        yield from plan_stages(_member(case, own.scene, channel))
    yield background(replace(own, product=NAME), "tail_mean", own.request.background_range)


def _why_none(joint: Case, beams: Sequence[BeamPlan], wavelengths: Sequence[float]) -> Entry | None:
    """Return why there can be no network, whatever the crossings."""
    if wavelengths and max(wavelengths) - min(wavelengths) > _SAME_WAVELENGTH:
        listed = ", ".join(f"{metres * 1e9:g}" for metres in sorted(set(wavelengths)))
        reason = f"the instruments have different wavelengths: {listed} nm"
        number = max(wavelengths) - min(wavelengths)
        return joint.leave(NAME, reason, number=number, rule="one_wavelength")
    if len(beams) > THRESHOLDS.most_beams:
        reason = f"{len(beams)} beams exceed the limit of {THRESHOLDS.most_beams}"
        return joint.leave(NAME, reason, number=float(len(beams)), rule="few_beams")
    return None


def _without_lonely_beams(
    joint: Case, beams: list[BeamPlan], stations: Mapping[str, Station]
) -> Entries:
    """Take out beams with fewer than two crossings, until all remaining beams have two."""
    while beams:
        network = crossings(beams, stations, joint.request)
        counts = {beam: int(network.on_beam(n)[0].size) for n, beam in enumerate(beams)}
        lonely = [beam for beam in beams if counts[beam] < 2]
        for beam in lonely:
            pointing = f"zenith angle {beam.zenith_angle:g} and azimuth {beam.azimuth:g} degree"
            reason = f"the beam at {pointing} has fewer than two crossings with other beams"
            yield _left(joint, beam.instrument, reason, float(counts[beam]), "beams_meet")
            beams.remove(beam)
        if not lonely:
            return


def _joint(
    case: Case, beams: Sequence[BeamPlan], network: geometry.Network, wavelength: float
) -> Entries:
    """Yield the steps of the whole network."""
    settings = case.request
    reason = "signals are averaged before the retrieval: noise biases means of retrieved values"
    yield average(case, settings.average, reason)
    yield _prior(case)
    by_triangles = (
        ""
        if settings.multiplier is None
        else f"; solved by triangles with the multiplier {settings.multiplier}"
    )
    yield case.run(
        NAME,
        f"{len(beams)} beams of {len({beam.instrument for beam in beams})} instruments have"
        f" {network.crossings} crossings, {int(network.near_crossing.sum())} of them near ones"
        f"{by_triangles}",
        NetworkSettings.taken_from(
            settings,
            beams=tuple(beams),
            wavelength=wavelength,
            block_seconds=settings.block.total_seconds(),
            **dict(settings.visibility.resolved),
        ),
        needs=("read", "overlap", "noise", "glue", "background", WINDOW, "average", "prior"),
        number=float(network.crossings),
    )


# Making -------------------------------------------------------------------------------------------


class _NetworkStream(NetworkStream):
    """Averages of all beams of a network, and what is retrieved from them."""

    def __init__(self, settings: VisibilityPlan, members: Sequence[Member[MemberPlan]]) -> None:
        self._settings, self._seconds = settings.visibility, settings.average.seconds
        self.wavelength = self._settings.wavelength
        by_name = {member.instrument: member for member in members}
        self._beams = [
            _Beam(by_name[beam.instrument], beam, self._seconds) for beam in self._settings.beams
        ]

    def add(self, member: Member[MemberPlan], chunk: Chunk) -> None:
        """Add profiles of an instrument to the averages of its beams."""
        for beam in self._beams:
            if beam.member is member:
                beam.add(chunk)

    def result(self) -> xr.Dataset:
        """Return the variables of the product."""
        settings = self._settings
        stations = {beam.member.instrument: beam.member.station for beam in self._beams}
        retrieved = labeled.retrieve_network(
            [beam.signals() for beam in self._beams],
            crossings(settings.beams, stations, settings),
            settings,
            block_intervals=round(settings.block_seconds / self._seconds),
            visibility=settings.definition,
        )
        method = "beams_with_prior" if settings.prior == "block" else "beams_without_prior"
        if settings.multiplier is not None:
            method = "triangles"
        return retrieved.assign(retrieval_method=LAYOUT.rows["retrieval_method"].code(method))


class _Beam:
    """One beam of a member: the averaged profiles of its pointing."""

    def __init__(self, member: Member[MemberPlan], planned: BeamPlan, seconds: float) -> None:
        self.member, self._planned = member, planned
        self._averages: Averages | None = None
        self._interval: Indices = np.zeros(0, dtype=np.int64)
        self._profiles: Indices = np.zeros(0, dtype=np.int64)
        signal = member.signal
        if signal is None:
            return
        geometry_of_all = signal.source.geometry
        self._profiles = _profiles_of(geometry_of_all, planned)
        if self._profiles.size:
            of_beam = geometry_of_all.isel(time=self._profiles)
            shots = signal.shots.isel(time=self._profiles)
            self._averages = Averages([signal.profiles], of_beam, shots, seconds)
            self._interval = _intervals(of_beam["time"].to_numpy(), seconds)

    def add(self, chunk: Chunk) -> None:
        """Add the profiles of a chunk that have the pointing of the beam."""
        inside = (self._profiles >= chunk.rows.start) & (self._profiles < chunk.rows.stop)
        if self._averages is not None and inside.any():
            self._averages.add(chunk, self._profiles[inside] - chunk.rows.start)

    def signals(self) -> BeamAverages:
        """Return the averages with the geometry and settings of the beam."""
        member, planned, signal = self.member, self._planned, self.member.signal
        averages = (
            _no_averages(member.range)
            if self._averages is None
            else joined(means for (means,) in self._averages.completed())
        )
        distance = averages["range"].to_numpy().astype(np.float64)
        limits = (distance[0], np.inf) if signal is None else member.settings.background.range
        return BeamAverages(
            averages=averages,
            interval=self._interval,
            instrument=member.instrument,
            station=(member.station.latitude, member.station.longitude, member.station.altitude),
            background_range=limits,
            nearest=planned.nearest,
            overlap=None if signal is None else signal.overlap_at(distance),
            exponent=planned.exponent,
            zenith_angle=planned.zenith_angle,
            azimuth=planned.azimuth,
        )


def _profiles_of(geometry_of_all: xr.Dataset, beam: BeamPlan) -> Indices:
    """Return the numbers of the profiles of a beam."""
    planned = (beam.zenith_angle, beam.azimuth)
    angles = (geometry_of_all[name].to_numpy() for name in ("zenith_angle", "azimuth"))
    pointings = zip(*angles, strict=True)
    return np.flatnonzero([angle_between(one, planned) <= _SAME_POINTING for one in pointings])


def _intervals(moments: npt.NDArray[np.datetime64], seconds: float) -> Indices:
    """Return the numbers of the clock intervals that hold profiles, each once."""
    length = np.timedelta64(round(seconds * 1e9), "ns")
    return np.unique((moments.astype("datetime64[ns]") - _EPOCH) // length).astype(np.int64)


def _no_averages(distance: npt.NDArray[np.float64]) -> xr.Dataset:
    """Return averages of a beam without profiles."""
    empty = np.zeros((0, distance.size))
    pair = ("time", "range")
    return xr.Dataset(
        {
            "power": (pair, empty),
            "variance": (pair, empty),
            "quality": (pair, np.full(empty.shape, int(Quality.INPUT_MISSING), dtype=np.int32)),
            "shots": ("time", np.zeros(0, dtype=np.int32)),
        },
        coords={
            "range": distance,
            "time_bnds": (("time", "nv"), np.zeros((0, 2), dtype="datetime64[ns]")),
        },
    )


RETRIEVAL: Final = NetworkRetrieval(
    settings=VisibilityPlan, member=MemberPlan, needs=_needs, stream=_NetworkStream, held=_held
)

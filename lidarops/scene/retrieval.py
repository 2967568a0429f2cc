"""What a kind of product is to the processing: a decision, and products in the making.

Below it, what several kinds decide alike: background, average, pointing, bins that are read.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from types import NoneType
from typing import Any, Final, Generic, Literal, TypeVar, get_args

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.campaign.model import Campaign, ChannelFacts, Station
from lidarops.constants import FIXED, KNOWN_SHAPE_PAPERS, LEAST_SPREAD, STEEPEST
from lidarops.errors import LidarOpsError
from lidarops.flags import FlagBit, Quality
from lidarops.kinds import kinds
from lidarops.netcdf.read import open_product
from lidarops.netcdf.variables import (
    BACKGROUND_METHOD,
    MOLECULAR_SOURCE,
    QUALITY_FLAG,
    judging,
    whole_error,
)
from lidarops.raw.header import Stretches
from lidarops.records import ChannelLayout, PlannedStep, Scene, file_channels, is_glued, products_of
from lidarops.retrieve.background.thresholds import THRESHOLDS as BACKGROUND
from lidarops.retrieve.common.arrays import widest_azimuth_gap
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.counts_to_signal import MIN_NOISE_BINS
from lidarops.retrieve.signal.thresholds import THRESHOLDS
from lidarops.scene.case import ChannelCase, Entries, Entry, prepared_channels, range_offset
from lidarops.scene.pipe import Stages
from lidarops.scene.profiles import BEFORE, ChannelSignal, Chunk, ProductStream
from lidarops.settings import ReferenceSettings, SettingsModel, quantity

ANALOG_NOISE: Final = "the noise of an analog record is estimated from all its bins"
WINDOW: Final = "range_window"
"""Name of the entry of a plan by which a product states the bins that it needs."""

R = TypeVar("R")
S = TypeVar("S", bound=SettingsModel)
M = TypeVar("M", bound="Making[Any]")


@dataclass(frozen=True, slots=True)
class Workload:
    """One channel of a scene, or of a member of a network."""

    scene: Scene
    """The whole network for the steps that are not of one member."""
    channel: str

    @property
    def profiles(self) -> int:
        """Number of profiles."""
        return len(self.scene.granules)

    @property
    def bins(self) -> int:
        """Number of bins of a profile."""
        made_from = file_channels(self.channel)
        return min(layout.bins for layout in self.scene.layout if layout.name in made_from)

    def intervals(self, seconds: float, instrument: str = "") -> int:
        """Return the number of clock intervals that hold profiles, of one member if named."""
        scenes = [member for member in self.scene.members if member.instrument == instrument]
        starts = (granule.start for scene in scenes or [self.scene] for granule in scene.granules)
        return len({math.floor(start.timestamp() / seconds) for start in starts if start})


# No slots: typing sets an attribute of generic instances, where it can.
@dataclass(frozen=True, kw_only=True)
class Making(Generic[S]):
    """What kinds of one channel and of a network have in common."""

    settings: type[S]
    """What a plan states of a product: a field for each of its entries, by name; None where the
    entry is left out."""
    needs: Callable[[Any], Entries]
    """Yields the entries of a case: what runs, and what is left out."""
    held: Callable[[S, Workload], float] = lambda _settings, _work: 0.0
    """Returns the estimated number of bytes that are held for the whole scene."""
    together: Callable[[S, Workload], int] = lambda _settings, _work: 1
    """Returns the largest number of profiles that a chunk must not part."""


@dataclass(frozen=True, kw_only=True)
class Retrieval(Making[S]):
    """How the products of a kind come about, each from one channel: `needs` of a `ChannelCase`."""

    stream: Callable[[S, ChannelSignal], ProductStream]
    """Returns the product in the making, which takes the profiles of the scene in chunks."""


@dataclass(frozen=True, slots=True)
class InputProduct:
    """A product of which another one is made."""

    kind: str
    channel: str
    file: Path

    def open(self, names: Iterable[str]) -> AbstractContextManager[xr.Dataset]:
        """Open it for some of its variables, as `lidarops.netcdf.read.open_product`."""
        return open_product(self.file, names)


@dataclass(frozen=True, kw_only=True)
class Derivation(Making[S]):
    """How the products of a kind come about, each from others: `needs` of a `ChannelCase`.

    It is asked only where all products are there that the kind reads, of the channel and of its
    `companions`. The case of a month has no facts, and a channel without bins.
    """

    derive: Callable[[S, Sequence[InputProduct]], Iterator[xr.Dataset]]
    """Yields the frame of the product, then its rows in batches, from products by path, so that
    those of a kind and channel are in order of time; as of a `ProductStream`."""


@dataclass(frozen=True, slots=True)
class NetworkCase(Generic[R]):
    """The scene of a network, as a kind of product sees it before any signal is read."""

    scene: Scene
    campaign: Campaign
    request: R
    """Settings of the kind in the campaign file."""


@dataclass(frozen=True, slots=True)
class Member(Generic[S]):
    """One instrument of a network, with the signal of the channel that the network uses."""

    instrument: str
    station: Station
    signal: ChannelSignal | None
    """None where no granule can be read."""
    settings: S
    """What the plan states of the product for this instrument."""
    range: npt.NDArray[np.float64]
    """m, ranges of the bins according to the plan."""


class NetworkStream(ABC):
    """A product of a network in the making."""

    wavelength: float
    """m."""

    @abstractmethod
    def add(self, member: Member[Any], chunk: Chunk) -> None:
        """Take the next profiles of an instrument."""

    @abstractmethod
    def result(self) -> xr.Dataset:
        """Return the variables of the product, in memory."""


@dataclass(frozen=True, kw_only=True)
class NetworkRetrieval(Making[S]):
    """How the products of a kind come about, each from a network: `needs` of a `NetworkCase`."""

    member: type[SettingsModel]
    """What a plan states for one instrument, as `settings`."""
    stream: Callable[[S, Sequence[Member[Any]]], NetworkStream]
    """Returns the product in the making, which takes the profiles of all instruments."""


def making(kind: str, sort: type[M]) -> M:
    """Return how the products of a kind come about.

    Parameters
    ----------
    kind : str
    sort : type
        `Making`, or the one of its kinds that suits the settings of the kind of product.

    Raises
    ------
    LidarOpsError
        If there is no such kind, its package is incomplete, or it is of another sort.
    """
    known = kinds()[kind]
    found: M = known.part("retrieval", "RETRIEVAL")
    if not isinstance(found, sort) or kind not in found.settings.model_fields:
        raise LidarOpsError(
            f"kind of product {kind!r}: RETRIEVAL is no {sort.__name__} with settings of {kind}",
            remedy=f"correct {known.package}.retrieval",
        )
    return found


def product_settings(
    steps: Iterable[PlannedStep], kind: str, channel: str, member: str = ""
) -> SettingsModel:
    """Return what a plan states of a product, or of one instrument of its network."""
    model = making(kind, NetworkRetrieval).member if member else making(kind, Making).settings
    return model.model_validate(
        {
            step.name: dict(step.settings)
            for step in steps
            if (step.product, step.channel, step.instrument) == (kind, channel, member)
        }
    )


def streams_of(steps: Sequence[PlannedStep], signal: ChannelSignal) -> dict[str, ProductStream]:
    """Return the products of a channel in the making, by kind."""
    channel = signal.channel
    return {
        step.product: making(step.product, Retrieval).stream(
            product_settings(steps, step.product, channel), signal
        )
        for step in products_of(steps)
        if step.channel == channel and not kinds()[step.product].reads
    }


def settings_model(step: PlannedStep) -> Any:
    """Return the model of the settings of an entry of a plan, of pydantic or a dataclass."""
    fields = Stages.model_fields
    if step.product:
        known = making(step.product, Making)
        fields = known.settings.model_fields | (
            known.member.model_fields if isinstance(known, NetworkRetrieval) else {}
        )
    annotation = fields[step.name].annotation
    # None is what a product states where the entry is left out.
    return next(m for m in (*get_args(annotation), annotation) if m is not NoneType)


def with_methods(
    product: xr.Dataset,
    signal: ChannelSignal,
    standard_air: FlagBit,
    air_error: float,
    *,
    known_shape: bool,
) -> xr.Dataset:
    """Return the product with its air, and method and papers of its backgrounds.

    Parameters
    ----------
    product : xr.Dataset
    signal : ChannelSignal
    standard_air : FlagBit
        Bit of values where the standard atmosphere stands for the sources of the campaign.
    air_error : float
        Relative standard error of the density of the air.
    known_shape : bool
        Whether the background is fitted with the shape of the signal of clean air.
    """
    before = f"{BEFORE}{signal.channel}" in signal.source.archive
    method = "before_pulse" if before else "known_shape" if known_shape else "tail_mean"
    if method == "known_shape":
        product = product.assign_attrs(references=KNOWN_SHAPE_PAPERS)
    air, states = signal.air, MOLECULAR_SOURCE.states
    if signal.air_error is not None:
        names = [str(name) for name in product if str(name).endswith(QUALITY_FLAG)]
        climb = np.cos(np.deg2rad(signal.source.pointing["zenith_angle"]))
        altitude = signal.source.station_altitude + climb * product["range"]
        bits = (altitude > (air.top if air else -np.inf)) * np.int32(standard_air)
        product = product.assign({name: product[name] | bits for name in names})
    origin = air.origin if air else states[0 if signal.molecules.standard else 1]
    stated = {
        "molecular_profile_age": air.age if air else np.nan,
        "molecular_profile_distance": air.distance if air else np.nan,
        "molecular_density_relative_error": air_error,
        MOLECULAR_SOURCE.name: [state.startswith(origin) for state in states].index(True),
        "background_method": BACKGROUND_METHOD.code(method),
    }
    return product.assign(stated)


def bins_before(channel: ChannelLayout, facts: ChannelFacts) -> int:
    """Return how many bins before the pulse give the background; 0 for too few, as of glued ones.

    As many are needed as are in the far range by default.
    """
    if not channel.pre_trigger or is_glued(channel.name):
        return 0
    # Those in which the pulse leaves, by the offset of the channel, hold light.
    bins = channel.before - max(math.ceil(range_offset(channel, facts) / channel.bin_width), 0)
    return bins if bins >= max(BACKGROUND.tail_share * channel.bins, COMMON.fewest_bins) else 0


def before_pulse(case: ChannelCase[Any]) -> str:
    """Return why bins before the pulse give the background; empty where they do not."""
    bins = bins_before(case.channel, case.facts_of_channel)
    return f"mean of the {bins} bins before the pulse" if bins else ""


def tail(case: ChannelCase[Any], limits: tuple[float, float] | None) -> tuple[float, float]:
    """Return the limits in m of the far range whose mean is the background.

    By default the last tenth of the bins.
    """
    start, stop = limits or (
        (1.0 - BACKGROUND.tail_share) * case.last,
        case.last,
    )
    return start, min(stop, case.last)


class BackgroundSettings(SettingsModel):
    """How a background is estimated."""

    method: Literal["tail_mean", "cubic", "known_shape", "before_pulse"]
    range: tuple[float, float] = quantity(unit="m")


def background(
    case: ChannelCase[Any],
    method: Literal["tail_mean", "cubic", "known_shape"],
    limits: tuple[float, float] | None = None,
) -> Entry:
    """Return how the background is estimated, and from which range, m; see `tail`.

    A product is to be left out where the range holds too few bins.
    """
    start, stop = tail(case, limits)
    where = "the last tenth of the bins" if limits is None else "background_range of the campaign"
    reason = f"mean of {where}; signal there biases it"
    warning = ""
    if method == "cubic":
        # `test_the_cubic_doubts_weak_signals`
        reason = f"cubic of a homogeneous section, {where}; other sections bias it"
        warning = (
            "the cubic marks all values as uncertain where the signal of the first bin of its"
            " section is less than 30 times its noise, and some up to 300 times"
        )
    elif method == "known_shape":
        reason = (
            "fitted with the shape of clean air, which is assumed in the far range, and tested;"
            f" mean of {where} where the fit fails"
        )
    return case.run(
        "background",
        reason,
        BackgroundSettings(method=method, range=(start, stop)),
        number=(stop - start) / case.channel.bin_width,
        warning=warning,
    )


class AverageSettings(SettingsModel):
    """Clock intervals over which profiles are averaged."""

    seconds: float = quantity(unit="s")


def average(case: ChannelCase[Any], interval: timedelta, reason: str) -> Entry:
    """Return over which clock intervals profiles are averaged, and why."""
    seconds = interval.total_seconds()
    return case.run("average", reason, AverageSettings(seconds=seconds), number=seconds)


def with_low_signal_to_noise(rows: xr.Dataset, names: Sequence[str], least: float) -> xr.Dataset:
    """Return rows with the bit LOW_SIGNAL_TO_NOISE where a value is small against its error.

    It is that of the flags which judge the value.

    Parameters
    ----------
    rows : xr.Dataset
        With the variables, their standard errors, the errors by dead time and baseline beside these
        where there are some, and the flags, of the same dimensions.
    names : sequence of str
        Variables, of which one with the same flags is enough.
    least : float
        Least ratio of a value to its error without the bit; 0 for no bit.
    """
    known = [str(name) for name in rows.data_vars]
    for name in names:
        flags = rows[judging(name, known)]
        value, error = (
            part.transpose(*flags.dims).to_numpy() for part in (rows[name], whole_error(rows, name))
        )
        bit = (np.abs(value) < least * error) * np.int32(Quality.LOW_SIGNAL_TO_NOISE)
        rows = rows.assign({str(flags.name): flags.copy(data=flags.to_numpy() | bit)})
    return rows


def _zenith_angles(case: ChannelCase[Any]) -> list[float | None]:
    """Return the zenith angle of each file of a scene, degree; one if the campaign states it."""
    if case.facts.zenith_angle is not None:
        return [case.facts.zenith_angle]
    return [granule.zenith_angle for granule in case.scene.granules]


def no_scan(case: ChannelCase[Any]) -> str:
    """Return why the files of a scene are not a scan; empty where they are."""
    if case.facts.zenith_angle is not None:
        angle = case.facts.zenith_angle
        return f"the campaign states a fixed beam at a zenith angle of {angle:g} degree"
    stated = _zenith_angles(case)
    angles = [angle for angle in stated if angle is not None]
    if len(angles) < len(stated):
        return "headers lack zenith angles"
    spread, sector = max(angles) - min(angles), _azimuth_sector(case)
    if spread < LEAST_SPREAD <= sector:
        elevation = 90.0 - 0.5 * (max(angles) + min(angles))
        return (
            f"a plan-position scan (PPI) at {elevation:.3g} degree above the horizon, over an"
            f" azimuth sector of {sector:.3g} degree: its slant paths do not differ"
        )
    if spread < LEAST_SPREAD:
        return f"zenith angles span only {spread:g} degree: the beam does not scan"
    return ""


def moves(case: ChannelCase[Any]) -> bool:
    """Return whether the files of a scene point to several directions, of any pattern."""
    if case.facts.zenith_angle is not None:
        return False
    angles = [angle for angle in _zenith_angles(case) if angle is not None]
    return bool(angles and max(angles) - min(angles) > FIXED) or _azimuth_sector(case) > FIXED


def _azimuth_sector(case: ChannelCase[Any]) -> float:
    """Return the narrowest azimuth sector that holds all beams, degree."""
    if case.facts.azimuth is not None:
        return 0.0
    granules = case.scene.granules
    azimuth = [granule.azimuth for granule in granules if granule.azimuth is not None]
    # The sector of all beams may hold north.
    return 360.0 - math.degrees(widest_azimuth_gap(np.radians(azimuth)))


def reference_limits(
    case: ChannelCase[Any], window: ReferenceSettings
) -> tuple[float, ReferenceSettings | str]:
    """Return the zenith angle of a fixed beam, degree, and its limits of the reference window.

    Along the beam, up to its last bin; or why there can be no window.
    """
    stated = _zenith_angles(case)
    angles = [angle for angle in stated if angle is not None]
    if len(angles) < len(stated):
        return math.nan, "neither headers nor campaign give the zenith angle"
    zenith = max(angles)
    if zenith - min(angles) > FIXED:
        reason = f"the zenith angle of the beam changes from {min(angles):g} to {zenith:g}"
        return math.nan, f"{reason} degree"
    if zenith > STEEPEST:
        reason = f"at a zenith angle of {zenith:g} degree the beam does not reach"
        return math.nan, f"{reason} aerosol-free air"
    # A window is a set of bin centres.
    reach = case.last - 0.5 * case.channel.bin_width
    along = window.along(1.0 / math.cos(math.radians(zenith)))
    top = min(along.highest, reach)
    if top - along.lowest < along.width * (1.0 - 1e-9):
        return zenith, (
            f"the last bin at {reach:g} m is too near for a reference window of {window.width:g} m"
            f" above {window.lowest:g} m"
        )
    return zenith, along.model_copy(update={"highest": top})


class WindowSettings(SettingsModel):
    """The bins that a product needs of a channel; `read_windows` joins those of all products."""

    bins: tuple[tuple[int, int], ...]
    """First bin and the one past the last, of each stretch that is read."""


def read_windows(steps: Collection[PlannedStep]) -> dict[str, Stretches]:
    """Return the channels of which only some bins are needed, with these bins."""
    windows: dict[str, list[tuple[int, int]]] = {}
    for step in steps:
        if step.name == WINDOW and not idle_window(step, steps):
            settings = WindowSettings.model_validate(step.settings)
            windows.setdefault(step.channel, []).extend(settings.bins)
    return {channel: tuple(merged(stretches)) for channel, stretches in windows.items()}


def merged(stretches: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return stretches of bins, ascending, with touching ones merged and empty ones left out."""
    kept: list[tuple[int, int]] = []
    for first, past in sorted(stretches):
        if kept and first <= kept[-1][1]:
            kept[-1] = (kept[-1][0], max(kept[-1][1], past))
        elif first < past:
            kept.append((first, past))
    return kept


def idle_window(step: PlannedStep, steps: Collection[PlannedStep]) -> str:
    """Return why a range window has no effect; empty where it has one, or for other steps.

    Such a window stays in the plan, because the plan stated in a product must not depend on the
    other products of the scene.

    Parameters
    ----------
    step : PlannedStep
    steps : collection of PlannedStep
        All steps of the scene.
    """
    if step.name != WINDOW:
        return ""
    estimates = [s for s in steps if s.name == "dead_time" and "analog" in s.settings]
    if any(step.channel in (s.channel, s.settings["analog"]) for s in estimates):
        return "the estimate of a dead time needs all bins"
    windowed = {
        (other.channel, other.product)
        for other in steps
        if other.name == WINDOW and other.instrument == step.instrument
    }
    needing = list(
        dict.fromkeys(
            other.product if other.channel == step.channel else other.channel
            for other in steps
            if other.instrument in ("", step.instrument)
            and other.product
            and step.channel in prepared_channels(steps, other.channel)
            and (other.channel, other.product) not in windowed
        )
    )
    if not needing:
        return ""
    return f"{' and '.join(needing)} need{'s' if len(needing) == 1 else ''} all bins"


def bins_within(
    nearest: float, farthest: float, case: ChannelCase[Any], *, averaged: bool = False
) -> tuple[int, int]:
    """Return the bins of counts between ranges in m, with those that their noise needs.

    The variance of a count is that of the mean over a share of the range on either side. Bins that
    are averaged need no others: the noise at the ends then comes from fewer bins.

    Returns
    -------
    (int, int)
        The first bin, and the one past the last, which may lie beyond the channel.
    """
    width, offset = case.channel.bin_width, case.range_offset
    share = THRESHOLDS.noise_window
    # Two for rounding.
    before, behind = (
        2 if averaged else max(math.ceil(share * distance / width), MIN_NOISE_BINS) + 2
        for distance in (nearest, farthest)
    )
    first = math.floor((nearest - offset) / width) - before
    return max(first, 0), max(math.ceil((farthest - offset) / width) + behind, 0)

"""The product ``multiangle``: its decision, which follows from the pointing, and its making.

What the retrieval decides from the data is planned where the beams permit it. The attribute
``lidarops_steps`` of the product states what was decided.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.constants import KNOWN_SHAPE_PAPERS, MULTIANGLE_PAPER
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.netcdf.variables import BACKGROUND_METHOD
from lidarops.products.multiangle import MultiAngleSettings, ScanSettings
from lidarops.products.multiangle.variables import LAYOUT
from lidarops.records import DetectionMode, Granule
from lidarops.retrieve.common.arrays import widest_azimuth_gap
from lidarops.retrieve.multiangle import labeled, scan_cycles, slant_paths
from lidarops.retrieve.multiangle.analog_baseline import AnalogBaseline, BlockedBeams
from lidarops.retrieve.multiangle.labeled_altitudes import BATCH, AltitudeCycles, BeamAir
from lidarops.retrieve.multiangle.optical_depth import (
    REGULARISED,
    WITHOUT_GRADIENT,
    OpticalDepthSettings,
)
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.scene.case import REQUESTED, ChannelCase, Entries, Entry, NoSettings
from lidarops.scene.profiles import (
    ChannelSignal,
    Chunk,
    Indices,
    ProductStream,
    Profiles,
    in_one_batch,
)
from lidarops.scene.retrieval import (
    BackgroundSettings,
    Retrieval,
    Workload,
    background,
    no_scan,
    with_low_signal_to_noise,
)
from lidarops.settings import SettingsModel

Array = npt.NDArray[np.float64]
Case = ChannelCase[MultiAngleSettings]
Numbers = tuple[tuple[float, ...], ...]
"""Angles, or bounds of time, of each granule."""
_FEWEST_DIRECTIONS: Final = 2
"""Two paths define a slope."""
_UNKNOWN: Final = np.int32(Quality.INPUT_MISSING | Quality.SATURATED)
"""Bits of bins that show nothing; what blocks a beam may stand where the overlap is incomplete."""
_NAMED: Final = 6
"""Most blocked beams that notes name."""
_TOGETHER: Final = 8
"""Profiles that are averaged together; the result does not depend on it."""
LOWEST_ELEVATION: Final = math.degrees(math.asin(1.0 / THRESHOLDS.longest_path))
"""degree; lower beams are longer than the longest path, but for the curvature of the Earth."""


def altitude_steps(step: float, highest: float) -> Array:
    """Return the altitudes of a multi-angle product, m above the station."""
    return np.arange(step, highest + 1e-6, step)


@dataclass(frozen=True, slots=True)
class Beams:
    """The beam directions of a scan that the retrieval uses."""

    sides_known: bool
    """Whether any azimuth is known."""
    low: int = 0
    """Number of directions that are left out, because their path is too long or they do not rise.
    """
    count: int = 0
    free: float = 360.0
    """degree, the largest azimuth sector without beams."""
    surround: bool = False
    """Whether no half turn is free of beams, so that a horizontal gradient can be estimated."""
    span: float = 0.0
    """Largest minus smallest slant path over the vertical one."""
    pattern: str = ""
    """Such as a volume of 6 vertical planes."""
    cycles: int = 0
    largest: int = 0
    """Number of directions of the cycle that has most."""
    single: tuple[int, ...] = ()
    """The first granule of each cycle of one direction, which has no value."""


def beams(case: Case) -> Beams:
    """Return the beam directions that the retrieval will use from the files of a scan."""
    settings = case.request
    side = case.facts.azimuth
    pointings = tuple(
        (_number(granule.zenith_angle), _number(granule.azimuth if side is None else side))
        for granule in case.scene.granules
    )
    return _beams(pointings, _bounds(case.scene.granules), settings.step, settings.highest)


def _bounds(granules: Iterable[Granule]) -> Numbers:
    """Return start and end of each granule, s."""
    return tuple(
        tuple(moment.timestamp() for moment in (granule.start, granule.stop) if moment)
        for granule in granules
    )


def _number(angle: float | None) -> float:
    return math.nan if angle is None else angle


# All channels of a scene have the same beams.
@lru_cache(maxsize=1)
def _beams(pointings: Numbers, bounds: Numbers, step: float, highest: float) -> Beams:
    zenith_angle, azimuth = np.array(pointings).T
    sides_known = bool(np.isfinite(azimuth).any())
    try:
        directions = scan_cycles.directions(zenith_angle, azimuth)
        cycle = scan_cycles.cycles(zenith_angle, azimuth, bounds)
    except RetrievalInputError:
        # The retrieval raises the same error with its message.
        return Beams(sides_known)
    altitude = altitude_steps(step, highest)
    up = slant_paths.rising_beams(directions.zenith_angle, altitude)
    low = directions.zenith_angle.size - up.size
    if up.size == 0:
        return Beams(sides_known, low)
    scan = slant_paths.make_scan(directions.zenith_angle[up], altitude, directions.azimuth[up])
    tilted = scan.tilted_azimuths
    angles = directions.zenith_angle[up]
    profiles = np.flatnonzero(np.isin(directions.index, up))
    seen = np.unique(np.stack([cycle[profiles], directions.index[profiles]]), axis=1)[0]
    numbers, counts = np.unique(seen, return_counts=True)
    single = numbers[counts < _FEWEST_DIRECTIONS]
    return Beams(
        sides_known,
        low,
        up.size,
        math.degrees(widest_azimuth_gap(tilted)),
        slant_paths.surrounds_zenith(tilted),
        float(np.ptp(scan.path[:, 0])),
        _pattern(angles, directions.azimuth[up]) if sides_known else f"{up.size} zenith angles",
        counts.size,
        int(counts.max()),
        tuple(int(row) for row in np.searchsorted(cycle, single)),
    )


def _pattern(zenith_angle: Array, azimuth: Array) -> str:
    """Return the name of the pattern of a scan of known azimuths."""
    planes = scan_cycles.vertical_planes(zenith_angle, azimuth)
    if len(planes) != 1:
        return f"a volume of {len(planes)} vertical planes, {azimuth.size} directions"
    lowest = azimuth[np.argmax(zenith_angle)]
    return f"a range-height scan (RHI) at azimuth {lowest:.0f} degree, {azimuth.size} directions"


def _low_beams(directions: Beams) -> str:
    """Return the warning of beams that are left out as too low; empty where there are none."""
    if not directions.low:
        return ""
    count = directions.low + directions.count
    return (
        f"beam directions less than {LOWEST_ELEVATION:.1f} degree above the horizon, left out:"
        f" {directions.low} of {count} ({directions.low / count:.0%})"
    )


def _without_leverage(directions: Beams) -> str:
    """Return why slant paths do not differ enough for an optical depth; empty where they do."""
    if directions.span >= THRESHOLDS.least_span or not directions.low + directions.count:
        return ""
    if directions.count < _FEWEST_DIRECTIONS:
        return f"beam directions: {directions.count}, which give no leverage"
    return (
        f"slant paths differ by {directions.span:.2g} vertical paths, less than"
        f" {THRESHOLDS.least_span:g}, which give no leverage"
    )


def _single_beams(case: Case, directions: Beams) -> str:
    """Return the warning of cycles of one beam; empty where there are none."""
    if not directions.single:
        return ""
    granules = [case.scene.granules[row] for row in directions.single]
    limit = 90.0 - THRESHOLDS.lowest_free
    steep = [granule.path for granule in granules if abs(granule.zenith_angle or 0.0) <= limit]
    advice = (
        f": leave their files out of `files` (first: {steep[0]})"
        if steep
        else "; where the beam is blocked, it shows the analog baseline of other cycles"
    )
    return (
        f"cycles of one beam only: {len(granules)} of {directions.cycles}. All their values are"
        f" rejected{advice}"
    )


def _baseline(case: Case) -> Entry:
    """Subtract the analog baseline that blocked beams show.

    For analog channels of scans with beams so low that they may be blocked.
    """
    if case.channel.mode is DetectionMode.PHOTON:
        return case.leave("baseline", "photon counting has no analog baseline")
    angles = [granule.zenith_angle for granule in case.scene.granules]
    lowest = 90.0 - max((angle for angle in angles if angle is not None), default=0.0)
    limit = f"{THRESHOLDS.lowest_free:g} degree above the horizon"
    if lowest >= THRESHOLDS.lowest_free:
        reason = f"no beam is lower than {limit}, where trees and buildings may block it"
        return case.leave("baseline", reason, number=lowest)
    reason = (
        f"beams lower than {limit} may be blocked: decided from the data, from what lies"
        " behind obstructions"
    )
    taken = ("noise", "glue", "background")
    return case.run("baseline", reason, needs=taken, number=lowest)


def _gradient(case: Case, directions: Beams) -> Entry:
    """Include a horizontal gradient of backscatter in the error, unless that is excluded."""
    largest = case.request.largest_gradient
    if largest <= 0:
        reason = "largest_gradient of the campaign is 0: only what the residuals show is included"
        return case.leave("gradient", reason, number=0.0)
    blind = case.request.method in WITHOUT_GRADIENT
    use = "part of the error" if blind else "retrieved, or part of the error"
    reason = f"backscatter may vary horizontally: {use}"
    if directions.surround and directions.pattern.startswith("a volume"):
        reason += (
            "; of vertical planes, from the scatter between them, pooled over all cycles of"
            f" the scene and {THRESHOLDS.pooled} altitudes"
        )
    return case.run("gradient", reason, number=largest)


def _gradient_regressor(case: Case, directions: Beams) -> Entry:
    """Fit a horizontal gradient where beams point to all sides."""
    name, method = "gradient_regressor", case.request.method
    if method in WITHOUT_GRADIENT:
        return case.leave(name, f"method {method} fits no horizontal gradient")
    if not directions.sides_known:
        reason = "headers give no azimuths: all beams are assumed to point to one side"
        return case.leave(name, reason)
    if not directions.surround:
        sector = f"an azimuth sector of {directions.free:g} degree"
        reason = f"{sector}, more than a half turn, has no beams"
        return case.leave(name, reason, number=directions.free)
    reason = (
        "beams point to all sides, so a horizontal gradient can be estimated; decided from"
        " the data, at altitudes with signal"
    )
    return case.run(name, reason, number=directions.free)


def _vertical(case: Case, directions: Beams) -> Entry:
    """Regularise the profile along altitude where the method treats altitudes together."""
    settings, count = case.request, directions.count
    if settings.method not in ("auto", "joint"):
        reason = f"method {settings.method} treats each altitude independently"
        return case.leave("vertical", reason)
    if settings.method == "auto" and count <= 2:
        reason = "two beam directions give one difference at each altitude, used without smoothing"
        return case.leave("vertical", reason, number=float(count))
    reason = "decided from the data: the smoothing increases with the noise of single altitudes"
    return case.run("vertical", reason, number=float(round(settings.highest / settings.step)))


def _correlation(case: Case, directions: Beams) -> Entry:
    """Include the correlation of errors along altitude where redundant beams can show it."""
    spare, method = float(directions.count - 2), case.request.method
    if method in REGULARISED:
        reason = f"method {method} assumes independent errors at different altitudes"
        return case.leave("correlation", reason)
    if spare <= 0:
        reason = "no beam direction is redundant: residuals show no correlation along altitude"
        return case.leave("correlation", reason, number=spare)
    reason = "decided from the data: AR(1) along altitude, from residuals of redundant beams"
    return case.run("correlation", reason, number=spare)


def _layers(case: Case) -> Entry:
    """Give the optical depth of layers where the campaign requests it."""
    number = float(len(case.request.layers))
    if number:
        reason = "the campaign requests the optical depth of layers"
        return case.run("layers", reason, number=number)
    return case.leave("layers", "the campaign requests no layers", number=number)


class MultiAnglePlan(SettingsModel):
    """What a plan states of a product; the retrieval decides the rest from the data."""

    background: BackgroundSettings
    baseline: NoSettings | None = None
    gradient: NoSettings | None = None
    gradient_regressor: NoSettings | None = None
    vertical: NoSettings | None = None
    correlation: NoSettings | None = None
    layers: NoSettings | None = None
    multiangle: ScanSettings


def _needs(case: Case) -> Entries:
    """Retrieve optical depth and extinction from the beams of each cycle, where the beam scans."""
    reason = no_scan(case)
    if reason:
        yield case.leave("multiangle", reason)
        return
    directions = beams(case)
    without_leverage = _without_leverage(directions)
    if without_leverage:
        reason = "; ".join(filter(None, (_low_beams(directions), without_leverage)))
        yield case.leave("multiangle", reason, number=float(directions.count))
        return
    yield background(case, case.request.background)
    yield _baseline(case)
    yield _gradient(case, directions)
    yield _gradient_regressor(case, directions)
    yield _vertical(case, directions)
    yield _correlation(case, directions)
    yield _layers(case)
    yield _retrieved(case, directions)


def _retrieved(case: Case, directions: Beams) -> Entry:
    settings = case.request
    words = f"{REQUESTED}, and the beam scans"
    if directions.pattern:
        words += f": {directions.pattern}"
    if directions.cycles > 1:
        words += f", in {directions.cycles} cycles of at most {directions.largest}"
    return case.run(
        "multiangle",
        words,
        ScanSettings.taken_from(settings),
        needs=(
            "read", "overlap", "noise", "glue", "molecular", "background", "baseline", "gradient",
            "gradient_regressor", "vertical", "correlation", "layers",
        ),
        warning="; ".join(filter(None, (_single_beams(case, directions), _low_beams(directions)))),
    )  # fmt: skip


def _together(settings: MultiAnglePlan, work: Workload) -> int:  # noqa: ARG001
    """Return the number of profiles of the longest batch of cycles."""
    granules = work.scene.granules
    zenith_angle, azimuth = (
        [_number(getattr(granule, name)) for granule in granules]
        for name in ("zenith_angle", "azimuth")
    )
    numbers = scan_cycles.cycles(zenith_angle, azimuth, _bounds(granules))
    return max(BATCH, int(np.bincount(numbers[numbers >= 0]).max(initial=1)))


def _held(settings: MultiAnglePlan, work: Workload) -> float:
    """Return the bytes of the cycles, of low beams, and of what is retrieved from them."""
    scan = settings.multiangle
    beams = _BYTES_OF_AN_ALTITUDE * work.profiles * scan.highest / scan.step
    if settings.baseline is None:
        return beams
    # So low that they may be blocked.
    limit = 90.0 - THRESHOLDS.lowest_free
    low = sum((granule.zenith_angle or 0.0) > limit for granule in work.scene.granules)
    return beams + _BYTES_OF_A_BIN * min(_TOGETHER, low) * work.bins


_BYTES_OF_AN_ALTITUDE: Final = 430.0
"""Bytes per altitude of a beam of a cycle at the peak of the retrieval, as ``python -m benchmarks
throughput --case memory`` measures."""
_BYTES_OF_A_BIN: Final = 90.0
"""Bytes per bin of a low beam while it is averaged, at the peak."""


class _Scans(ProductStream):
    """Scan cycles in altitude cells, and their optical depth."""

    def __init__(self, settings: MultiAnglePlan, signal: ChannelSignal) -> None:
        self._settings, self._station = settings.multiangle, signal.source.station_altitude
        self._signal, self._background = signal, settings.background
        self._known_shape = self._background.method == "known_shape"
        self._shows_baseline = settings.baseline is not None
        self._blocked = BlockedBeams(signal.profiles.range, self._background.range)
        self._cycles = self._empty_cycles()
        self.notes: list[str] = []

    def _empty_cycles(self, baseline: AnalogBaseline | None = None) -> AltitudeCycles:
        signal, settings = self._signal, self._settings
        geometry, distance = signal.source.geometry, signal.profiles.range
        air = None
        if self._known_shape:
            air = BeamAir(signal.molecules, signal.wavelength, signal.source.shared)
        return AltitudeCycles(
            distance,
            scan=geometry.assign(shots=signal.shots),
            altitude_grid=self._station + altitude_steps(settings.step, settings.highest),
            station_altitude=self._station,
            background_range=self._background.range,
            air=air,
            overlap=signal.overlap_at(distance),
            baseline=baseline,
        )

    def ends(self) -> Indices:
        """Return the rows before which a chunk may end: those that begin a cycle."""
        return self._cycles.ends()

    def add(self, chunk: Chunk) -> Iterable[xr.Dataset]:
        """Average the cycles of the next profiles over altitude cells."""
        profiles = self._signal.profiles
        _add_low_beams(self._blocked, chunk, profiles)
        self._cycles.add(chunk.profiles(profiles), chunk.rows.start)
        return ()

    def _without_baseline(self, baseline: AnalogBaseline) -> AltitudeCycles:
        """Return the cycles of all profiles, read again, from which a baseline is subtracted."""
        archive, cycles = self._signal.source.archive, self._empty_cycles(baseline)
        for first, past in itertools.pairwise([0, *cycles.ends(), archive.sizes["time"]]):
            cycles.add(self._signal.profiles.of(archive.isel(time=slice(first, past))), first)
        return cycles

    def results(self) -> Iterator[xr.Dataset]:
        """Yield the optical depth of all cycles."""
        settings = self._settings
        baseline = self._blocked.baseline() if self._shows_baseline else None
        cycles = self._cycles if baseline is None else self._without_baseline(baseline)
        optical_depth = labeled.retrieve_optical_depth(
            cycles.result(self._blocked.obstructions()),
            OpticalDepthSettings(
                method=settings.method,
                station_altitude=self._station,
                largest_gradient=settings.largest_gradient,
                layers=[(low + self._station, top + self._station) for low, top in settings.layers],
                regularisation=settings.regularisation,
            ),
        )
        self.notes += blocked_in_words(optical_depth)
        optical_depth = optical_depth.assign(
            retrieval_method=LAYOUT.rows["retrieval_method"].code(optical_depth.attrs["method"]),
            background_method=BACKGROUND_METHOD.code(self._background.method),
        )
        # Beside those of all methods.
        papers = [MULTIANGLE_PAPER] if settings.method in REGULARISED else []
        papers += [KNOWN_SHAPE_PAPERS] if self._known_shape else []
        if papers:
            optical_depth = optical_depth.assign_attrs(references="\n".join(papers))
        if baseline is not None:
            optical_depth = _with_baseline(optical_depth, baseline, self._signal.source.geometry)
        least = settings.least_signal_to_noise
        return in_one_batch(with_low_signal_to_noise(optical_depth, LAYOUT.weighed, least))


def _add_low_beams(beams: BlockedBeams, chunk: Chunk, profiles: Profiles) -> None:
    """Take the beams of a chunk that are so low that they may be blocked."""
    conditioned, first = chunk.profiles(profiles), chunk.rows.start
    elevation = 90.0 - chunk.geometry["zenith_angle"].to_numpy()
    low = np.flatnonzero(elevation < THRESHOLDS.lowest_free)
    for start in range(0, low.size, _TOGETHER):
        rows = low[start : start + _TOGETHER]
        power, variance, quality, length = (
            conditioned[name].to_numpy()[rows]
            for name in ("power", "variance", "quality", CORRELATION_LENGTH)
        )
        missing = (quality & _UNKNOWN) != 0
        values = np.where(missing, np.nan, power)
        beams.add(values, variance * length[:, np.newaxis], first + rows)


def blocked_in_words(product: xr.Dataset) -> list[str]:
    """Return one note on the low beams that are blocked; none where all are free.

    Channels with the same blocked beams have the same note, so that it is reported once: the range
    is that of the product. Obstructions of steeper beams are clouds.
    """
    known = product["beam_obstruction"].notnull().any("time").to_numpy()
    elevation = 90.0 - product["beam_zenith_angle"].to_numpy()
    blocked = np.flatnonzero(known & (elevation < THRESHOLDS.lowest_free))
    if not blocked.size:
        return []
    sides = product["beam_azimuth"].to_numpy() if "beam_azimuth" in product.coords else None
    beams = [
        f"{elevation[beam]:.3g}" + ("" if sides is None else f" (azimuth {sides[beam]:.3g})")
        for beam in blocked
    ]
    more = f" and {blocked.size - _NAMED} more" if blocked.size > _NAMED else ""
    return [
        (
            f"blocked beams: elevation {', '.join(beams[:_NAMED])}{more}"
            " degree, from the range in beam_obstruction of the product"
        )
    ]


def _with_baseline(
    product: xr.Dataset, baseline: AnalogBaseline, geometry: xr.Dataset
) -> xr.Dataset:
    """Return a product with the baseline that was subtracted, and the profiles that show it."""
    blocked = {
        f"blocked_{name}": ("blocked", geometry[name].to_numpy()[baseline.profile])
        for name in ("zenith_angle", "azimuth")
        if name in geometry
    }
    return product.assign(
        {
            "analog_baseline": ("baseline_range", baseline.power),
            "analog_baseline_standard_error": ("baseline_range", baseline.standard_error),
            "blocked_range": ("blocked", baseline.obstruction),
            **blocked,
        }
    ).assign_coords(baseline_range=baseline.range)


RETRIEVAL: Final = Retrieval(
    settings=MultiAnglePlan, needs=_needs, stream=_Scans, held=_held, together=_together
)

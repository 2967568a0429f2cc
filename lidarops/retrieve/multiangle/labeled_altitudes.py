"""Profiles of a scan over xarray: sorted by cycle and beam, in altitude cells."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.air.molecular import MolecularProfile, molecular_lidar_ratio
from lidarops.retrieve.background import estimate, known_shape
from lidarops.retrieve.common.arrays import Array, Block, Flags, Indices, Integers
from lidarops.retrieve.multiangle import scan_cycles, slant_paths
from lidarops.retrieve.multiangle._cell_means import at_centres, average_over_cells
from lidarops.retrieve.multiangle.analog_baseline import AnalogBaseline, obstruction_range
from lidarops.retrieve.multiangle.flags import CARE
from lidarops.retrieve.signal.averaging import RunningMean
from lidarops.retrieve.signal.labeled import (
    BASELINE_ERROR,
    CORRELATION_LENGTH,
    baseline_error,
    dead_time_change,
)

_CUBE: Final = ("time", "beam", "altitude")
_DIMENSIONS: Final = {
    "signal": _CUBE,
    "variance": _CUBE,
    "quality": ("time", "altitude"),
    "left": ("time", "beam"),
    "obstruction": ("time", "beam"),
    "dead_time_error": _CUBE,
    "baseline_error": _CUBE,
}
"""Of the arrays of cycles; see `AltitudeCycles.result`."""
_OF_CELLS: Final = {name for name, dims in _DIMENSIONS.items() if dims == _CUBE}
BATCH: Final = 64
"""Profiles averaged together, unless one cycle has more."""
_LEVELS: Final = ("altitude", "pressure", "temperature")
_FEW: Final = 16
"""Profiles whose bins are prepared together, so that they stay in the cache of the processor; the
result does not depend on it."""
_BESIDE: Final = 4
"""Bins beyond the highest cell, of which its mean needs one."""


class AltitudeCycles:
    """Profiles of a scan in altitude cells, sorted by cycle and beam, from chunks of profiles.

    The variance of the background is added to that of the noise. Profiles of one cycle and
    direction are averaged, weighted by their shots. Beams that do not rise by 3 degrees or have no
    known direction are left out, as are cycles without other beams.
    Only the cycles are held; chunks do not change a bit of the result.

    Parameters
    ----------
    distance : (range,) float
        m along the beam.
    zenith_angle, azimuth : (time,) float
        degree, as for `lidarops.retrieve.multiangle.scan_cycles.directions`.
    time_bnds : (time, 2) datetime64
        Start and end of each profile; starts rising.
    shots : (time,) int
        Number of laser shots of each profile.
    altitude_grid : (altitude,) float
        m above mean sea level, ascending, above the station, at least two; uniform for the method
        "joint". The edges of cells are midway between altitudes.
    station_altitude : float
        m above mean sea level.
    background_range : (float, float)
        m along the beam: the tail, whose mean is the background.
    molecules : MolecularProfile, optional
        If given, the background is that of `estimate.from_far_range`, else that of
        `estimate.from_bounded_tail` (`lidarops.retrieve.background`).
    wavelength : float
        m, for the scattering of the molecules.
    overlap : (range,) float, optional
        The signal is divided by it; NaN where it is not known.
    baseline : AnalogBaseline, optional
        Subtracted from the power of all profiles, whose baseline error is then that of it.
    shapes : dict, optional
        Keeps the signals of clean air along the beams, for other channels of the scan.

    Raises
    ------
    RetrievalInputError
        For invalid arguments, or if no beam points above the horizon.
    """

    def __init__(
        self,
        distance: Array,
        *,
        zenith_angle: npt.ArrayLike,
        azimuth: npt.ArrayLike | None,
        time_bnds: npt.ArrayLike,
        shots: npt.ArrayLike,
        altitude_grid: npt.ArrayLike,
        station_altitude: float,
        background_range: tuple[float, float],
        molecules: MolecularProfile | None = None,
        wavelength: float = np.nan,
        overlap: Array | None = None,
        baseline: AnalogBaseline | None = None,
        shapes: dict[Any, Any] | None = None,
    ) -> None:
        directions = scan_cycles.directions(zenith_angle, azimuth)
        numbers = scan_cycles.cycles(zenith_angle, azimuth, time_bnds)
        levels = np.asarray(altitude_grid, dtype=np.float64)
        height = slant_paths.altitude_grid(levels, station_altitude)
        if height.size < 2:
            raise RetrievalInputError(
                "holds one altitude", field="altitude_grid", remedy="give at least two, in m"
            )
        self._order = order = _order(directions, numbers, height)
        slant_edges = _slant_edges(order.zenith_angle, height)
        self._settings = _Settings(
            distance=distance,
            overlap=overlap,
            background_range=background_range,
            shapes=None
            if molecules is None
            else _kept_shapes(
                {} if shapes is None else shapes,
                molecules,
                (wavelength, order.zenith_angle, distance, station_altitude),
            ),
            altitude=levels,
            slant_edges=slant_edges,
            baseline=baseline,
        )
        self._weights = np.asarray(shots, dtype=np.float64)
        self._bounds = np.asarray(time_bnds)
        self._sides_known = (
            azimuth is not None and np.isfinite(np.asarray(azimuth, dtype=np.float64)).any()
        )
        self._batches = list(_batches(order))
        self._pieces: list[dict[str, Block]] = []

    def ends(self) -> Integers:
        """Return the profiles before which a chunk may end: those that begin a cycle."""
        profiles = self._order.profile
        return np.array([profiles[batch].min() for batch in self._batches[1:]], dtype=np.int64)

    def add(self, conditioned: xr.Dataset, first: int) -> None:
        """Add consecutive profiles, which end where a cycle does.

        Parameters
        ----------
        conditioned : xr.Dataset
            ``power``, ``variance`` and ``quality`` over (time, range), and
            ``noise_correlation_length`` over time, from
            `lidarops.retrieve.signal.labeled.condition` or
            `lidarops.retrieve.signal.labeled_gluing.glue`.
        first : int
            Number of the first of the profiles in the scene.
        """
        past = first + conditioned.sizes["time"]
        profiles = tuple(
            conditioned[name].to_numpy()
            for name in ("power", "variance", "quality", CORRELATION_LENGTH)
        )
        changes = dead_time_change(conditioned), self._baseline_error(conditioned)
        while len(self._pieces) < len(self._batches):
            batch = self._batches[len(self._pieces)]
            members = self._order.profile[batch]
            if members.max() >= past:
                break
            cycle = self._order.cycle[batch] - self._order.cycle[batch.start]
            self._pieces.append(
                _batch_on_altitudes(
                    profiles,
                    changes,
                    members - first,
                    self._weights[members],
                    cycle,
                    self._order.beam[batch],
                    self._settings,
                )
            )

    def _baseline_error(self, conditioned: xr.Dataset) -> Array | None:
        """Return the error of the baseline of analog profiles, (time, range covered)."""
        error, settings = baseline_error(conditioned), self._settings
        if error is None:
            return None
        # A stated value has no share of the light; it replaces what blocked beams show.
        given = conditioned["power"].attrs.get(BASELINE_ERROR, (0.0, 1.0))[1] == 0.0
        if settings.baseline is None or given:
            return error.transpose("time", "range").to_numpy()[:, settings.covered]
        measured = settings.baseline.error_at(settings.distance[settings.covered])
        return np.broadcast_to(measured, (error.sizes["time"], measured.size))

    def result(self, obstructions: Mapping[int, float] | None = None) -> xr.Dataset:
        """Return the cycles of all profiles.

        Parameters
        ----------
        obstructions : mapping of int to float, optional
            m, range from which profiles are blocked, by their number in the scene; from
            `lidarops.retrieve.multiangle.analog_baseline.BlockedBeams.obstructions`, which sees
            obstructions nearer than full overlap too.

        Returns
        -------
        xr.Dataset
            ``signal`` (range-corrected) and ``variance`` over (time, beam, altitude), NaN where
            missing; ``quality`` (the bits of all bins at an altitude) over (time, altitude);
            ``left`` (the standard error of the background by signal in the far range) and
            ``obstruction`` (m, the range from which a beam is blocked; NaN if none) over (time,
            beam); for photon counting ``dead_time_error`` (the change of ``signal`` with one
            standard error of the dead time), for analog ``baseline_error`` (the same of the
            baseline) over (time, beam, altitude); ``response`` (the mean of
            the square of range over overlap, m2) over (beam, altitude); and ``shots`` over time.
            ``time`` is the middle of ``time_bnds``, which span the profiles of a cycle.
        """
        order = self._order
        cycles = {
            name: (_DIMENSIONS[name], np.concatenate([piece[name] for piece in self._pieces]))
            for name in self._pieces[0]
        }
        self._end_beams({name: values for name, (_, values) in cycles.items()}, obstructions or {})
        bounds = _cycle_bounds(self._bounds, order)
        coordinates = {
            "time": bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2,
            "time_bnds": (("time", "nv"), bounds),
            "beam": np.arange(order.zenith_angle.size, dtype=np.int32),
            "beam_zenith_angle": ("beam", order.zenith_angle),
            "altitude": self._settings.altitude,
        }
        if self._sides_known:
            coordinates["beam_azimuth"] = ("beam", order.azimuth)
        total = np.bincount(order.cycle, weights=self._weights[order.profile])
        return xr.Dataset(
            {
                **cycles,
                "response": (("beam", "altitude"), self._settings.response()),
                "shots": ("time", np.rint(total).astype(np.int32)),
            },
            coords=coordinates,
        )

    def _end_beams(self, cycles: Mapping[str, Block], obstructions: Mapping[int, float]) -> None:
        """Remove the cells of beams behind obstructions, in place."""
        order = self._order
        ends = np.array([obstructions.get(int(number), np.inf) for number in order.profile])
        for row in np.flatnonzero(np.isfinite(ends)):
            visit = order.cycle[row], order.beam[row]
            cycles["obstruction"][visit] = np.fmin(cycles["obstruction"][visit], ends[row])
            behind = self._settings.slant_edges[order.beam[row], 1:] > ends[row]
            for name in _OF_CELLS & cycles.keys():
                cycles[name][visit][behind] = np.nan


@dataclass(frozen=True, slots=True)
class _Order:
    """Cycle and beam of each profile that is used, sorted by cycle, then beam."""

    profile: Integers
    """(kept,) number of the profile in the scene."""
    cycle: Integers
    """(kept,) from 0, without gaps."""
    beam: Integers
    """(kept,) from 0."""
    zenith_angle: Array
    """(beam,) degree, 0 to 90."""
    azimuth: Array
    """(beam,) degree."""


@dataclass(frozen=True, slots=True)
class _Settings:
    """Inputs that are common to all profiles of a scene."""

    distance: Array
    overlap: Array | None
    background_range: tuple[float, float]
    shapes: Array | None
    """(beam, range): signal of clean air."""
    altitude: Array
    slant_edges: Array
    """(beam, altitude + 1) m: the range at which a beam crosses the edges of the cells."""
    baseline: AnalogBaseline | None

    @property
    def in_front(self) -> slice:
        """Bins in front of the lidar: a range offset may put others behind it, without light."""
        return slice(int(np.searchsorted(self.distance, 0.0, side="right")), None)

    @property
    def covered(self) -> slice:
        """Bins needed for all cells of all beams."""
        farthest = float(np.max(self.slant_edges[:, -1]))
        first = self.in_front.start
        bins = int(np.searchsorted(self.distance, farthest)) + _BESIDE
        return slice(first, max(bins, first) + _BESIDE)

    @property
    def gain(self) -> Array:
        """Square of range over overlap of the bins that are covered, m2."""
        distance = self.distance[self.covered]
        if self.overlap is None:
            return distance**2
        overlap = self.overlap[self.covered]
        return distance**2 / np.where(overlap > 0.0, overlap, np.nan)

    def response(self) -> Array:
        """Return the change of signals per change of the background, (beam, altitude) m2."""
        distance = self.distance[self.covered]
        dark = np.zeros((1, distance.size))
        nothing = dark, dark, dark.astype(np.int32)
        return np.stack(
            [
                average_over_cells(*nothing, self.gain, distance, edges).response
                for edges in self.slant_edges
            ]
        )


def _slant_edges(zenith_angle: Array, height: Array) -> Array:
    """Return the ranges at which beams cross the edges of cells around heights, (beam, edge) m."""
    middles = 0.5 * (height[:-1] + height[1:])
    lowest = max(height[0] - 0.5 * (height[1] - height[0]), 0.0)
    highest = height[-1] + 0.5 * (height[-1] - height[-2])
    edges = np.concatenate([[lowest], middles, [highest]])
    above = np.where(edges > 0.0, edges, 1.0)
    return np.where(edges > 0.0, slant_paths.slant_path(zenith_angle, above) * edges, 0.0)


def _order(directions: scan_cycles.Directions, numbers: Integers, height: Array) -> _Order:
    usable = slant_paths.rising_beams(directions.zenith_angle, height)
    if usable.size == 0:
        raise RetrievalInputError(
            "has no direction more than 3 degrees above the horizon",
            field="zenith_angle",
            remedy="leave the multi-angle retrieval out of this scene",
        )
    rank = np.full(directions.zenith_angle.size + 1, -1, dtype=np.int64)
    rank[usable] = np.arange(usable.size)
    beam = rank[directions.index]
    kept = np.flatnonzero(beam >= 0)
    kept = kept[np.lexsort((beam[kept], numbers[kept]))]
    cycle = np.unique(numbers[kept], return_inverse=True)[1].astype(np.int64)
    return _Order(
        kept, cycle, beam[kept], directions.zenith_angle[usable], directions.azimuth[usable]
    )


def _cycle_bounds(bounds: npt.NDArray[np.datetime64], order: _Order) -> npt.NDArray[np.datetime64]:
    """Return the first start and the last end of the profiles of each cycle."""
    first = np.flatnonzero(np.diff(order.cycle, prepend=-1))
    starts = np.minimum.reduceat(bounds[order.profile, 0], first)
    stops = np.maximum.reduceat(bounds[order.profile, 1], first)
    return np.stack([starts, stops], axis=-1)


def _batches(order: _Order) -> Iterator[slice]:
    """Yield batches of whole cycles as slices of the kept profiles."""
    first = np.append(np.flatnonzero(np.diff(order.cycle, prepend=-1)), order.cycle.size)
    low = 0
    for high in range(1, first.size):
        if high == first.size - 1 or first[high + 1] - first[low] > BATCH:
            yield slice(int(first[low]), int(first[high]))
            low = high


def _batch_on_altitudes(
    profiles: tuple[Block, ...],
    systematic: tuple[tuple[Block, float] | None, Array | None],
    rows: Integers,
    shots: Array,
    cycle: Integers,
    beam: Integers,
    settings: _Settings,
) -> dict[str, Block]:
    """Return the arrays of the cycles of a batch by name.

    `systematic` holds the change of the power by the dead time with that of the background over its
    square, and that by the baseline; None where a channel has none. `rows` are those of the batch
    in the profiles, sorted by cycle and beam, as `shots`, `cycle` and `beam` are.
    """
    beams = len(settings.slant_edges)
    shape = (int(cycle[-1]) + 1, beams, settings.altitude.size)
    cycles: dict[str, Block] = {
        "signal": np.full(shape, np.nan),
        "variance": np.full(shape, np.nan),
        "quality": np.zeros((shape[0], shape[2]), dtype=np.int32),
        "left": np.full(shape[:2], np.nan),
        "obstruction": np.full(shape[:2], np.nan),
    }
    dead_time, baseline = systematic
    for name, change in (("dead_time_error", dead_time), ("baseline_error", baseline)):
        if change is not None:
            cycles[name] = np.full(shape, np.nan)
    first = np.flatnonzero(np.diff(cycle * beams + beam, prepend=-1))
    for few, visits in _few_visits(first, rows.size):
        power, variance, quality, length = (values[rows[few]] for values in profiles)
        bins = _net_bins(power, variance, quality, length, beam[few], settings)
        changes = {}
        if dead_time is not None:
            of_sky = dead_time[1] * bins.background**2
            changes["dead_time_error"] = dead_time[0][rows[few], settings.covered] - of_sky[:, None]
        if baseline is not None:
            changes["baseline_error"] = baseline[rows[few]]
        known = np.isfinite(bins.power)
        bins = bins._replace(
            changes={name: np.where(known, change, np.nan) for name, change in changes.items()}
        )
        if visits.size < bins.left.size:
            bins = _visit_means(bins, shots[few], visits - few.start)
        _fill_cells(cycles, bins, cycle[visits], beam[visits], settings)
    return cycles


def _few_visits(first: Integers, profiles: int) -> Iterator[tuple[slice, Integers]]:
    """Yield the profiles of some visits of directions, and the first profile of each."""
    ends = np.append(first[1:], profiles)
    low = 0
    while low < first.size:
        high = max(int(np.searchsorted(ends, first[low] + _FEW, side="right")), low + 1)
        yield slice(int(first[low]), int(ends[high - 1])), first[low:high]
        low = high


def _fill_cells(
    cycles: dict[str, Block], bins: _Bins, cycle: Integers, beam: Integers, settings: _Settings
) -> None:
    """Average the bins of visits over the cells of their beams, in place."""
    cycles["left"][cycle, beam] = bins.left
    cycles["obstruction"][cycle, beam] = np.where(
        np.isfinite(bins.obstruction), bins.obstruction, np.nan
    )
    distance, gain = settings.distance[settings.covered], settings.gain
    for number in np.unique(beam):
        rows = np.flatnonzero(beam == number)
        noise = bins.variance[rows], bins.quality[rows]
        cells = gain, distance, settings.slant_edges[number]
        means = average_over_cells(bins.power[rows], *noise, *cells)
        # The background is common to all bins of a beam.
        variance = means.variance + means.response**2 * bins.level_variance[rows, np.newaxis]
        visits = cycle[rows], number
        cycles["signal"][visits], cycles["variance"][visits] = at_centres(means.signal, variance)
        cycles["quality"][cycle[rows]] |= means.quality
        for name, change in bins.changes.items():
            cycles[name][visits] = average_over_cells(change[rows], *noise, *cells).signal


class _Bins(NamedTuple):
    """Bins of profiles without background."""

    power: Array
    """(profile, range); NaN where missing."""
    variance: Array
    """(profile, range): as of independent bins, for means over many."""
    quality: Flags
    """(profile, range)."""
    level_variance: Array
    """(profile,): variance of the background."""
    left: Array
    """(profile,): signal that may have been subtracted with the background."""
    obstruction: Array
    """(profile,): m, range from which the beam is blocked; inf for a free beam."""
    background: Array
    """(profile,)."""
    changes: Mapping[str, Array] = {}
    """(profile, range): of the power, with one standard error of dead time or baseline."""


def _net_bins(
    power: Block,
    variance: Block,
    quality: Block,
    length: Block,
    beam: Integers,
    settings: _Settings,
) -> _Bins:
    """Return the bins to average, without their background."""
    bits = quality & np.int32(WITHHELD | CARE)
    front, near, overlap = settings.in_front, settings.covered, settings.overlap
    if overlap is not None:
        unknown = ~(np.isfinite(overlap) & (overlap > 0))
        bits |= np.where(unknown, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
    values = np.where((bits & int(WITHHELD)) != 0, np.nan, power)
    if settings.baseline is not None:
        values -= settings.baseline.at(settings.distance)
    of_means = variance * length[:, np.newaxis]
    data = (values[:, front], settings.distance[front], of_means[:, front])
    tail = settings.background_range
    if settings.shapes is None:
        sky = estimate.from_bounded_tail(*data, None, tail)
    else:
        # Within the altitudes of the retrieval, the air is not taken as clean.
        highest = settings.slant_edges[beam, -1:]
        sky = estimate.from_far_range(
            *data, settings.shapes[beam][:, front], tail, mask=data[1] > highest
        )
    uncertain = np.where(sky.unjudged, np.int32(Quality.BACKGROUND_UNCERTAIN), np.int32(0))
    # Farther bins serve the background only.
    net = values[:, near] - sky.background[:, np.newaxis]
    bits = bits[:, near] | uncertain[:, np.newaxis]
    unexplained = ~np.isfinite(net) & ((bits & int(WITHHELD)) == 0)
    bits |= np.where(unexplained, np.int32(Quality.INPUT_MISSING), np.int32(0))
    left = np.maximum(np.nan_to_num(sky.left.most), 0.0)
    distance = settings.distance[near]
    blocked = obstruction_range(net, of_means[:, near], distance)
    net = np.where(distance >= blocked[:, np.newaxis], np.nan, net)
    return _Bins(net, of_means[:, near], bits, sky.standard_error**2, left, blocked, sky.background)


def _kept_shapes(
    kept: dict[Any, Any], molecules: MolecularProfile, arguments: tuple[float, Array, Array, float]
) -> Array:
    """Return `_shapes`, or those that were kept for the same arguments; only the last are kept."""
    wavelength, zenith_angle, distance, station_altitude = arguments
    arrays = (zenith_angle, distance, *(getattr(molecules, name) for name in _LEVELS))
    key = (wavelength, station_altitude, *(array.tobytes() for array in arrays))
    if key not in kept:
        kept.clear()
        kept[key] = _shapes(molecules, *arguments)
    shapes: Array = kept[key]
    return shapes


def _shapes(
    molecules: MolecularProfile,
    wavelength: float,
    zenith_angle: Array,
    distance: Array,
    station_altitude: float,
) -> Array:
    """Return the shape of the signal of clean air along each beam; 0 behind the lidar."""
    if not wavelength > 0:
        raise RetrievalInputError(
            f"is {wavelength}", field="wavelength", remedy="give m, or leave the molecules out"
        )
    in_front = distance > 0
    # The vertical planes of a volume have the same zenith angles.
    angles, place = np.unique(zenith_angle, return_inverse=True)
    climb = np.cos(np.radians(angles))[:, np.newaxis]
    altitude = station_altitude + climb * distance[in_front]
    shapes = np.zeros((angles.size, distance.size))
    extinction = molecules.extinction(altitude, wavelength)
    backscatter = extinction / molecular_lidar_ratio(wavelength)
    shapes[:, in_front] = known_shape.molecular_shape(backscatter, extinction, distance[in_front])
    return shapes[place]


def _visit_means(bins: _Bins, shots: Array, first: Indices) -> _Bins:
    """Average the profiles of each visit of a direction, weighted by shots."""
    group = np.zeros(shots.size, dtype=np.int64)
    group[first[1:]] = 1
    group = np.cumsum(group)
    sums = RunningMean((first.size, bins.power.shape[1]))
    sums.add(bins.power, bins.variance, groups=group, weights=shots)
    means = sums.averages()
    known = np.isfinite(bins.left)
    left = np.add.reduceat(np.where(known, bins.left, 0.0), first)
    count = np.maximum(np.add.reduceat(known.astype(np.int64), first), 1)
    level = np.add.reduceat(shots**2 * bins.level_variance, first)
    return _Bins(
        means.values,
        means.variance,
        np.bitwise_or.reduceat(bins.quality, first, axis=0),
        level / np.add.reduceat(shots, first) ** 2,
        left / count,
        np.minimum.reduceat(bins.obstruction, first),
        bins.background[first],
        {name: _mean_change(c, bins.variance, group, shots) for name, c in bins.changes.items()},
    )


def _mean_change(change: Array, variance: Array, group: Integers, shots: Array) -> Array:
    sums = RunningMean((int(group[-1]) + 1, change.shape[1]))
    sums.add(change, variance, groups=group, weights=shots)
    return sums.averages().values

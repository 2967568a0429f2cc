"""Profiles of a scan over xarray: sorted by cycle and beam, in altitude cells."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
_FEW: Final = 16
"""Profiles whose bins are prepared together, so that they stay in the cache of the processor; the
result does not depend on it."""
_BESIDE: Final = 4
"""Bins beyond the highest cell, of which its mean needs one."""


class BeamAir(NamedTuple):
    """Clean air along the beams of a scan, at the wavelength of a channel."""

    molecules: MolecularProfile
    wavelength: float
    """m."""
    kept: dict[Any, Any]
    """Keeps the signals along the beams, for other channels of the scan; only the last ones."""

    def shapes(self, zenith_angle: Array, distance: Array, station_altitude: float) -> Array:
        """Return the shape of the signal of clean air along each beam; 0 behind the lidar."""
        if not self.wavelength > 0:
            raise RetrievalInputError(
                f"is {self.wavelength}", field="wavelength", remedy="give m, or leave the air out"
            )
        air = self.molecules
        levels = (air.altitude, air.pressure, air.temperature, air.water_vapour)
        arrays = [zenith_angle, distance, *(level for level in levels if level is not None)]
        key = (self.wavelength, station_altitude, *(array.tobytes() for array in arrays))
        if key not in self.kept:
            in_front = distance > 0
            # The vertical planes of a volume have the same zenith angles.
            angles, place = np.unique(zenith_angle, return_inverse=True)
            climb = np.cos(np.radians(angles))[:, np.newaxis]
            altitude = station_altitude + climb * distance[in_front]
            shapes = np.zeros((angles.size, distance.size))
            extinction = air.extinction(altitude, self.wavelength)
            backscatter = extinction / molecular_lidar_ratio(self.wavelength)
            shapes[:, in_front] = known_shape.molecular_shape(
                backscatter, extinction, distance[in_front]
            )
            self.kept.clear()
            self.kept[key] = shapes[place]
        return np.asarray(self.kept[key])


class AltitudeCycles:
    """Profiles of a scan in altitude cells, sorted by cycle and beam, from chunks of profiles.

    The variance of the background is added to that of the noise. Profiles of one cycle and
    direction are averaged, weighted by their shots; those without shots, as without light, are left
    out. Beams that do not rise by 3 degrees or have no known direction are left out, as are cycles
    without other beams.
    Only the cycles are held; chunks do not change a bit of the result.

    Parameters
    ----------
    distance : (range,) float
        m along the beam.
    scan : xr.Dataset
        Over time: ``zenith_angle`` and, where it is known, ``azimuth``, degree, as for
        `lidarops.retrieve.multiangle.scan_cycles.directions`; ``time_bnds``, start and end of each
        profile, starts rising; and ``shots``, the number of laser shots.
    altitude_grid : (altitude,) float
        m above mean sea level, ascending, above the station, at least two; uniform for the method
        "joint". The edges of cells are midway between altitudes.
    station_altitude : float
        m above mean sea level.
    background_range : (float, float)
        m along the beam: the tail, whose mean is the background.
    air : BeamAir, optional
        If given, the background is that of `estimate.from_far_range`, else that of
        `estimate.from_bounded_tail` (`lidarops.retrieve.background`).
    overlap : (range,) float, optional
        The signal is divided by it; NaN where it is not known.
    baseline : AnalogBaseline, optional
        Subtracted from the power of all profiles, whose baseline error is then that of it.

    Raises
    ------
    RetrievalInputError
        For invalid arguments, or if no beam points above the horizon.
    """

    def __init__(
        self,
        distance: Array,
        *,
        scan: xr.Dataset,
        altitude_grid: npt.ArrayLike,
        station_altitude: float,
        background_range: tuple[float, float],
        air: BeamAir | None = None,
        overlap: Array | None = None,
        baseline: AnalogBaseline | None = None,
    ) -> None:
        zenith_angle = scan["zenith_angle"].to_numpy()
        azimuth = scan["azimuth"].to_numpy() if "azimuth" in scan else None
        self._bounds = scan["time_bnds"].to_numpy()
        self._shots = scan["shots"].to_numpy().astype(np.float64)
        directions = scan_cycles.directions(zenith_angle, azimuth)
        numbers = scan_cycles.cycles(zenith_angle, azimuth, self._bounds)
        self._altitude = np.asarray(altitude_grid, dtype=np.float64)
        height = slant_paths.altitude_grid(self._altitude, station_altitude)
        if height.size < 2:
            raise RetrievalInputError(
                "holds one altitude", field="altitude_grid", remedy="give at least two, in m"
            )
        usable = slant_paths.rising_beams(directions.zenith_angle, height)
        if usable.size == 0:
            raise RetrievalInputError(
                "has no direction more than 3 degrees above the horizon",
                field="zenith_angle",
                remedy="leave the multi-angle retrieval out of this scene",
            )
        self._zenith_angle = directions.zenith_angle[usable]
        self._azimuth = None
        if azimuth is not None and np.isfinite(np.asarray(azimuth, dtype=np.float64)).any():
            self._azimuth = directions.azimuth[usable]
        self._profile, self._cycle, self._beam = _sorted_profiles(
            directions, usable, numbers, self._shots
        )
        self._slant_edges = _slant_edges(self._zenith_angle, height)
        self._tail, self._baseline = background_range, baseline
        self._set_bins(distance, overlap)
        place = self._zenith_angle, distance, station_altitude
        self._shapes = None if air is None else air.shapes(*place)
        self._batches = list(_batches(self._cycle))
        self._pieces: list[dict[str, Block]] = []

    def _set_bins(self, distance: Array, overlap: Array | None) -> None:
        """Set which bins are in front of the lidar, and which all cells of all beams need."""
        # A range offset may put bins behind the lidar, without light.
        front = int(np.searchsorted(distance, 0.0, side="right"))
        farthest = float(np.max(self._slant_edges[:, -1]))
        past = max(int(np.searchsorted(distance, farthest)) + _BESIDE, front) + _BESIDE
        self._front, self._covered = slice(front, None), slice(front, past)
        self._distance, self._overlap = distance, overlap
        self._gain = distance[self._covered] ** 2
        if overlap is not None:
            near = overlap[self._covered]
            self._gain = self._gain / np.where(near > 0.0, near, np.nan)

    def ends(self) -> Integers:
        """Return the profiles before which a chunk may end: those that begin a cycle."""
        starts = [self._profile[batch].min() for batch in self._batches[1:]]
        return np.array(starts, dtype=np.int64)

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
        profiles = [
            conditioned[name].to_numpy()
            for name in ("power", "variance", "quality", CORRELATION_LENGTH)
        ]
        changes = dead_time_change(conditioned), self._baseline_error(conditioned)
        while len(self._pieces) < len(self._batches):
            batch = self._batches[len(self._pieces)]
            members = self._profile[batch]
            if members.max() >= past:
                break
            self._pieces.append(self._on_altitudes(profiles, *changes, batch, members - first))

    def _baseline_error(self, conditioned: xr.Dataset) -> Array | None:
        """Return the error of the baseline of analog profiles, (time, range covered)."""
        error = baseline_error(conditioned)
        if error is None:
            return None
        # A stated value has no share of the light; it replaces what blocked beams show.
        given = conditioned["power"].attrs.get(BASELINE_ERROR, (0.0, 1.0))[1] == 0.0
        if self._baseline is None or given:
            return error.transpose("time", "range").to_numpy()[:, self._covered]
        measured = self._baseline.error_at(self._distance[self._covered])
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
        cycles = {
            name: np.concatenate([piece[name] for piece in self._pieces])
            for name in self._pieces[0]
        }
        self._end_beams(cycles, obstructions or {})
        # From the first start to the last end of the profiles of each cycle.
        first = np.flatnonzero(np.diff(self._cycle, prepend=-1))
        starts = np.minimum.reduceat(self._bounds[self._profile, 0], first)
        bounds = np.stack(
            [starts, np.maximum.reduceat(self._bounds[self._profile, 1], first)], axis=-1
        )
        coordinates = {
            "time": starts + (bounds[:, 1] - starts) // 2,
            "time_bnds": (("time", "nv"), bounds),
            "beam": np.arange(self._zenith_angle.size, dtype=np.int32),
            "beam_zenith_angle": ("beam", self._zenith_angle),
            "altitude": self._altitude,
        }
        if self._azimuth is not None:
            coordinates["beam_azimuth"] = ("beam", self._azimuth)
        total = np.bincount(self._cycle, weights=self._shots[self._profile])
        return xr.Dataset(
            {
                **{name: (_DIMENSIONS[name], values) for name, values in cycles.items()},
                "response": (("beam", "altitude"), self._response()),
                "shots": ("time", np.rint(total).astype(np.int32)),
            },
            coords=coordinates,
        )

    def _end_beams(self, cycles: Mapping[str, Block], obstructions: Mapping[int, float]) -> None:
        """Remove the cells of beams behind obstructions, in place."""
        ends = np.array([obstructions.get(int(number), np.inf) for number in self._profile])
        for row in np.flatnonzero(np.isfinite(ends)):
            visit = self._cycle[row], self._beam[row]
            cycles["obstruction"][visit] = np.fmin(cycles["obstruction"][visit], ends[row])
            behind = self._slant_edges[self._beam[row], 1:] > ends[row]
            for name in _OF_CELLS & cycles.keys():
                cycles[name][visit][behind] = np.nan

    def _response(self) -> Array:
        """Return the change of signals per change of the background, (beam, altitude) m2."""
        distance = self._distance[self._covered]
        dark = np.zeros((1, distance.size))
        nothing = dark, dark, dark.astype(np.int32)
        return np.stack(
            [
                average_over_cells(*nothing, self._gain, distance, edges).response
                for edges in self._slant_edges
            ]
        )

    def _on_altitudes(
        self,
        profiles: list[Block],
        dead_time: tuple[Block, float] | None,
        baseline: Array | None,
        batch: slice,
        rows: Integers,
    ) -> dict[str, Block]:
        """Return the arrays of the cycles of a batch by name.

        `dead_time` holds the change of the power by the dead time with that of the background over
        its square, `baseline` that by the baseline; None where a channel has none. `rows` are those
        of the batch in the profiles.
        """
        cycle, beam = self._cycle[batch] - self._cycle[batch.start], self._beam[batch]
        shots = self._shots[self._profile[batch]]
        beams = self._zenith_angle.size
        sizes = {"time": int(cycle[-1]) + 1, "beam": beams, "altitude": self._altitude.size}
        missing = {"dead_time_error": dead_time is None, "baseline_error": baseline is None}
        cycles: dict[str, Block] = {
            name: np.full([sizes[dim] for dim in dims], np.nan)
            for name, dims in _DIMENSIONS.items()
            if not missing.get(name)
        }
        cycles["quality"] = np.zeros_like(cycles["quality"], dtype=np.int32)
        first = np.flatnonzero(np.diff(cycle * beams + beam, prepend=-1))
        for few, visits in _few_visits(first, rows.size):
            bins = self._net_bins([values[rows[few]] for values in profiles], beam[few])
            changes = {}
            if dead_time is not None:
                of_sky = dead_time[1] * bins.background**2
                change = dead_time[0][rows[few], self._covered] - of_sky[:, np.newaxis]
                changes["dead_time_error"] = change
            if baseline is not None:
                changes["baseline_error"] = baseline[rows[few]]
            known = np.isfinite(bins.power)
            bins = bins._replace(
                changes={name: np.where(known, change, np.nan) for name, change in changes.items()}
            )
            if visits.size < bins.left.size:
                bins = _visit_means(bins, shots[few], visits - few.start)
            self._fill_cells(cycles, bins, cycle[visits], beam[visits])
        return cycles

    def _net_bins(self, profiles: list[Block], beam: Integers) -> _Bins:
        """Return the bins to average, without their background."""
        power, variance, quality, length = profiles
        bits = quality & np.int32(WITHHELD | CARE)
        front, near = self._front, self._covered
        if self._overlap is not None:
            unknown = ~(np.isfinite(self._overlap) & (self._overlap > 0))
            bits |= np.where(unknown, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
        values = np.where((bits & int(WITHHELD)) != 0, np.nan, power)
        if self._baseline is not None:
            values -= self._baseline.at(self._distance)
        of_means = variance * length[:, np.newaxis]
        data = (values[:, front], self._distance[front], of_means[:, front])
        if self._shapes is None:
            sky = estimate.from_bounded_tail(*data, None, self._tail)
        else:
            # Within the altitudes of the retrieval, the air is not taken as clean.
            highest = self._slant_edges[beam, -1:]
            shapes = self._shapes[beam][:, front]
            sky = estimate.from_far_range(*data, shapes, self._tail, mask=data[1] > highest)
        uncertain = np.where(sky.unjudged, np.int32(Quality.BACKGROUND_UNCERTAIN), np.int32(0))
        # Farther bins serve the background only.
        net = values[:, near] - sky.background[:, np.newaxis]
        bits = bits[:, near] | uncertain[:, np.newaxis]
        unexplained = ~np.isfinite(net) & ((bits & int(WITHHELD)) == 0)
        bits |= np.where(unexplained, np.int32(Quality.INPUT_MISSING), np.int32(0))
        left = np.maximum(np.nan_to_num(sky.left), 0.0)
        distance, variance = self._distance[near], of_means[:, near]
        blocked = obstruction_range(net, variance, distance)
        net = np.where(distance >= blocked[:, np.newaxis], np.nan, net)
        level_variance = sky.standard_error**2
        return _Bins(net, variance, bits, level_variance, left, blocked, sky.background)

    def _fill_cells(
        self, cycles: dict[str, Block], bins: _Bins, cycle: Integers, beam: Integers
    ) -> None:
        """Average the bins of visits over the cells of their beams, in place."""
        cycles["left"][cycle, beam] = bins.left
        cycles["obstruction"][cycle, beam] = np.where(
            np.isfinite(bins.obstruction), bins.obstruction, np.nan
        )
        for number in np.unique(beam):
            rows = np.flatnonzero(beam == number)
            noise = bins.variance[rows], bins.quality[rows]
            cells = self._gain, self._distance[self._covered], self._slant_edges[number]
            means = average_over_cells(bins.power[rows], *noise, *cells)
            # The background is common to all bins of a beam.
            variance = means.variance + means.response**2 * bins.level_variance[rows, np.newaxis]
            visits = cycle[rows], number
            cycles["signal"][visits], cycles["variance"][visits] = at_centres(
                means.signal, variance
            )
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


def _slant_edges(zenith_angle: Array, height: Array) -> Array:
    """Return the ranges at which beams cross the edges of cells around heights, (beam, edge) m."""
    middles = 0.5 * (height[:-1] + height[1:])
    lowest = max(height[0] - 0.5 * (height[1] - height[0]), 0.0)
    highest = height[-1] + 0.5 * (height[-1] - height[-2])
    edges = np.concatenate([[lowest], middles, [highest]])
    above = np.where(edges > 0.0, edges, 1.0)
    return np.where(edges > 0.0, slant_paths.slant_path(zenith_angle, above) * edges, 0.0)


def _sorted_profiles(
    directions: scan_cycles.Directions, usable: Indices, numbers: Integers, shots: Array
) -> tuple[Integers, Integers, Integers]:
    """Return number, cycle and beam of each profile that is used, sorted by cycle, then beam.

    Profiles without shots are used in cycles only that hold no others.
    """
    rank = np.full(directions.zenith_angle.size + 1, -1, dtype=np.int64)
    rank[usable] = np.arange(usable.size)
    beam = rank[directions.index]
    kept = np.flatnonzero(beam >= 0)
    lit = shots[kept] > 0.0
    kept = kept[lit | ~np.isin(numbers[kept], numbers[kept[lit]])]
    kept = kept[np.lexsort((beam[kept], numbers[kept]))]
    cycle = np.unique(numbers[kept], return_inverse=True)[1].astype(np.int64)
    return kept, cycle, beam[kept]


def _batches(cycle: Integers) -> Iterator[slice]:
    """Yield batches of whole cycles as slices of the kept profiles."""
    first = np.append(np.flatnonzero(np.diff(cycle, prepend=-1)), cycle.size)
    low = 0
    for high in range(1, first.size):
        if high == first.size - 1 or first[high + 1] - first[low] > BATCH:
            yield slice(int(first[low]), int(first[high]))
            low = high


def _few_visits(first: Integers, profiles: int) -> Iterator[tuple[slice, Integers]]:
    """Yield the profiles of some visits of directions, and the first profile of each."""
    ends = np.append(first[1:], profiles)
    low = 0
    while low < first.size:
        high = max(int(np.searchsorted(ends, first[low] + _FEW, side="right")), low + 1)
        yield slice(int(first[low]), int(ends[high - 1])), first[low:high]
        low = high


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
    changes = {}
    for name, change in bins.changes.items():
        sums = RunningMean((first.size, change.shape[1]))
        sums.add(change, bins.variance, groups=group, weights=shots)
        changes[name] = sums.averages().values
    return _Bins(
        means.values,
        means.variance,
        np.bitwise_or.reduceat(bins.quality, first, axis=0),
        level / np.maximum(np.add.reduceat(shots, first), 1.0) ** 2,
        left / count,
        np.minimum.reduceat(bins.obstruction, first),
        bins.background[first],
        changes,
    )

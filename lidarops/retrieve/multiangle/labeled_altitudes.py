"""Profiles of a scan over xarray: in order of cycle and beam, on common altitudes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import dask.array as da
import numpy as np
import numpy.typing as npt
import xarray as xr
from dask.delayed import delayed

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import (
    MolecularProfile,
    molecular_lidar_ratio,
    rayleigh_cross_section,
)
from lidarops.retrieve.background import cubic_and_tail as _background
from lidarops.retrieve.background import known_shape
from lidarops.retrieve.multiangle import scan_cycles, slant_paths
from lidarops.retrieve.multiangle._common_altitude import to_altitude
from lidarops.retrieve.signal import averaging

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]
Integers = npt.NDArray[np.int64]
_Block = npt.NDArray[Any]

WITHHELD: Final = (
    Quality.INPUT_MISSING | Quality.SATURATED | Quality.INCOMPLETE_OVERLAP | Quality.NO_GLUING
)
"""Bits of a bin that is not used."""
CARE: Final = Quality.PILE_UP | Quality.BACKGROUND_UNCERTAIN
"""Bits of a bin that all results keep to which it adds."""
_BATCH: Final = 256
"""Profiles that one task puts on altitudes, unless one cycle has more."""
_AT_ONCE: Final = 32
"""Profiles whose background is found together: their arrays stay in the cache."""
_BESIDE: Final = 4
"""Bins beside an altitude that an interpolation may need."""
_BEFORE_TAIL: Final = (0.6, 0.7)
"""Of the start of the tail: where the signal is taken that may be left in the tail."""
_SHAPE_ERROR: Final = 0.2
"""Of the signal in the tail that the shape of clean air tells: what aerosol in the far range makes
of it (haze of 12 percent of the air there, simulated)."""


@dataclass(frozen=True, slots=True)
class Background:
    """How the background of a profile is found."""

    range: tuple[float, float]
    """m along the beam: the tail, whose mean is the background."""
    molecules: MolecularProfile | None = None
    """Where given, the background is fitted together with the shape of the signal of clean air
    (`lidarops.retrieve.background.known_shape`) to the far range, and the tail serves where that fails."""
    wavelength: float = np.nan
    """m, of those molecules."""


def on_altitudes(
    conditioned: xr.Dataset,
    *,
    zenith_angle: npt.ArrayLike,
    azimuth: npt.ArrayLike | None,
    time: npt.ArrayLike,  # noqa: ARG001 - the bounds tell more
    time_bnds: npt.ArrayLike,
    shots: npt.ArrayLike,
    altitude_grid: npt.ArrayLike,
    station_altitude: float,
    background: Background,
    overlap: Array | None = None,
) -> xr.Dataset:
    """Put the profiles of a scan in order of cycle and beam, on common altitudes.

    The variance of the background is added to that of the noise. Profiles of one cycle and
    direction are averaged, weighted by their shots. Beams that do not rise, are longer than 10
    vertical paths or of unknown direction are left out, and so is a cycle that has no other.

    Parameters
    ----------
    conditioned : xr.Dataset
        ``power``, ``variance`` and ``quality`` over (time, range), from
        `lidarops.retrieve.signal.labeled.condition` or `lidarops.retrieve.signal.labeled_gluing.glue`;
        may be dask-backed, chunked in any way.
    zenith_angle, azimuth : (time,) float
        degree, as for `lidarops.retrieve.multiangle.scan_cycles.directions`; no azimuth where None.
    time : (time,) datetime64
        Rising.
    time_bnds : (time, 2) datetime64
    shots : (time,) int
    altitude_grid : (altitude,) float
        m above mean sea level, ascending, above the station; uniform for the method "joint".
    station_altitude : float
        m above mean sea level.
    background : Background
    overlap : (range,) float, optional
        By which the signal is divided; NaN where it is not known.

    Returns
    -------
    xr.Dataset
        ``signal`` (range-corrected), ``variance`` over (time, beam, altitude), NaN where missing,
        ``quality`` (the bits of all bins at an altitude) and, over (time, beam), ``left`` (the
        most signal that may have been subtracted with the background), dask-backed; ``shots``
        over time. ``time`` is the middle of ``time_bnds``, which span the profiles of a cycle.
        The same to the last bit for any chunking.

    Raises
    ------
    RetrievalInputError
        Where arguments cannot be right, or no beam leads above the horizon.
    """
    found = scan_cycles.directions(zenith_angle, azimuth)
    numbers = scan_cycles.cycles(zenith_angle, azimuth, time_bnds)
    levels = np.asarray(altitude_grid, dtype=np.float64)
    order = _order(found, numbers, slant_paths.altitude_grid(levels, station_altitude))
    distance = conditioned["range"].to_numpy().astype(np.float64)
    settings = _Settings(
        distance=distance,
        overlap=overlap,
        background=background,
        shapes=_shapes(background, order.zenith_angle, distance, station_altitude),
        zenith_angle=order.zenith_angle,
        altitude=levels,
        station_altitude=station_altitude,
    )
    counted = np.asarray(shots, dtype=np.float64)
    parts = [_part(conditioned, counted, order, batch, settings) for batch in _batches(order)]
    arrays = [da.concatenate(part) for part in zip(*parts, strict=True)]  # type: ignore[no-untyped-call]
    cube = ("time", "beam", "altitude")
    dims = (cube, cube, ("time", "altitude"), ("time", "beam"))
    names = ("signal", "variance", "quality", "left")
    bounds = _spans(np.asarray(time_bnds), order)
    placed = {
        "time": bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2,
        "time_bnds": (("time", "nv"), bounds),
        "beam": np.arange(order.zenith_angle.size, dtype=np.int32),
        "beam_zenith_angle": ("beam", order.zenith_angle),
        "altitude": levels,
    }
    if azimuth is not None and np.isfinite(np.asarray(azimuth, dtype=np.float64)).any():
        placed["beam_azimuth"] = ("beam", order.azimuth)
    total = np.bincount(order.cycle, weights=counted[order.profile])
    return xr.Dataset(
        {
            **{n: (d, a) for n, d, a in zip(names, dims, arrays, strict=True)},
            "shots": ("time", np.rint(total).astype(np.int32)),
        },
        coords=placed,
    )


@dataclass(frozen=True, slots=True)
class _Order:
    """Where each profile goes: sorted by cycle, then beam."""

    profile: Integers
    """(kept,) number of the profile in the scene."""
    cycle: Integers
    """(kept,) from 0, without gaps."""
    beam: Integers
    """(kept,)"""
    zenith_angle: Array
    """(beam,) degree, 0 to 90."""
    azimuth: Array
    """(beam,) degree."""


@dataclass(frozen=True, slots=True)
class _Settings:
    """What is common to all profiles of a scene."""

    distance: Array
    overlap: Array | None
    background: Background
    shapes: Array | None
    """(beam, range): of the signal of clean air."""
    zenith_angle: Array
    altitude: Array
    station_altitude: float

    @property
    def ahead(self) -> slice:
        """Bins before the lidar: those behind it, which an offset may give, hold no light."""
        return slice(int(np.searchsorted(self.distance, 0.0, side="right")), None)

    @property
    def reached(self) -> slice:
        """Bins that beams need up to the highest altitude, with those beside."""
        height = self.altitude[-1:] - self.station_altitude
        farthest = float(np.max(slant_paths.slant_path(self.zenith_angle, height) * height))
        first = self.ahead.start
        bins = int(np.searchsorted(self.distance, farthest)) + _BESIDE
        return slice(first, max(bins, first + _BESIDE))


@dataclass(frozen=True, slots=True)
class _Clear:
    """Profiles without background."""

    power: Array
    """(profile, range), over overlap; NaN where withheld."""
    variance: Array
    left: Array
    """(profile,): the most signal that may have been subtracted with the background."""
    uncertain: npt.NDArray[np.bool_]
    """(profile,): the far range is not that of clean air, or nothing tells what is left there."""


def _order(found: scan_cycles.Directions, numbers: Integers, height: Array) -> _Order:
    usable = slant_paths.rising(found.zenith_angle, height)
    if usable.size == 0:
        raise RetrievalInputError(
            "holds no direction that rises from the horizon by more than about 6 degree",
            field="zenith_angle",
            remedy="leave the multi-angle retrieval out of this scene",
        )
    rank = np.full(found.zenith_angle.size + 1, -1, dtype=np.int64)
    rank[usable] = np.arange(usable.size)
    beam = rank[found.index]
    kept = np.flatnonzero(beam >= 0)
    kept = kept[np.lexsort((beam[kept], numbers[kept]))]
    cycle = np.unique(numbers[kept], return_inverse=True)[1].astype(np.int64)
    return _Order(kept, cycle, beam[kept], found.zenith_angle[usable], found.azimuth[usable])


def _spans(bounds: npt.NDArray[np.datetime64], order: _Order) -> npt.NDArray[np.datetime64]:
    """Return the first start and the last end of the profiles of each cycle."""
    first = np.flatnonzero(np.diff(order.cycle, prepend=-1))
    starts = np.minimum.reduceat(bounds[order.profile, 0], first)
    stops = np.maximum.reduceat(bounds[order.profile, 1], first)
    return np.stack([starts, stops], axis=-1)


def _batches(order: _Order) -> Iterator[slice]:
    """Give runs of whole cycles, as slices of the kept profiles."""
    first = np.append(np.flatnonzero(np.diff(order.cycle, prepend=-1)), order.cycle.size)
    low = 0
    for high in range(1, first.size):
        if high == first.size - 1 or first[high + 1] - first[low] > _BATCH:
            yield slice(int(first[low]), int(first[high]))
            low = high


def _part(
    conditioned: xr.Dataset, shots: Array, order: _Order, batch: slice, settings: _Settings
) -> tuple[da.Array, ...]:
    """Return signal, variance and quality of a run of cycles, lazily."""
    members = order.profile[batch]
    start, stop = int(members.min()), int(members.max()) + 1
    found = [_blocks(conditioned[name], start, stop) for name in ("power", "variance", "quality")]
    cycle = order.cycle[batch] - order.cycle[batch.start]
    whole = delayed(_crossed, nout=4, pure=True)(
        *found, members, shots[members], cycle, order.beam[batch], settings
    )
    shape = (int(cycle[-1]) + 1, settings.zenith_angle.size, settings.altitude.size)
    return tuple(
        da.from_delayed(piece, shape=size, dtype=dtype)  # type: ignore[no-untyped-call]
        for piece, size, dtype in zip(
            whole,
            (shape, shape, (shape[0], shape[2]), shape[:2]),
            (np.float64, np.float64, np.int32, np.float64),
            strict=True,
        )
    )


def _blocks(array: xr.DataArray, start: int, stop: int) -> tuple[int, list[Any]]:
    """Return the blocks that hold some profiles, and the number of the first profile in them."""
    data = array.data
    if not isinstance(data, da.Array):
        return start, [data[start:stop]]
    ends = np.cumsum(data.chunks[0])
    first, last = np.searchsorted(ends, (start, stop - 1), side="right")
    # Optimised one by one, each array of each batch would read the files for itself.
    blocks = data.rechunk({1: -1}).to_delayed(optimize_graph=False)  # type: ignore[no-untyped-call]
    return int(ends[first] - data.chunks[0][first]), list(blocks[first : last + 1, 0])


def _rows(found: tuple[int, list[_Block]], members: Integers) -> _Block:
    """Return some profiles of blocks."""
    first, blocks = found
    stops = first + np.cumsum([len(block) for block in blocks])
    place = np.searchsorted(stops, members, side="right")
    out = np.empty((members.size, *blocks[0].shape[1:]), blocks[0].dtype)
    for number in np.unique(place):
        here, block = place == number, blocks[number]
        out[here] = block[members[here] - (stops[number] - len(block))]
    return out


def _crossed(
    power: tuple[int, list[_Block]],
    variance: tuple[int, list[_Block]],
    quality: tuple[int, list[_Block]],
    members: Integers,
    shots: Array,
    cycle: Integers,
    beam: Integers,
    settings: _Settings,
) -> tuple[Array, Array, Flags, Array]:
    """Return signal and variance as (cycle, beam, altitude), quality as (cycle, altitude).

    And as (cycle, beam) the most signal that may have been taken for background.
    """
    pieces = [
        _cleared(_rows(power, some), _rows(variance, some), _rows(quality, some), turn, settings)
        for first in range(0, members.size, _AT_ONCE)
        for some, turn in [(members[first : first + _AT_ONCE], beam[first : first + _AT_ONCE])]
    ]
    values, noise, bits, left = (np.concatenate(part) for part in zip(*pieces, strict=True))
    distance = settings.distance[settings.reached]
    silent = ~np.isfinite(values) & ((bits & int(WITHHELD)) == 0)
    bits |= np.where(silent, np.int32(Quality.INPUT_MISSING), np.int32(0))
    cell = cycle * settings.zenith_angle.size + beam
    first = np.flatnonzero(np.diff(cell, prepend=-1))
    if first.size < cell.size:
        values, noise, bits, left = _visited(values, noise, bits, left, shots, first)
    values, noise = values * distance**2, noise * distance**4
    shape = (int(cycle[-1]) + 1, settings.zenith_angle.size, settings.altitude.size)
    signal, spread = np.full(shape, np.nan), np.full(shape, np.nan)
    told = np.zeros((shape[0], shape[2]), dtype=np.int32)
    remains = np.full(shape[:2], np.nan)
    remains[cycle[first], beam[first]] = left
    turn, cycle = beam[first], cycle[first]
    for number in np.unique(turn):
        at = turn == number
        angle = settings.zenith_angle[number : number + 1]
        one = to_altitude(
            values[at, np.newaxis],
            distance,
            angle,
            settings.altitude,
            variance=noise[at, np.newaxis],
            station_altitude=settings.station_altitude,
        )
        signal[cycle[at], number], spread[cycle[at], number] = one.signal[:, 0], one.variance[:, 0]
        told[cycle[at]] |= _bits_on(bits[at], distance, angle, settings)
    return signal, spread, told, remains


def _cleared(
    power: _Block, variance: _Block, quality: _Block, beam: Integers, settings: _Settings
) -> tuple[Array, Array, Flags, Array]:
    """Return signal, variance and bits of the bins that are reached, and what may be left."""
    bits = quality & np.int32(WITHHELD | CARE)
    if settings.overlap is not None:
        unknown = ~(np.isfinite(settings.overlap) & (settings.overlap > 0))
        bits |= np.where(unknown, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
    clear = _without_background(power, variance, bits, beam, settings)
    bits |= np.where(clear.uncertain, np.int32(Quality.BACKGROUND_UNCERTAIN), np.int32(0))[
        :, np.newaxis
    ]
    # Farther bins told the background, and are not interpolated in.
    reached = settings.reached
    return clear.power[:, reached], clear.variance[:, reached], bits[:, reached], clear.left


def _without_background(
    power: _Block, variance: _Block, bits: Flags, beam: Integers, settings: _Settings
) -> _Clear:
    values = np.where((bits & int(WITHHELD)) != 0, np.nan, power)
    distance = settings.distance
    start, stop = settings.background.range
    tail = (distance >= start) & (distance <= stop)
    if not tail.any():
        raise RetrievalInputError(
            f"holds no bin from {start:g} to {stop:g} m",
            field="background",
            remedy=f"ranges end at {distance[-1]:g} m",
        )
    sky = _background.tail_mean(
        values[:, tail], distance[tail], start=start, variance=variance[:, tail]
    )
    background, error = sky.background, sky.background_standard_error
    left = _left_in_tail(values - background[:, np.newaxis], distance, start, tail)
    uncertain = np.isfinite(background) & ~np.isfinite(left)
    if settings.shapes is not None:
        ahead = settings.ahead
        shapes = settings.shapes[beam]
        fit = known_shape.fit_known_shape(
            values[:, ahead], distance[ahead], shapes[:, ahead], variance=variance[:, ahead]
        )
        usable = ~fit.singular & np.isfinite(fit.background)
        background = np.where(usable, fit.background, background)
        error = np.where(usable, fit.background_standard_error, error)
        left = np.where(usable, _SHAPE_ERROR * np.abs(sky.background - background), left)
        uncertain = np.where(usable, fit.poor_fit, uncertain)
    values = values - background[:, np.newaxis]
    noise = variance + error[:, np.newaxis] ** 2
    if settings.overlap is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            values, noise = values / settings.overlap, noise / settings.overlap**2
    return _Clear(values, noise, left, uncertain)


def _left_in_tail(net: Array, distance: Array, start: float, tail: npt.NDArray[np.bool_]) -> Array:
    """Return the most signal that the tail may hold: as if no air were clearer than before it.

    Nearer than the tail the signal is S - L, with L what of it is left in the tail and was
    subtracted; S falls with the square of range at least.
    """
    low, high = (share * start for share in _BEFORE_TAIL)
    before = (distance >= low) & (distance < high)
    if not before.any():
        return np.full(len(net), np.nan)
    fall = np.mean(distance[tail] ** -2.0) / np.mean(distance[before] ** -2.0)
    known = np.isfinite(net[:, before])
    count = known.sum(axis=1)
    with np.errstate(invalid="ignore"):
        mean = np.where(known, net[:, before], 0.0).sum(axis=1) / count
    return np.asarray(mean * fall / (1.0 - fall))


def _shapes(
    background: Background, zenith_angle: Array, distance: Array, station_altitude: float
) -> Array | None:
    """Return the shape of the signal of clean air along each beam; 0 behind the lidar."""
    if background.molecules is None:
        return None
    if not background.wavelength > 0:
        raise RetrievalInputError(
            f"has the wavelength {background.wavelength}",
            field="background",
            remedy="give the wavelength in m, or leave the molecules out",
        )
    ahead = distance > 0
    climb = np.cos(np.radians(zenith_angle))[:, np.newaxis]
    extinction = background.molecules.number_density(
        station_altitude + climb * distance[ahead]
    ) * rayleigh_cross_section(background.wavelength)
    shapes = np.zeros((zenith_angle.size, distance.size))
    shapes[:, ahead] = known_shape.molecular_shape(
        extinction / molecular_lidar_ratio(background.wavelength), extinction, distance[ahead]
    )
    return shapes


def _visited(
    values: Array,
    noise: Array,
    bits: Flags,
    left: Array,
    shots: Array,
    first: npt.NDArray[np.intp],
) -> tuple[Array, Array, Flags, Array]:
    """Average the profiles of each visit of a direction."""
    group = np.zeros(shots.size, dtype=np.int64)
    group[first[1:]] = 1
    group = np.cumsum(group)
    means = averaging.time_mean(values, noise, groups=group, weights=shots, axis=0)
    known = np.isfinite(left)
    total = np.add.reduceat(np.where(known, left, 0.0), first)
    bits = np.bitwise_or.reduceat(bits, first, axis=0)
    count = np.maximum(np.add.reduceat(known.astype(np.int64), first), 1)
    return means.values, means.variance, bits, total / count


def _bits_on(bits: Flags, distance: Array, angle: Array, settings: _Settings) -> Flags:
    """Return the bits of the bins beside each altitude."""
    height = settings.altitude - settings.station_altitude
    wanted = slant_paths.slant_path(angle, height)[0] * height
    beside = np.clip(np.searchsorted(distance, wanted, side="right") - 1, 0, distance.size - 2)
    found = bits[:, beside] | bits[:, beside + 1]
    outside = (wanted < distance[0]) | (wanted > distance[-1])
    return np.where(outside, np.int32(Quality.INPUT_MISSING), found)

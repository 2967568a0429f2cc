"""Networks of lidars over xarray: averaged signals of beams in, the ``visibility`` product out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.air import labeled
from lidarops.retrieve.air.labeled import Definition
from lidarops.retrieve.background import cubic_and_tail as _background
from lidarops.retrieve.network import extinction_field
from lidarops.retrieve.network.extinction_field import MultiPositionResult
from lidarops.retrieve.network.geometry import Network

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]
Integers = npt.NDArray[np.int64]

_WITHHELD: Final = Quality.INPUT_MISSING | Quality.SATURATED | Quality.NO_GLUING
"""Bits of a bin that is not used. Those before full overlap are not asked for."""
_CARE: Final = Quality.PILE_UP | Quality.BACKGROUND_UNCERTAIN
"""Bits of bins that a result keeps to which they add."""
_QUALITY_OF_FLAG: Final = {
    "ill_conditioned": Quality.POORLY_DETERMINED,
    "far_start": Quality.EXTRAPOLATED,
    "not_positive": Quality.NO_REAL_SOLUTION,
    "uncertain": Quality.POORLY_DETERMINED,
    "signal_not_positive": Quality.LOW_SIGNAL,
    "signal_missing": Quality.INPUT_MISSING,
    "weak_signal": Quality.LOW_LEVERAGE,
    "bridged": Quality.OUTLIER,
    "outlying": Quality.POOR_FIT,
    "pole": Quality.UNSTABLE_INVERSION,
    "unsettled": Quality.POOR_FIT,
    "poor_fit": Quality.POOR_FIT,
    "not_homogeneous": Quality.NOT_HOMOGENEOUS,
    "not_measured": Quality.INPUT_MISSING,
}
"""Of `CrossingFlags`; `not_finite` is told where nothing else rejects the value."""
BEFORE_TAIL: Final = (0.6, 0.7)
"""Of the start of the tail: where the signal is taken that may be left in the tail."""
_SEEN: Final = 3.0
"""Standard errors by which bins before the tail are then brighter than it."""
_PROBE: Final = 1e-2
"""Relative change of signals, by which sensitivities are found."""
BEYOND: Final = 200
"""Bins kept beyond the farthest crossing of a beam: more than twice the widest window of a bin."""
_MOST_APART: Final = 16
"""Beams whose errors are looked at one by one; of more, those of an instrument together."""
_SHARE_OF_ERROR: Final = 0.5
"""Of the standard error: the most that signal left in the background may move an extinction
without a flag."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamAverages:
    """The averaged signals of one beam."""

    averages: xr.Dataset
    """``power``, ``variance`` and ``quality`` over (time, range), ``shots`` and ``time_bnds``, in
    memory; from `lidarops.retrieve.signal.labeled_averaging.clock_average`."""
    interval: Integers
    """(time,) number of the interval of the clock of each average."""
    instrument: str
    station: tuple[float, float, float]
    """Latitude and longitude (degree), altitude (m)."""
    background_range: tuple[float, float]
    """m: the tail, whose mean is the background."""
    nearest: float
    """m, range of full overlap."""
    overlap: Array | None
    """(range,) overlap function, where it is known."""
    exponent: float
    """m of backscatter ~ extinction^(1/m)."""
    zenith_angle: float
    """degree."""
    azimuth: float
    """degree."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """How a network is solved, and what its systematic errors are made of."""

    block_intervals: int
    """Intervals of the clock that share a mean field."""
    visibility: Definition
    method: str = "network"
    prior: str = "block"
    exponent_relative_error: float = 0.1
    """Of m."""
    lidar_ratio_relative_error: float = 0.02
    """Of a crossing against the others: of the constant between backscatter^m and extinction."""
    overlap_relative_error: float = 0.003
    """At the nearest point of a beam that is used; falls to 0 at the farthest."""


@dataclass(frozen=True, slots=True, eq=False)
class _Signals:
    """The signals of all beams on common intervals."""

    power: Array
    """(interval, beam, bin), free of background; NaN where missing."""
    variance: Array
    range: Array
    """(beam, bin) m; NaN beyond the bins of a beam."""
    background_error: Array
    """(interval, beam)."""
    left: Array
    """(interval, beam): the most signal that may have been subtracted with the background."""
    care: Flags
    """(interval, beam) bits of the bins between the crossings of the beam."""
    overlap: Array
    """(beam, bin)."""


def retrieve_network(
    beams: Sequence[BeamAverages], network: Network, settings: NetworkSettings
) -> xr.Dataset:
    """Retrieve extinction and visibility where the beams of several lidars meet.

    Signals are averages; the background is subtracted and the network solved
    (`lidarops.retrieve.network.extinction_field`). Errors that all bins of a beam share (that of the
    background, of the overlap, of the signal left in the tail, of the exponent) are found by
    solving again with the signals changed by them.

    Parameters
    ----------
    beams : sequence of BeamSignals
    network : Network
        With as many beams.
    settings : Settings

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``visibility`` product, of the near crossings. Where a
        value is NaN, a bit of ``quality_flag`` says why.

    Raises
    ------
    RetrievalInputError
        Where arguments cannot be right.
    """
    if len(beams) != network.beams:
        raise RetrievalInputError(f"are {len(beams)} for {network.beams} beams", field="beams")
    intervals = np.unique(np.concatenate([beam.interval for beam in beams]))
    signals = _gathered(beams, intervals, network)
    solver = _Solver(beams, network, settings, signals, intervals)
    found = solver.solve(signals.power)
    errors = _Errors.of(solver, found, settings)
    near = np.flatnonzero(network.near_crossing)
    extinction = found.extinction[:, near]
    random, systematic = errors.random[:, near], errors.systematic[:, near]
    pair = ("time", "crossing")
    seen = labeled.visibility_of_extinction(
        xr.DataArray(extinction, dims=pair),
        xr.DataArray(random, dims=pair),
        xr.DataArray(systematic, dims=pair),
        settings.visibility,
    )
    flags = _judged(found, errors, signals, network)[:, near]
    return xr.Dataset(
        {
            **seen.data_vars,
            "extinction": (pair, extinction),
            "extinction_standard_error": (pair, random),
            "extinction_systematic_error": (pair, systematic),
            "condition": (pair, errors.condition[:, near]),
            "quality_flag": (pair, flags),
            "optical_depth": ("time", _depth(extinction, network)),
            "reduced_chi2": ("time", found.reduced_chi_square),
            "degrees_of_freedom": (
                "time",
                np.where(found.degrees_of_freedom >= 0, found.degrees_of_freedom, np.nan),
            ),
            "prior_deviation": (
                "time",
                np.where(np.isfinite(found.prior_deviation), found.prior_deviation, np.nan),
            ),
            "shots": ("time", _shots(beams, intervals)),
            "beam_range": (("beam", "crossing"), _distances(network)[:, near]),
        },
        coords=_places(beams, intervals, network, near),
        attrs={"steps": _told(beams, network, found, settings)},
    )


def _gathered(beams: Sequence[BeamAverages], intervals: Integers, network: Network) -> _Signals:
    bins = max(beam.averages.sizes["range"] for beam in beams)
    shape = (intervals.size, len(beams), bins)
    power, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    grid, overlap = np.full(shape[1:], np.nan), np.ones(shape[1:])
    error, left = np.full(shape[:2], np.nan), np.zeros(shape[:2])
    care = np.zeros(shape[:2], dtype=np.int32)
    for index, beam in enumerate(beams):
        rows = np.searchsorted(intervals, beam.interval)
        data, distance = beam.averages, beam.averages["range"].to_numpy().astype(np.float64)
        bits = data["quality"].to_numpy()
        values = np.where((bits & int(_WITHHELD)) != 0, np.nan, data["power"].to_numpy())
        noise = data["variance"].to_numpy()
        start, stop = beam.background_range
        tail = (distance >= start) & (distance <= stop)
        sky = _background.tail_mean(
            values[:, tail], distance[tail], start=start, variance=noise[:, tail]
        )
        mine = slice(distance.size)
        power[rows, index, mine] = values - sky.background[:, np.newaxis]
        variance[rows, index, mine] = noise
        grid[index, mine] = distance
        if beam.overlap is not None:
            # Before the first range that is told, no bin is used.
            overlap[index, mine] = np.nan_to_num(beam.overlap)
        error[rows, index] = sky.background_standard_error
        left[rows, index] = _left_in_tail(power[rows, index, mine], noise, distance, tail)
        ranges = network.on_beam(index)[1]
        used = (distance >= ranges[0]) & (distance <= ranges[-1])
        care[rows, index] = np.bitwise_or.reduce(bits[:, used] & np.int32(_CARE), axis=1)
    # The solver looks at no farther bins, and is asked many times.
    near = slice(_bins_used(grid, network))
    return _Signals(
        np.ascontiguousarray(power[..., near]),
        np.ascontiguousarray(variance[..., near]),
        grid[:, near],
        error,
        left,
        care,
        overlap[:, near],
    )


def _bins_used(grid: Array, network: Network) -> int:
    """Return how many of the bins of the beams reach beyond their farthest crossings."""
    reached = [int(np.sum(row <= network.on_beam(index)[1][-1])) for index, row in enumerate(grid)]
    return max(reached) + BEYOND


def _left_in_tail(net: Array, noise: Array, distance: Array, tail: npt.NDArray[np.bool_]) -> Array:
    """Return the most signal that the tail may hold, 0 where none is seen before it.

    Before the tail the signal is S - L, with L what of it was in the tail and was subtracted; S
    falls with the square of range at least.
    """
    start = distance[tail][0] if tail.any() else 0.0
    low, high = (share * start for share in BEFORE_TAIL)
    before = (distance >= low) & (distance < high)
    if not before.any():
        return np.zeros(len(net))
    fall = np.mean(distance[tail] ** -2.0) / np.mean(distance[before] ** -2.0)
    known = np.isfinite(net) & np.isfinite(noise)
    spread, number = np.where(known, noise, 0.0), known.astype(np.int64)
    mean = np.where(known, net, 0.0)[:, before].sum(axis=1)
    variance = sum(
        spread[:, part].sum(axis=1) / np.maximum(number[:, part].sum(axis=1), 1) ** 2
        for part in (before, tail)
    )
    mean = mean / np.maximum(number[:, before].sum(axis=1), 1)
    seen = mean > _SEEN * np.sqrt(variance)
    return np.asarray(np.where(seen, mean * fall / (1.0 - fall), 0.0))


class _Solver:
    """Solves the network for signals that are changed a little."""

    def __init__(
        self,
        beams: Sequence[BeamAverages],
        network: Network,
        settings: NetworkSettings,
        signals: _Signals,
        intervals: Integers,
    ) -> None:
        self.network, self.signals = network, signals
        self.exponent = np.array([beam.exponent for beam in beams])
        names = [beam.instrument for beam in beams]
        together = list(dict.fromkeys(names))
        self.groups = (
            [[index] for index in range(len(beams))]
            if len(beams) <= _MOST_APART
            else [[r for r, name in enumerate(names) if name == one] for one in together]
        )
        """Beams whose errors are looked at together."""
        self._told: dict[str, Any] = {
            "method": settings.method,
            "prior": settings.prior,
            "variance": signals.variance,
            "overlap": signals.overlap,
            "full_overlap_range": np.array([beam.nearest for beam in beams]),
            "blocks": intervals // settings.block_intervals,
        }

    def solve(self, power: Array, exponent: Array | None = None) -> MultiPositionResult:
        """Solve for signals, and exponents where these are not the told ones."""
        return extinction_field.retrieve_network(
            power,
            self.signals.range,
            self.network,
            exponent=self.exponent if exponent is None else exponent,
            **self._told,
        )

    def slopes(self) -> Array:
        """Return (beam, bin) what falls from 1 at the nearest crossing of a beam to 0 at its last."""
        out = np.zeros(self.signals.range.shape)
        for index in range(self.network.beams):
            ranges = self.network.on_beam(index)[1]
            out[index] = np.interp(self.signals.range[index], [ranges[0], ranges[-1]], [1.0, 0.0])
        return out

    def hats(self) -> Iterator[Array]:
        """Yield, for each crossing, (beam, bin) what falls from 1 there to 0 at its neighbours."""
        for crossing in range(self.network.crossings):
            out = np.zeros(self.signals.range.shape)
            for index in range(self.network.beams):
                numbers, ranges = self.network.on_beam(index)
                if crossing in numbers:
                    peak = (numbers == crossing).astype(np.float64)
                    out[index] = np.interp(self.signals.range[index], ranges, peak)
            yield out

    def changes(self, found: MultiPositionResult, change: Array) -> Iterator[Array]:
        """Yield, for each group of beams, by how much extinction moves with the signals."""
        for group in self.groups:
            if not change[:, group].any():
                # The same signals give the same values.
                yield found.extinction - found.extinction
                continue
            power = self.signals.power.copy()
            power[:, group] += change[:, group]
            yield self.solve(power).extinction - found.extinction


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """(interval, crossing) errors of extinction, m-1; NaN where there is no value."""

    random: Array
    systematic: Array
    left: Array
    """What of the systematic error is by signal left in the background."""
    condition: Array
    """Relative change of extinction over that of the signals at the near ends of beams."""

    @staticmethod
    def of(solver: _Solver, found: MultiPositionResult, settings: NetworkSettings) -> _Errors:
        signals = solver.signals
        sky = np.nan_to_num(signals.background_error)[..., np.newaxis]
        random = _rooted(
            [
                found.extinction_standard_error,
                *solver.changes(found, np.broadcast_to(sky, signals.power.shape)),
            ]
        )
        probed = _rooted(list(solver.changes(found, _PROBE * signals.power * solver.slopes())))
        with np.errstate(invalid="ignore", divide="ignore"):
            condition = probed / _PROBE / found.extinction
        remains = np.broadcast_to(signals.left[..., np.newaxis], signals.power.shape)
        left = _rooted(list(solver.changes(found, remains)))
        told = solver.exponent * (1.0 + settings.exponent_relative_error)
        bent = solver.solve(signals.power, np.minimum(told, 10.0)).extinction - found.extinction
        mixed = _mixed(solver, found, settings.lidar_ratio_relative_error)
        parts = [bent, mixed, left, condition * found.extinction * settings.overlap_relative_error]
        return _Errors(random, _rooted(parts), left, condition)


def _mixed(solver: _Solver, found: MultiPositionResult, relative_error: float) -> Array:
    """Return what lidar ratios that differ from crossing to crossing do, m-1."""
    total = np.zeros(found.extinction.shape)
    if relative_error > 0.0:
        for hat in solver.hats():
            power = solver.signals.power * (1.0 + _PROBE * hat)
            total += (solver.solve(power).extinction - found.extinction) ** 2
    return np.asarray(np.sqrt(total) * relative_error / _PROBE)


def _rooted(parts: Sequence[Array]) -> Array:
    """Return the root of the sum of squares; a part that has no value makes the whole missing."""
    total = np.zeros(parts[0].shape)
    for part in parts:
        total += part**2
    return np.sqrt(total)


def _judged(
    found: MultiPositionResult, errors: _Errors, signals: _Signals, network: Network
) -> Flags:
    """Return what speaks against each value, and a reason for each that is missing."""
    bits = np.zeros(found.extinction.shape, dtype=np.int32)
    for name, bit in _QUALITY_OF_FLAG.items():
        bits |= np.where(getattr(found.flags, name), np.int32(bit), np.int32(0))
    for index, crossing in zip(network.passages.beam, network.passages.crossing, strict=True):
        bits[:, crossing] |= signals.care[:, index]
    with np.errstate(invalid="ignore"):
        moved = errors.left > _SHARE_OF_ERROR * errors.random
        loose = ~(np.hypot(errors.random, errors.systematic) < found.extinction)
    bits |= np.where(moved, np.int32(Quality.BACKGROUND_UNCERTAIN), np.int32(0))
    bits |= np.where(
        loose & np.isfinite(found.extinction), np.int32(Quality.POORLY_DETERMINED), np.int32(0)
    )
    with np.errstate(invalid="ignore"):
        bits[found.degrees_of_freedom < 0] |= np.int32(Quality.PRIOR_DOMINATED)
    lost = ~np.isfinite(found.extinction) & ((bits & np.int32(Quality.rejecting())) == 0)
    why = np.where(
        found.flags.weak_signal, np.int32(Quality.LOW_SIGNAL), np.int32(Quality.NO_REAL_SOLUTION)
    )
    return bits | np.where(lost, why, np.int32(0))


def _depth(extinction: Array, network: Network) -> Array:
    """Return the optical depth of the longest stretch between crossings of a beam."""
    spans = [ranges[-1] - ranges[0] for _, ranges in map(network.on_beam, range(network.beams))]
    known = np.isfinite(extinction)
    with np.errstate(invalid="ignore"):
        mean = np.where(known, extinction, 0.0).sum(axis=1) / known.sum(axis=1)
    return np.asarray(mean * max(spans))


def _distances(network: Network) -> Array:
    """Return (beam, crossing) ranges, NaN where a crossing does not lie on a beam."""
    out = np.full((network.beams, network.crossings), np.nan)
    out[network.passages.beam, network.passages.crossing] = network.passages.range
    return out


def _shots(beams: Sequence[BeamAverages], intervals: Integers) -> npt.NDArray[np.int32]:
    total = np.zeros(intervals.size, dtype=np.int64)
    for beam in beams:
        total[np.searchsorted(intervals, beam.interval)] += beam.averages["shots"].to_numpy()
    return np.minimum(total, np.iinfo(np.int32).max).astype(np.int32)


def _places(
    beams: Sequence[BeamAverages],
    intervals: Integers,
    network: Network,
    near: npt.NDArray[np.intp],
) -> dict[str, Any]:
    if network.geodetic is None:
        raise RetrievalInputError(
            "has no positions", field="network", remedy="make it by geometry.network"
        )
    never = np.iinfo(np.int64)
    start, stop = np.full(intervals.size, never.max), np.full(intervals.size, never.min)
    for beam in beams:
        rows = np.searchsorted(intervals, beam.interval)
        bounds = beam.averages["time_bnds"].to_numpy().astype("datetime64[ns]").astype(np.int64)
        start[rows] = np.minimum(start[rows], bounds[:, 0])
        stop[rows] = np.maximum(stop[rows], bounds[:, 1])
    times = np.stack([start, stop], axis=-1).astype("datetime64[ns]")
    return {
        "time": times[:, 0] + (times[:, 1] - times[:, 0]) // 2,
        "time_bnds": (("time", "nv"), times),
        "crossing_id": ("crossing", near.astype(np.int32)),
        "latitude": ("crossing", network.geodetic[near, 0]),
        "longitude": ("crossing", network.geodetic[near, 1]),
        "altitude": ("crossing", network.geodetic[near, 2]),
        "beam": np.arange(network.beams, dtype=np.int32),
        **{
            f"beam_{name}": ("beam", np.array([beam.station[n] for beam in beams]))
            for n, name in enumerate(("latitude", "longitude", "altitude"))
        },
        "beam_zenith_angle": ("beam", np.array([beam.zenith_angle for beam in beams])),
        "beam_azimuth": ("beam", np.array([beam.azimuth for beam in beams])),
    }


def _told(
    beams: Sequence[BeamAverages],
    network: Network,
    found: MultiPositionResult,
    settings: NetworkSettings,
) -> str:
    """Return in words which beam is whose, where it meets others, and what visibility is."""
    texts = [f"method {found.method.value}", settings.visibility.words]
    for index, beam in enumerate(beams):
        numbers, ranges = network.on_beam(index)
        met = ", ".join(f"{v} at {r:.0f} m" for v, r in zip(numbers, ranges, strict=True))
        texts.append(
            f"beam {index}: {beam.instrument}, zenith angle {beam.zenith_angle:g}, azimuth"
            f" {beam.azimuth:g} degree, with the crossings {met}"
        )
    return "; ".join(texts)

"""Networks of lidars on xarray data: from averaged signals of beams to the visibility product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.air.visibility import VisibilityDefinition, visibility_of_extinction
from lidarops.retrieve.background.estimate import detected, from_tail, shifts
from lidarops.retrieve.common.arrays import Array, Flags, Indices, Integers, root_sum_square
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network import extinction_field
from lidarops.retrieve.network._beam_signals import SignalChange
from lidarops.retrieve.network.extinction_field import NetworkResult
from lidarops.retrieve.network.flags import REJECTING, NetworkQuality
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.settings import NetworkAssumptions
from lidarops.retrieve.network.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH, baseline_error

_UNUSABLE: Final = Quality.INPUT_MISSING | Quality.SATURATED | Quality.NO_SIGNAL | Quality.NO_GLUING
"""Bits of a bin that is not used. Bins before full overlap are excluded by range."""
_WARNINGS: Final = Quality.PILE_UP | Quality.SINGLE_RECORD | Quality.BACKGROUND_UNCERTAIN
"""Bits of bins that are passed on to the values they contribute to."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamAverages:
    """The averaged signals of one beam."""

    averages: xr.Dataset
    """``power``, ``variance`` and ``quality`` over (time, range), ``shots`` and ``time_bnds``, in
    memory; from `lidarops.retrieve.signal.labeled_averaging.ClockAverage`."""
    interval: Integers
    """(time,) number of the clock interval of each average."""
    instrument: str
    station: tuple[float, float, float]
    """Latitude and longitude (degree), altitude (m)."""
    background_range: tuple[float, float]
    """m, start and end of the tail, whose mean is the background."""
    nearest: float
    """m, range of full overlap."""
    overlap: Array | None
    """(range,) overlap function, if known."""
    exponent: float
    """m of backscatter ~ extinction^(1/m)."""
    zenith_angle: float
    """degree."""
    azimuth: float
    """degree."""


@dataclass(frozen=True, slots=True, eq=False)
class _Signals:
    """Signals of all beams on common intervals."""

    power: Array
    """(interval, beam, bin) background-subtracted; NaN where missing."""
    variance: Array
    range: Array
    """(beam, bin) m; NaN beyond the bins of a beam."""
    background_error: Array
    """(interval, beam) standard error of the background."""
    tail_signal: Array
    """(interval, beam) largest signal that may have been subtracted with the background."""
    warnings: Flags
    """(interval, beam) warning bits of the bins between the crossings, and of the background."""
    overlap: Array
    """(beam, bin)."""
    baseline: Array
    """(interval, beam, bin) standard error of the analog baseline."""


def retrieve_network(
    beams: Sequence[BeamAverages],
    network: Network,
    settings: NetworkAssumptions,
    *,
    block_intervals: int,
    visibility: VisibilityDefinition,
) -> xr.Dataset:
    """Retrieve extinction and visibility where the beams of several lidars meet.

    The background is subtracted from the averaged signals, and the network is solved
    (`lidarops.retrieve.network.extinction_field`). Errors that all bins of a beam share (from
    background, overlap, signal in the tail, exponent) are carried by the linear response of the
    solution.

    Parameters
    ----------
    beams : sequence of BeamAverages
    network : Network
        With the same beams.
    settings : NetworkAssumptions
    block_intervals : int
        Number of clock intervals that are one field.
    visibility : VisibilityDefinition

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``visibility`` product at the near crossings. Where a
        value is NaN, a bit of ``quality_flag`` gives the reason.

    Raises
    ------
    RetrievalInputError
        If arguments are invalid.
    """
    if len(beams) != network.beams:
        raise RetrievalInputError(f"are {len(beams)} for {network.beams} beams", field="beams")
    given = np.unique(np.concatenate([beam.interval for beam in beams]))
    intervals = _without_gaps(given, block_intervals)
    signals = _gather_signals(beams, intervals, network)
    result = extinction_field.retrieve_network(
        signals.power, signals.range, network, variance=signals.variance,
        overlap=signals.overlap, full_overlap_range=[beam.nearest for beam in beams],
        exponent=[beam.exponent for beam in beams], prior=settings.prior,
        blocks=intervals // block_intervals, multiplier=settings.multiplier,
    )  # fmt: skip
    errors = _errors(result, signals, network, settings)
    near = np.flatnonzero(network.near_crossing)
    extinction, random, systematic = (
        values[:, near] for values in (result.extinction, *errors[:2])
    )
    freedom = result.degrees_of_freedom
    dimensions = ("time", "crossing")
    seen = visibility_of_extinction(extinction, random, systematic, visibility)
    flags = _quality_flags(result, errors, signals, network)[:, near]
    multiplier = {"multiplier": (dimensions, result.multiplier[:, near])}
    if settings.multiplier is None:
        multiplier = {}
    product = xr.Dataset(
        {
            **{name: (dimensions, values) for name, values in seen.items()},
            "total_extinction": (dimensions, extinction),
            "total_extinction_standard_error": (dimensions, random),
            "total_extinction_systematic_error": (dimensions, systematic),
            "condition": (dimensions, result.overlap_response[:, near]),
            "quality_flag": (dimensions, flags),
            "path_optical_depth": ("time", _optical_depth(extinction, network)),
            "reduced_chi2": ("time", result.reduced_chi_square),
            "degrees_of_freedom": ("time", np.where(freedom >= 0, freedom, np.nan)),
            "shots": ("time", _shots(beams, intervals)),
            "beam_range": (("beam", "crossing"), _distances(network)[:, near]),
            **multiplier,
        },
        coords=_coordinates(beams, intervals, network, near),
        attrs={"steps": _describe_steps(beams, network, settings, visibility)},
    )
    return product.isel(time=np.isin(intervals, given))


def _without_gaps(intervals: Integers, per_block: int) -> Integers:
    """Return all intervals from the first to the last of each block: air changes in gaps too."""
    block = intervals // per_block
    last = np.flatnonzero(np.diff(block, append=block[-1:] + 1))
    first = np.concatenate([[0], last[:-1] + 1])
    runs = [np.arange(intervals[a], intervals[b] + 1) for a, b in zip(first, last, strict=True)]
    return np.concatenate(runs)


def _gather_signals(
    beams: Sequence[BeamAverages], intervals: Integers, network: Network
) -> _Signals:
    bins = max(beam.averages.sizes["range"] for beam in beams)
    shape = (intervals.size, len(beams), bins)
    power, variance, baseline = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape)
    grid, overlap = np.full(shape[1:], np.nan), np.ones(shape[1:])
    error, tail_signal = np.full(shape[:2], np.nan), np.zeros(shape[:2])
    warnings = np.zeros(shape[:2], dtype=np.int32)
    for index, beam in enumerate(beams):
        rows = np.searchsorted(intervals, beam.interval)
        data, distance = beam.averages, beam.averages["range"].to_numpy().astype(np.float64)
        quality = data["quality"].to_numpy()
        values = np.where((quality & int(_UNUSABLE)) != 0, np.nan, data["power"].to_numpy())
        # Bins are averaged between crossings.
        noise = (data["variance"] * data[CORRELATION_LENGTH]).to_numpy()
        sky = from_tail(values, distance, noise, beam.background_range)
        beam_bins = slice(distance.size)
        power[rows, index, beam_bins] = values - sky.background[:, np.newaxis]
        variance[rows, index, beam_bins] = noise
        grid[index, beam_bins] = distance
        if beam.overlap is not None:
            # Bins nearer than the first known overlap are not used anyway.
            overlap[index, beam_bins] = np.nan_to_num(beam.overlap)
        off = baseline_error(data)
        if off is not None:
            baseline[rows, index, beam_bins] = off.transpose("time", "range").to_numpy()
        error[rows, index] = sky.standard_error
        tail_signal[rows, index] = detected(sky.left, sky.left_standard_error)
        ranges = network.on_beam(index)[1]
        used = (distance >= ranges[0]) & (distance <= ranges[-1])
        passed = np.int32(_WARNINGS | Quality.NO_SIGNAL)
        warnings[rows, index] = np.bitwise_or.reduce(quality[:, used] & passed, axis=1)
        warnings[rows, index] |= sky.unjudged * np.int32(Quality.BACKGROUND_UNCERTAIN)
    # Farther bins do not matter.
    used_bins = slice(_bins_used(grid, network))
    return _Signals(
        np.ascontiguousarray(power[..., used_bins]),
        np.ascontiguousarray(variance[..., used_bins]),
        grid[:, used_bins],
        error,
        tail_signal,
        warnings,
        overlap[:, used_bins],
        np.ascontiguousarray(baseline[..., used_bins]),
    )


def _bins_used(grid: Array, network: Network) -> int:
    """Return the number of bins up to the farthest crossing of any beam, and a margin."""
    reached = [int(np.sum(row <= network.on_beam(index)[1][-1])) for index, row in enumerate(grid)]
    return max(reached) + THRESHOLDS.bins_beyond


def _errors(
    result: NetworkResult, signals: _Signals, network: Network, settings: NetworkAssumptions
) -> tuple[Array, Array, Array]:
    """Return (interval, crossing) errors of extinction, m-1; NaN where there is no value.

    Random ones from noise and background, systematic ones, and the part of these from signal in
    the background.
    """

    def of_each_beam(error: Array) -> Array:
        added = np.broadcast_to(np.nan_to_num(error), signals.power.shape)
        beams = np.flatnonzero(added.any(axis=(0, 2)))
        causes: list[dict[int, SignalChange]] = [
            {int(beam): SignalChange(power=added[:, beam])} for beam in beams
        ]
        return np.asarray(np.sqrt((result.respond(causes) ** 2).sum(axis=2)))

    # The declared error of the overlap replaces the default.
    stated = result.extinction_standard_error**2 - result.overlap_error**2
    by_background = of_each_beam(signals.background_error[..., np.newaxis])
    tail_signal = of_each_beam(signals.tail_signal[..., np.newaxis])
    exponent = SignalChange(exponent=settings.exponent_relative_error)
    contributions = [
        result.respond([dict.fromkeys(range(network.beams), exponent)])[..., 0],
        lidar_ratio_error(result, network, signals.range, settings.lidar_ratio_relative_error),
        tail_signal,
        of_each_beam(signals.baseline),
        result.overlap_response * result.extinction * settings.overlap_relative_error,
        result.multiplier_error,
    ]
    random = root_sum_square([np.sqrt(np.maximum(stated, 0.0)), by_background])
    return random, root_sum_square(contributions), tail_signal


def lidar_ratio_error(
    result: NetworkResult, network: Network, range_: Array, relative_error: float
) -> Array:
    """Return the (profile, crossing) error from lidar ratios that differ between crossings, m-1.

    The signals at a crossing are changed by the relative error, and between it and its neighbours
    by less.

    Parameters
    ----------
    result : NetworkResult
    network : Network
    range_ : (beam, bin) or (bin,) float64
        m.
    relative_error : float
    """
    causes: list[dict[int, SignalChange]] = [{} for _ in range(network.crossings)]
    along = np.broadcast_to(range_, (network.beams, range_.shape[-1]))
    for beam in range(network.beams):
        crossings, ranges = network.on_beam(beam)
        for crossing in crossings:
            peak = relative_error * (crossings == crossing)
            weights = np.interp(along[beam], ranges, peak)
            causes[crossing][beam] = SignalChange(relative=weights)
    return np.asarray(np.sqrt((result.respond(causes) ** 2).sum(axis=2)))


def _quality_flags(
    result: NetworkResult,
    errors: tuple[Array, Array, Array],
    signals: _Signals,
    network: Network,
) -> Flags:
    """Return the quality bits of each value, with a reason for each missing one."""
    bits = result.quality.copy()
    random, systematic, tail_signal = errors
    for index, crossing in zip(network.passages.beam, network.passages.crossing, strict=True):
        bits[:, crossing] |= signals.warnings[:, index]
    # Light of other beams gives a value.
    bits[(bits & np.int32(Quality.INPUT_MISSING)) == 0] &= ~np.int32(Quality.NO_SIGNAL)
    with np.errstate(invalid="ignore"):
        error = np.hypot(random, systematic)
        uncertain = ~(COMMON.significant * error < result.extinction)
    background_doubt = shifts(tail_signal, random)
    bits |= np.where(background_doubt, np.int32(Quality.BACKGROUND_UNCERTAIN), np.int32(0))
    bits |= np.where(
        uncertain & np.isfinite(result.extinction),
        np.int32(NetworkQuality.POORLY_DETERMINED),
        np.int32(0),
    )
    with np.errstate(invalid="ignore"):
        bits[result.degrees_of_freedom < 0] |= np.int32(NetworkQuality.PRIOR_DOMINATED)
    unexplained = ~np.isfinite(result.extinction) & ((bits & np.int32(REJECTING)) == 0)
    weak = result.raised(NetworkQuality.LOW_LEVERAGE)
    reason = np.where(weak, np.int32(Quality.LOW_SIGNAL), np.int32(Quality.NO_REAL_SOLUTION))
    return bits | np.where(unexplained, reason, np.int32(0))


def _optical_depth(extinction: Array, network: Network) -> Array:
    """Return the optical depth between the outermost crossings of the longest beam."""
    spans = [ranges[-1] - ranges[0] for _, ranges in map(network.on_beam, range(network.beams))]
    known = np.isfinite(extinction)
    with np.errstate(invalid="ignore"):
        mean = np.where(known, extinction, 0.0).sum(axis=1) / known.sum(axis=1)
    return np.asarray(mean * max(spans))


def _distances(network: Network) -> Array:
    """Return (beam, crossing) ranges; NaN where a beam does not pass through a crossing."""
    ranges = np.full((network.beams, network.crossings), np.nan)
    ranges[network.passages.beam, network.passages.crossing] = network.passages.range
    return ranges


def _shots(beams: Sequence[BeamAverages], intervals: Integers) -> npt.NDArray[np.int32]:
    """Return (interval,) laser shots of all beams."""
    total = np.zeros(intervals.size, dtype=np.int64)
    for beam in beams:
        total[np.searchsorted(intervals, beam.interval)] += beam.averages["shots"].to_numpy()
    return np.minimum(total, np.iinfo(np.int32).max).astype(np.int32)


def _coordinates(
    beams: Sequence[BeamAverages],
    intervals: Integers,
    network: Network,
    near: Indices,
) -> dict[str, Any]:
    if network.geodetic is None:
        raise RetrievalInputError(
            "has no positions", field="network", remedy="build it with geometry.build_network"
        )
    limits = np.iinfo(np.int64)
    start, stop = np.full(intervals.size, limits.max), np.full(intervals.size, limits.min)
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


def _describe_steps(
    beams: Sequence[BeamAverages],
    network: Network,
    settings: NetworkAssumptions,
    visibility: VisibilityDefinition,
) -> str:
    """Return a description of the beams, their crossings and the definition of visibility."""
    texts = [visibility.words]
    if settings.multiplier is not None:
        texts.append(f"triangles of beams, with the multiplier {settings.multiplier}")
    for index, beam in enumerate(beams):
        numbers, ranges = network.on_beam(index)
        crossings = ", ".join(f"{v} at {r:.0f} m" for v, r in zip(numbers, ranges, strict=True))
        texts.append(
            f"beam {index}: {beam.instrument}, zenith angle {beam.zenith_angle:g}, azimuth"
            f" {beam.azimuth:g} degree, with the crossings {crossings}"
        )
    return "; ".join(texts)

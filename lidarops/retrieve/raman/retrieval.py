"""Extinction, backscatter and lidar ratio of profiles, with an error budget."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from lidarops.flags import Quality
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.raman import backscatter as _backscatter
from lidarops.retrieve.raman._negative_depth import falling
from lidarops.retrieve.raman.backscatter import Backscatter
from lidarops.retrieve.raman.cells import Cells
from lidarops.retrieve.raman.depth_fit import DepthFit, SignalNoise, fit_depth, root_of_squares
from lidarops.retrieve.raman.extinction import Extinction, extinction_of, slope
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.reference import choose_window
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.raman.signals import AirColumn, CellSignal, ChannelSignal, cell_signals
from lidarops.retrieve.raman.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

EXTINCTION_CAUSES: Final = (
    "noise", "resolution", "background", "dead_time", "angstrom", "molecular", "overlap",
)  # fmt: skip
BACKSCATTER_CAUSES: Final = (
    "noise", "background", "dead_time", "reference", "angstrom", "molecular", "overlap",
)  # fmt: skip
RANDOM: Final = frozenset({"noise", "resolution", "background"})
"""Causes whose errors change from profile to profile; those of all others are systematic."""
_MOST_UNKNOWN: Final = 0.05
"""Weight of cells without backscatter in the lidar ratio of a cell."""


@dataclass(frozen=True, slots=True)
class RamanResult:
    """Profiles of particles, (profile, cell) unless stated; NaN where there is no value."""

    extinction: Array
    """m-1, mean over `vertical_resolution`."""
    extinction_budget: dict[str, Array]
    """Absolute error from each of `EXTINCTION_CAUSES`, m-1."""
    extinction_smoothing_error: Array
    """m-1: of extinction as that of the cell itself; not part of the budget."""
    vertical_resolution: Array
    """m along the beam, of extinction and lidar ratio."""
    backscatter: Array
    """m-1 sr-1, of the cell."""
    backscatter_budget: dict[str, Array]
    """Absolute error from each of `BACKSCATTER_CAUSES`, m-1 sr-1."""
    lidar_ratio: Array
    """sr: extinction over backscatter, which is smoothed as extinction is."""
    lidar_ratio_random: Array
    """sr, standard error by random causes, with the covariance of both."""
    lidar_ratio_systematic: Array
    """sr, standard error by all others."""
    raman_depth: Array
    """Fitted optical depth of particles at both wavelengths, up to a constant."""
    raman_depth_error: Array
    """Its standard error by noise."""
    reference_bottom: Array
    """(profile,): m; NaN without reference."""
    reference_top: Array
    """(profile,): m."""
    reference_rejections: Flags
    """(profile,): bits of `Rejection` of all candidates together."""
    quality: Flags

    @property
    def extinction_standard_error(self) -> Array:
        """Root of the sum of squares of the budget, m-1."""
        return total_error(self.extinction_budget)

    @property
    def backscatter_standard_error(self) -> Array:
        """Root of the sum of squares of the budget, m-1 sr-1."""
        return total_error(self.backscatter_budget)

    @property
    def lidar_ratio_standard_error(self) -> Array:
        """Random and systematic errors together, sr."""
        return np.hypot(self.lidar_ratio_random, self.lidar_ratio_systematic)


def total_error(budget: dict[str, Array]) -> Array:
    """Return the root of the sum of squares of the errors of all causes."""
    return np.asarray(np.sqrt(sum(error**2 for error in budget.values())))


@dataclass(frozen=True, slots=True)
class _AirCells:
    """Clean air in cells, (cell,)."""

    range: Array
    """m."""
    backscatter: Array
    """m-1 sr-1."""
    depth: Array
    raman_depth: Array
    overlap: Array
    """1 where it is not known."""

    @classmethod
    def of(cls, air: AirColumn, cells: Cells) -> Self:
        """Return the means of cells."""
        profiles = (air.range, air.backscatter, air.depth, air.raman_depth, air.known_overlap)
        return cls(*(cells.mean(profile) for profile in profiles))


@dataclass(frozen=True, slots=True)
class _Cause:
    """Effect of one standard error of one cause on one profile, with signs, (cell,)."""

    name: str
    extinction: Array
    """m-1."""
    backscatter: Array
    """m-1 sr-1."""
    depth: Array
    """Of the fitted optical depth."""


@dataclass(frozen=True, slots=True)
class _Profile:
    """One profile before its calibration."""

    raman: CellSignal
    elastic: CellSignal
    fit: DepthFit
    extinction: Extinction


def retrieve_raman(
    raman: ChannelSignal,
    elastic: ChannelSignal,
    air: AirColumn,
    cells: Cells,
    settings: RamanSettings,
    *,
    quality: Flags,
) -> RamanResult:
    r"""Return extinction, backscatter and lidar ratio of particles without an assumed lidar ratio.

    Parameters
    ----------
    raman, elastic : ChannelSignal
        Of nitrogen, and at the laser wavelength, of the same bins.
    air : AirColumn
    cells : Cells
    settings : RamanSettings
    quality : (profile, cell) int32
        Bits of `Quality`. Cells with INCOMPLETE_OVERLAP take no part in the fit of the Raman
        signal; there, backscatter follows from the ratio of the signals of the cell.

    Returns
    -------
    RamanResult
        Profiles without Raman signal are NaN, with WEAK_SIGNAL.

    References
    ----------
    `ansmann1990`, `ansmann1992`, `pappalardo2004`, `russo2006`.
    """
    partial = (quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0
    pairs = zip(
        cell_signals(raman, air.raman_shape, cells),
        cell_signals(elastic, air.elastic_shape, cells),
        strict=True,
    )
    rows = [
        _profile(of_raman, of_elastic, cells, settings, near)
        for (of_raman, of_elastic), near in zip(pairs, partial, strict=True)
    ]
    fitted = [None if row is None else (row.raman, row.fit) for row in rows]
    window = choose_window(elastic, fitted, air, cells, settings)
    edges = np.stack(window.edges, axis=-1)
    in_cells = _AirCells.of(air, cells)
    solved = [
        _Solution.of(row, in_cells, cells, settings, partial[number], edges[number], number)
        for number, row in enumerate(rows)
        if row is not None
    ]
    rejections = np.bitwise_or.reduce(window.rejections, axis=-1).astype(np.int32)
    return _joined(solved, quality, window, rejections, cells.range)


def _profile(
    raman: CellSignal, elastic: CellSignal, cells: Cells, settings: RamanSettings, partial: Mask
) -> _Profile | None:
    """Return the fitted profile; None where there is no Raman signal."""
    noise = SignalNoise(raman.noise.per_signal, np.where(partial, np.inf, raman.noise.fixed))
    fit = fit_depth(raman.value, noise)
    if fit is None:
        return None
    return _Profile(raman, elastic, fit, extinction_of(fit, cells.step, settings.ratio))


@dataclass(frozen=True, slots=True)
class _Solution:
    """Values and errors of one profile, (cell,)."""

    number: int
    profile: _Profile
    extinction_budget: dict[str, Array]
    backscatter: Array
    backscatter_budget: dict[str, Array]
    lidar_ratio: tuple[Array, Array, Array]
    """Value, random and systematic standard error, sr."""
    negative: Mask
    """Cells beyond which the Raman signal falls by less than in clean air."""

    @classmethod
    def of(
        cls,
        profile: _Profile,
        air: _AirCells,
        cells: Cells,
        settings: RamanSettings,
        partial: Mask,
        window: Array,
        number: int,
    ) -> Self:
        """Calibrate a profile and state its errors."""
        molecular = air.backscatter
        bottom, top = window
        inside = (cells.range >= bottom) & (cells.range <= top)
        ratio = _ratio(profile, partial, settings.ratio)
        assumed = settings.scattering_ratio * molecular
        calibrated = _backscatter.calibrated(
            ratio, profile.elastic.noise, profile.fit.noise, assumed, inside
        )
        effects = _Effects(profile, calibrated, air, cells.step, settings, partial)
        causes = list(effects.causes())
        extinction = profile.extinction
        budget = _summed(EXTINCTION_CAUSES, [(c.name, c.extinction) for c in causes])
        budget |= {"noise": extinction.noise_error, "resolution": extinction.resolution_error}
        empty = np.full(molecular.size, np.nan)
        usable = ~partial & (profile.fit.expected_error <= THRESHOLDS.most_uncertain)
        negative = _negative(profile.fit, [cause.depth for cause in causes], usable)
        if calibrated is None:
            absent = dict.fromkeys(BACKSCATTER_CAUSES, empty)
            return cls(number, profile, budget, empty, absent, (empty, empty, empty), negative)
        noise = calibrated.respond(np.zeros((molecular.size, 1)), profile.fit.noise)
        of_backscatter = _summed(BACKSCATTER_CAUSES, [(c.name, c.backscatter) for c in causes])
        of_backscatter["noise"] = np.sqrt(
            calibrated.own**2
            + root_of_squares(noise) ** 2
            + (calibrated.total * calibrated.reference) ** 2
        )
        value = calibrated.total - molecular
        ratios = _lidar_ratio(profile.extinction, calibrated, value, noise, causes, usable)
        return cls(number, profile, budget, value, of_backscatter, ratios, negative)


def _negative(fit: DepthFit, effects: Sequence[Array], usable: Mask) -> Mask:
    """Return the cells from which on extinction is negative in total, by more than its error.

    The total is from a cell to any other beyond. Air without particles has none, so that overlap
    is not complete there, or the background is wrong.
    """
    compared = np.flatnonzero(usable)
    return falling(fit.depth, fit.inverse, np.stack(effects), compared, THRESHOLDS.negative)


def _ratio(profile: _Profile, partial: Mask, ratio: float) -> _backscatter.Ratio:
    """Return the ratio of the signals: to the smooth Raman signal, but in partial overlap."""
    fit, elastic, raman = profile.fit, profile.elastic, profile.raman
    smooth = _backscatter.smooth_ratio(
        elastic.value, elastic.variance, fit.depth, fit.standard_error, ratio
    )
    near = _backscatter.cell_ratio(
        elastic.value, elastic.variance, raman.value, raman.variance, fit.depth, ratio
    )
    return _backscatter.Ratio(
        np.where(partial, near.value, smooth.value),
        np.where(partial, near.variance, smooth.variance),
        np.where(partial, near.sensitivity, smooth.sensitivity),
        np.where(partial, near.factor, smooth.factor),
    )


@dataclass(frozen=True, slots=True)
class _Effects:
    """Effects of the causes of error on one profile."""

    profile: _Profile
    calibrated: Backscatter | None
    air: _AirCells
    step: float
    """m, length of a cell."""
    settings: RamanSettings
    partial: Mask

    def causes(self) -> Iterator[_Cause]:
        """Yield the effect of one standard error of each cause but noise."""
        none, total = np.zeros(self.partial.size), self._total()
        molecular, settings = self.air.backscatter, self.settings
        shares = none if self.calibrated is None else self.calibrated.shares
        away = self.air.range - shares @ self.air.range
        # Of the air that is assumed in the window, and that is subtracted.
        shifts = {
            "molecular": settings.molecular_relative_error * (total - molecular),
            "slope": -settings.molecular_slope_error * away * molecular,
        }
        for cause in self._of_signals(list(self._changes())):
            shifted = cause.backscatter + shifts.get(cause.name, none)
            name = "molecular" if cause.name == "slope" else cause.name
            yield replace(cause, name=name, backscatter=shifted)
        error = self.settings.reference_relative_error
        yield _Cause("reference", none, error * total, none)
        change = self.settings.ratio_error / (1.0 + self.settings.ratio)
        relative = -2.0 * self.profile.fit.depth * change / (1.0 + self.settings.ratio)
        alpha = -change * self.profile.extinction.value
        yield _Cause("angstrom", alpha, self._respond(relative, none), none)

    def _changes(self) -> Iterator[tuple[str, Array, Array]]:
        """Yield names, and relative changes of the Raman and the elastic signal."""
        raman, elastic = self.profile.raman, self.profile.elastic
        level, none = np.exp(-self.profile.fit.depth), np.zeros(self.partial.size)
        for name in ("background", "dead_time"):
            yield name, raman.relative(-getattr(raman, name), level), none
            yield name, none, elastic.relative(-getattr(elastic, name), elastic.value)
        error, depth = self.settings.molecular_relative_error, self.air.depth
        yield "molecular", error * (depth + self.air.raman_depth), 2.0 * error * depth
        yield "slope", -self.settings.molecular_slope_error * self.air.range, none
        # Of the signal, in proportion to the overlap itself.
        of_overlap = self.settings.overlap_relative_error * (1.0 / self.air.overlap - 1.0)
        yield "overlap", of_overlap, of_overlap

    def _of_signals(self, changes: Sequence[tuple[str, Array, Array]]) -> Iterator[_Cause]:
        """Yield the effects of relative changes of the signals."""
        raman, elastic = (np.stack([c[k] for c in changes], axis=-1) for k in (1, 2))
        partial = self.partial[:, np.newaxis]
        depth = self.profile.fit.respond(np.where(partial, 0.0, raman))
        alpha = slope(depth, self.step) / (1.0 + self.settings.ratio)
        beta = self._respond(elastic - np.where(partial, raman, 0.0), depth)
        for change, *effects in zip(changes, alpha.T, beta.T, depth.T, strict=True):
            yield _Cause(change[0], *effects)

    def _total(self) -> Array:
        """Return total backscatter; NaN without calibration."""
        if self.calibrated is None:
            return np.full(self.partial.size, np.nan)
        return self.calibrated.total

    def _respond(self, relative: Array, depth: Array) -> Array:
        if self.calibrated is None:
            return np.full(depth.shape, np.nan)
        return self.calibrated.respond(relative, depth)


def _summed(names: Sequence[str], causes: Sequence[tuple[str, Array]]) -> dict[str, Array]:
    """Return the absolute error from each cause, those of both signals together."""
    budget: dict[str, Array] = {}
    for name in names:
        parts = [error for known, error in causes if known == name]
        budget[name] = np.sqrt(sum((part**2 for part in parts), np.zeros(1)))
    return budget


def _lidar_ratio(
    extinction: Extinction,
    calibrated: Backscatter,
    value: Array,
    noise: Array,
    causes: Sequence[_Cause],
    usable: Mask,
) -> tuple[Array, Array, Array]:
    """Return the lidar ratio with random and systematic error, from equally smoothed values."""
    kernel = extinction.kernel
    known = np.isfinite(value)
    complete = np.abs(kernel[:, ~known]).sum(axis=1) < _MOST_UNKNOWN
    columns = np.column_stack([value, calibrated.total, *(c.backscatter for c in causes), noise])
    smoothed = (kernel[:, known] @ columns[known]).T
    (smooth, total), of_smooth = smoothed[:2], smoothed[2 + len(causes) :].T
    own = kernel[:, known] ** 2 @ calibrated.own[known] ** 2
    level = calibrated.reference * total
    error = np.sqrt(root_of_squares(of_smooth) ** 2 + own + level**2)
    # The reciprocal of backscatter far below zero overflows; no value is given there.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        uncertainty = (error / smooth) ** 2
        inverse = _backscatter.inverse_of_weak(smooth, error)
        ratio = extinction.value * inverse
        by_noise = extinction.noise - ratio[:, np.newaxis] * of_smooth
        random = root_of_squares(by_noise) ** 2 + (own + level**2) * ratio**2
        systematic = np.zeros(value.size)
        for cause, of_cause in zip(causes, smoothed[2:], strict=False):
            square = (cause.extinction - ratio * of_cause) ** 2
            if cause.name in RANDOM:
                random += square
            else:
                systematic += square
        # The variance of a reciprocal to the second order.
        random *= inverse**2 * (1.0 + 8.0 * uncertainty)
        systematic *= inverse**2
        likely = _likely(extinction, smooth, error, complete & usable)
        # The error is in proportion to total backscatter: this is that of the likely one.
        least = THRESHOLDS.least_ratio_certainty * error * (1.0 + (likely - smooth) / total)
    certain = complete & (smooth > 0.0) & (likely > least)
    return (
        np.where(certain, ratio, np.nan),
        np.where(certain, np.sqrt(random), np.nan),
        np.where(certain, np.sqrt(systematic), np.nan),
    )


def _likely(extinction: Extinction, backscatter: Array, error: Array, known: Mask) -> Array:
    """Return the weighted mean of backscatter and of what extinction lets expect, m-1 sr-1.

    With weights by the lidar ratio of all `known` cells together, its noise and that of the lidar
    ratio of a cell are independent, so that it selects no lidar ratios by their noise; backscatter
    alone would keep those whose backscatter is too high.
    """
    variance = extinction.noise_error**2 + extinction.resolution_error**2
    weight = np.where(known, extinction.value / variance, 0.0)
    least, most = THRESHOLDS.plausible_lidar_ratios
    total, scattered = (float(weight @ values) for values in (extinction.value, backscatter))
    together = min(max(total / scattered, least), most) if scattered > 0.0 else most
    typical = THRESHOLDS.typical_lidar_ratio
    share = error**2 / (error**2 + variance / (typical * together))
    return np.asarray(backscatter + share * (extinction.value / typical - backscatter))


def _joined(
    solved: Sequence[_Solution],
    quality: Flags,
    window: reference_window.ReferenceWindow,
    rejections: Flags,
    distance: Array,
) -> RamanResult:
    """Return the profiles together, NaN where a bit rejects them."""
    shape = (quality.shape[0], distance.size)
    weak = np.ones(shape, dtype=np.bool_)
    arrays: dict[str, Array] = {}

    def put(name: str, number: int, row: Array) -> None:
        arrays.setdefault(name, np.full(shape, np.nan))[number] = row

    for one in solved:
        fit, extinction = one.profile.fit, one.profile.extinction
        weak[one.number] = fit.expected_error > THRESHOLDS.most_uncertain
        for name, row in _values(one, fit, extinction):
            put(name, one.number, row)
    flags = quality | np.where(weak, np.int32(RamanQuality.WEAK_SIGNAL), np.int32(0))
    for one in solved:
        flags[one.number, one.negative] |= np.int32(RamanQuality.NEGATIVE_EXTINCTION)
    flags[~window.chosen] |= np.int32(RamanQuality.NO_REFERENCE)
    partial = (quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0

    def values(name: str, hidden: Mask = weak) -> Array:
        return np.where(hidden, np.nan, arrays.get(name, np.full(shape, np.nan)))

    no_slope = weak | partial
    no_ratio = np.isnan(values("lidar_ratio", no_slope))
    flags[no_ratio] |= np.int32(RamanQuality.NO_LIDAR_RATIO)
    return RamanResult(
        extinction=values("extinction", no_slope),
        extinction_budget={
            cause: values(f"extinction {cause}", no_slope) for cause in EXTINCTION_CAUSES
        },
        extinction_smoothing_error=values("smoothing", no_slope),
        vertical_resolution=values("resolution", no_slope),
        backscatter=values("backscatter"),
        backscatter_budget={cause: values(f"backscatter {cause}") for cause in BACKSCATTER_CAUSES},
        lidar_ratio=values("lidar_ratio", no_slope),
        lidar_ratio_random=values("random", no_slope),
        lidar_ratio_systematic=values("systematic", no_slope),
        raman_depth=values("depth"),
        raman_depth_error=values("depth_error"),
        reference_bottom=window.bottom,
        reference_top=window.top,
        reference_rejections=rejections,
        quality=flags.astype(np.int32),
    )


def _values(one: _Solution, fit: DepthFit, extinction: Extinction) -> Iterator[tuple[str, Array]]:
    """Yield the values of one profile by name."""
    yield "extinction", extinction.value
    yield "smoothing", extinction.smoothing_error
    yield "resolution", extinction.vertical_resolution
    yield "backscatter", one.backscatter
    yield "depth", fit.depth
    yield "depth_error", fit.standard_error
    yield from zip(("lidar_ratio", "random", "systematic"), one.lidar_ratio, strict=True)
    yield from ((f"extinction {name}", row) for name, row in one.extinction_budget.items())
    yield from ((f"backscatter {name}", row) for name, row in one.backscatter_budget.items())

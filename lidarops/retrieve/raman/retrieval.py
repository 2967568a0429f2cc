"""Extinction, backscatter and lidar ratio of profiles, with an error budget."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from lidarops.flags import Quality
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Integers, root_sum_square
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.raman import backscatter as _backscatter
from lidarops.retrieve.raman.backscatter import Backscatter, inverse_of_weak
from lidarops.retrieve.raman.depth_fit import (
    DepthFit,
    Extinction,
    SignalNoise,
    extinction_of,
    fit_depth,
    root_of_squares,
)
from lidarops.retrieve.raman.errors import (
    BACKSCATTER_CAUSES,
    EXTINCTION_CAUSES,
    RANDOM,
    Cause,
    Effects,
    Profile,
    Quotient,
    summed,
)
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.reference import choose_window
from lidarops.retrieve.raman.signals import (
    AirColumn,
    Cells,
    CellSignal,
    ChannelSignal,
    RamanSettings,
    cell_signals,
)
from lidarops.retrieve.raman.thresholds import THRESHOLDS


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
    reference: reference_window.ReferenceWindow
    """(profile,): NaN without reference."""
    quality: Flags

    @property
    def extinction_standard_error(self) -> Array:
        """Root of the sum of squares of the budget, m-1."""
        return root_sum_square(self.extinction_budget.values())

    @property
    def backscatter_standard_error(self) -> Array:
        """Root of the sum of squares of the budget, m-1 sr-1."""
        return root_sum_square(self.backscatter_budget.values())

    @property
    def lidar_ratio_standard_error(self) -> Array:
        """Random and systematic errors together, sr."""
        return np.hypot(self.lidar_ratio_random, self.lidar_ratio_systematic)


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
    errors = window.relative_error(settings.reference_relative_error)
    assumed = [replace(settings, reference_relative_error=float(error)) for error in errors]
    in_cells = air.in_cells(cells)
    solved = [
        _Solution.of(row, in_cells, cells, assumed[number], partial[number], edges[number], number)
        for number, row in enumerate(rows)
        if row is not None
    ]
    return _joined(solved, quality, window)


def _profile(
    raman: CellSignal, elastic: CellSignal, cells: Cells, settings: RamanSettings, partial: Booleans
) -> Profile | None:
    """Return the fitted profile; None where there is no Raman signal."""
    noise = SignalNoise(raman.noise.per_signal, np.where(partial, np.inf, raman.noise.fixed))
    fit = fit_depth(raman.value, noise)
    if fit is None:
        return None
    return Profile(raman, elastic, fit, extinction_of(fit, cells.step, settings.ratio))


@dataclass(frozen=True, slots=True)
class _Solution:
    """Values and errors of one profile, (cell,)."""

    number: int
    profile: Profile
    extinction_budget: dict[str, Array]
    backscatter: Array
    backscatter_budget: dict[str, Array]
    lidar_ratio: Quotient
    negative: Booleans
    """Cells beyond which the Raman signal falls by less than in clean air."""

    @classmethod
    def of(
        cls,
        profile: Profile,
        air: AirColumn,
        cells: Cells,
        settings: RamanSettings,
        partial: Booleans,
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
        effects = Effects(profile, calibrated, air, cells.step, settings, partial)
        causes = list(effects.causes())
        extinction = profile.extinction
        budget = summed(EXTINCTION_CAUSES, [(c.name, c.extinction) for c in causes])
        budget |= {"noise": extinction.noise_error, "resolution": extinction.resolution_error}
        empty = np.full(molecular.size, np.nan)
        usable = ~partial & (profile.fit.expected_error <= THRESHOLDS.most_uncertain)
        negative = _negative(profile.fit, [cause.depth for cause in causes], usable)
        if calibrated is None:
            absent = dict.fromkeys(BACKSCATTER_CAUSES, empty)
            return cls(
                number, profile, budget, empty, absent, Quotient(empty, empty, empty), negative
            )
        noise = calibrated.respond(np.zeros((molecular.size, 1)), profile.fit.noise)
        of_backscatter = summed(BACKSCATTER_CAUSES, [(c.name, c.backscatter) for c in causes])
        of_backscatter["noise"] = np.sqrt(
            calibrated.own**2
            + root_of_squares(noise) ** 2
            + (calibrated.total * calibrated.reference) ** 2
        )
        value = calibrated.total - molecular
        ratios = lidar_ratio_of(profile.extinction, calibrated, value, noise, causes, usable)
        return cls(number, profile, budget, value, of_backscatter, ratios, negative)


def _ratio(profile: Profile, partial: Booleans, ratio: float) -> _backscatter.Ratio:
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


def _negative(fit: DepthFit, effects: Sequence[Array], usable: Booleans) -> Booleans:
    """Return the cells from which on extinction is negative in total, by more than its error.

    The total is from a cell to any other beyond. Air without particles has none, so that overlap
    is not complete there, or the background is wrong.
    """
    compared = np.flatnonzero(usable)
    return falling(fit.depth, fit.inverse, np.stack(effects), compared, THRESHOLDS.negative)


def _joined(
    solved: Sequence[_Solution],
    quality: Flags,
    window: reference_window.ReferenceWindow,
) -> RamanResult:
    """Return the profiles together, NaN where a bit rejects them."""
    numbers = [one.number for one in solved]

    def stacked(rows: Iterable[Array], hidden: Booleans) -> Array:
        values = np.full(quality.shape, np.nan)
        for number, row in zip(numbers, rows, strict=True):
            values[number] = row
        return np.where(hidden, np.nan, values)

    nothing = np.zeros(quality.shape, dtype=np.bool_)
    expected = stacked((one.profile.fit.expected_error for one in solved), nothing)
    weak = ~(expected <= THRESHOLDS.most_uncertain)
    no_slope = weak | ((quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0)

    def values(rows: Iterable[Array]) -> Array:
        return stacked(rows, weak)

    def slopes(rows: Iterable[Array]) -> Array:
        return stacked(rows, no_slope)

    lidar_ratio = slopes(one.lidar_ratio.value for one in solved)
    return RamanResult(
        extinction=slopes(one.profile.extinction.value for one in solved),
        extinction_budget={
            cause: slopes(one.extinction_budget[cause] for one in solved)
            for cause in EXTINCTION_CAUSES
        },
        extinction_smoothing_error=slopes(one.profile.extinction.smoothing_error for one in solved),
        vertical_resolution=slopes(one.profile.extinction.vertical_resolution for one in solved),
        backscatter=values(one.backscatter for one in solved),
        backscatter_budget={
            cause: values(one.backscatter_budget[cause] for one in solved)
            for cause in BACKSCATTER_CAUSES
        },
        lidar_ratio=lidar_ratio,
        lidar_ratio_random=slopes(one.lidar_ratio.random for one in solved),
        lidar_ratio_systematic=slopes(one.lidar_ratio.systematic for one in solved),
        raman_depth=values(one.profile.fit.depth for one in solved),
        raman_depth_error=values(one.profile.fit.standard_error for one in solved),
        reference=window,
        quality=_flags(solved, quality, weak, np.isnan(lidar_ratio), window.chosen),
    )


def _flags(
    solved: Sequence[_Solution],
    quality: Flags,
    weak: Booleans,
    no_ratio: Booleans,
    chosen: Booleans,
) -> Flags:
    """Return the quality with the bits of the retrieval."""
    flags = quality.copy()
    flags[weak] |= np.int32(RamanQuality.WEAK_SIGNAL)
    flags[no_ratio] |= np.int32(RamanQuality.NO_LIDAR_RATIO)
    flags[~chosen] |= np.int32(RamanQuality.NO_REFERENCE)
    for one in solved:
        flags[one.number, one.negative] |= np.int32(RamanQuality.NEGATIVE_EXTINCTION)
    return flags


@compiled
def falling(
    depth: Array,
    covariance: Array,
    effects: Array,
    usable: Integers,
    least: float,
) -> Booleans:
    """Return the cells from which the depth falls to any other beyond, by more than its error.

    Parameters
    ----------
    depth : (cell,) float
    covariance : (cell, cell) float
        Of the depth, by noise and smoothness.
    effects : (cause, cell) float
        Change of the depth with one standard error of each other cause.
    usable : (usable cell,) int
        Cells that are compared, ascending.
    least : float
        Standard errors.
    """
    negative = np.zeros(depth.size, dtype=np.bool_)
    for number in range(usable.size):
        i = usable[number]
        for beyond in range(number + 1, usable.size):
            j = usable[beyond]
            if depth[i] <= depth[j]:
                continue
            square = (depth[i] - depth[j]) ** 2
            variance = covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]
            # Most differ by less than their noise.
            if square <= least**2 * variance:
                continue
            for effect in effects:
                variance += (effect[i] - effect[j]) ** 2
            if square > least**2 * variance:
                negative[i] = True
                break
    return negative


_MOST_UNKNOWN: Final = 0.05
"""Weight of cells without backscatter in the lidar ratio of a cell."""
_NODES: Final = np.linspace(-6.0, 6.0, 49)
"""Standard deviations at which chances of lidar ratios are compared."""


def lidar_ratio_of(
    extinction: Extinction,
    calibrated: Backscatter,
    value: Array,
    noise: Array,
    causes: Sequence[Cause],
    usable: Booleans,
) -> Quotient:
    r"""Return the lidar ratio, from equally smoothed extinction and backscatter.

    Its change is :math:`\delta S = (\delta\alpha - S\,\delta b) / b`, of noise and of each cause.
    The error is not that at the value, which noise that makes the value small makes small as well:
    see `_chances`.

    Parameters
    ----------
    extinction : Extinction
    calibrated : Backscatter
    value : (cell,) float
        m-1 sr-1, backscatter of particles.
    noise : (cell, noise of a cell) float
        Response of backscatter to the noise of the depth.
    causes : sequence of Cause
    usable : (cell,) bool
        Cells that help to tell the lidar ratio of the profile.

    References
    ----------
    `voinov1985` (reciprocal of a weak value).
    """
    known = np.isfinite(value)
    weights = extinction.kernel[:, known]
    complete = np.abs(extinction.kernel[:, ~known]).sum(axis=1) < _MOST_UNKNOWN
    smooth, total = weights @ value[known], weights @ calibrated.total[known]
    of_noise = weights @ noise[known]
    own = weights**2 @ calibrated.own[known] ** 2 + (calibrated.reference * total) ** 2
    error = np.sqrt(root_of_squares(of_noise) ** 2 + own)
    # The reciprocal of backscatter far below zero overflows; no value is given there.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = inverse_of_weak(smooth, error)
        ratio = extinction.value * inverse
        of_both = np.einsum("ij,ij->i", extinction.noise, of_noise)
        random = np.stack([extinction.noise_error**2, of_both, error**2])
        systematic = np.zeros(value.size)
        for cause in causes:
            change = weights @ cause.backscatter[known]
            if cause.name in RANDOM:
                both = np.stack([cause.extinction, change])
                random += both[[0, 0, 1]] * both[[0, 1, 1]]
            else:
                systematic += (cause.extinction - ratio * change) ** 2
        systematic *= inverse**2
        true, chance = _chances(extinction.value, smooth, random)
        # The expected deviation from the value, in place of an error of the first order.
        scatter = (chance * (true - ratio) ** 2).sum(axis=0)
        likely = _likely(extinction, smooth, error, complete & usable)
        # The error is in proportion to total backscatter: this is that of the likely one.
        least = THRESHOLDS.least_ratio_certainty * error * (1.0 + (likely - smooth) / total)
    certain = complete & (smooth > 0.0) & (likely > least)
    parts = (ratio, np.sqrt(scatter), np.sqrt(systematic))
    return Quotient(*(np.where(certain, part, np.nan) for part in parts))


def _chances(extinction: Array, backscatter: Array, random: Array) -> tuple[Array, Array]:
    r"""Return lidar ratios that may be true, (node, cell), and the chance of each.

    For a true lidar ratio :math:`S`, the noise of :math:`\alpha - S b` is normal, with a variance
    :math:`v(S)` (`fieller1954`). That is the likelihood of :math:`S` with the extinction that is
    most likely for it. Beforehand, lidar ratios are distributed log-normally about the typical one
    :math:`S_0`:

    .. math:: p(S) \propto \exp\left(
        -\frac{(\alpha - S b)^2}{2 v} - \frac{\ln^2 (S / S_0)}{2 s^2}\right)

    per :math:`\mathrm{d} \ln S`.

    Parameters
    ----------
    extinction, backscatter : (cell,) float
        Equally smoothed.
    random : (3, cell) float
        Variance of extinction, covariance, and variance of backscatter.
    """

    def variance(ratio: Array) -> Array:
        return np.asarray(random[0] - 2.0 * ratio * random[1] + ratio**2 * random[2])

    middle, spread = np.log(THRESHOLDS.typical_lidar_ratio), THRESHOLDS.lidar_ratio_spread
    # Nodes around the mean of both logarithms, weighted by errors of the first order.
    value = np.maximum(extinction / backscatter, np.finfo(float).tiny)
    known = 1.0 / (1.0 + variance(value) / (spread * value * backscatter) ** 2)
    centre = middle + known * (np.log(value) - middle)
    logarithm = centre + spread * np.sqrt(1.0 - known) * _NODES[:, np.newaxis]
    ratio = np.exp(logarithm)
    score = (extinction - ratio * backscatter) ** 2 / variance(ratio)
    score += ((logarithm - middle) / spread) ** 2
    chance = np.exp(-0.5 * (score - score.min(axis=0)))
    return ratio, chance / chance.sum(axis=0)


def _likely(extinction: Extinction, backscatter: Array, error: Array, known: Booleans) -> Array:
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

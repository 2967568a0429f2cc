"""Extinction, backscatter and lidar ratio of profiles, with an error budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.flags import Quality
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, root_sum_square
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.raman.backscatter import (
    Backscatter,
    calibrated_backscatter,
    inverse_mean,
    inverse_of_weak,
    signal_ratio,
)
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
from lidarops.retrieve.raman.scattering import particle_ratio
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.raman.signals import (
    AirColumn,
    Cells,
    CellSignal,
    ChannelSignal,
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
    """Bits of the Raman signal and of all quantities; see `concerning`."""

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
        Bits of `Quality` of the Raman signal, and INCOMPLETE_OVERLAP of either. Such cells take no
        part in the fit of the Raman signal; there, backscatter follows from the ratio of the
        signals of the cell.

    Returns
    -------
    RamanResult
        Profiles without Raman signal are NaN, with WEAK_SIGNAL.

    References
    ----------
    `ansmann1990`, `ansmann1992`, `pappalardo2004`, `russo2006`.
    """
    partial = (quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0
    ratio = air.particle_ratio(settings.angstrom_exponent)
    profiles = [
        _profile(of_raman, of_elastic, cells.step, ratio, near)
        for of_raman, of_elastic, near in zip(
            cell_signals(raman, air.raman_shape, cells),
            cell_signals(elastic, air.elastic_shape, cells),
            partial,
            strict=True,
        )
    ]
    limits = settings.reference.along(air.stretch)
    window = choose_window(elastic, profiles, air, cells, limits, ratio)
    errors = window.relative_error(settings.reference.relative_error)
    in_cells = air.in_cells(cells)
    inside = (cells.range >= window.bottom[:, None]) & (cells.range <= window.top[:, None])
    solved = [
        None if profile is None else _solved(profile, in_cells, cells, settings, *of_profile)
        for profile, *of_profile in zip(profiles, errors, partial, inside, strict=True)
    ]
    return _joined(solved, quality, window)


def _profile(
    raman: CellSignal, elastic: CellSignal, step: float, ratio: float, partial: Booleans
) -> Profile | None:
    """Return the fitted profile; None where there is no Raman signal."""
    noise = SignalNoise(raman.noise.per_signal, np.where(partial, np.inf, raman.noise.fixed))
    fit = fit_depth(raman.value, noise)
    return None if fit is None else Profile(raman, elastic, fit, extinction_of(fit, step, ratio))


@dataclass(frozen=True, slots=True)
class _Solution:
    """Values and errors of one profile, (cell,)."""

    profile: Profile
    extinction_budget: dict[str, Array]
    backscatter: Array
    backscatter_budget: dict[str, Array]
    lidar_ratio: Quotient
    negative: Booleans
    """Cells beyond which the Raman signal falls by less than in clean air."""


def _solved(
    profile: Profile,
    air: AirColumn,
    cells: Cells,
    settings: RamanSettings,
    reference_error: float,
    partial: Booleans,
    window: Booleans,
) -> _Solution:
    """Return the values of a profile with their errors, calibrated in the cells of the window."""
    fit, extinction = profile.fit, profile.extinction
    colour = air.particle_ratio(settings.angstrom_exponent)
    ratio = signal_ratio(profile.elastic, profile.raman, fit, partial, colour)
    assumed = settings.reference.scattering_ratio * air.backscatter
    calibrated = calibrated_backscatter(ratio, profile.elastic.noise, fit.noise, assumed, window)
    effects = Effects(profile, calibrated, air, cells.step, settings, reference_error, partial)
    causes, of_overlap = list(effects.causes()), effects.overlap()
    usable = ~partial & fit.certain
    # It is a finding that overlap is not full where it is stated to be.
    known = of_overlap if effects.knows_overlap else []
    negative = _negative(fit, [cause.depth for cause in (*causes, *known)], usable)
    causes += of_overlap
    budget = summed(EXTINCTION_CAUSES, [(c.name, c.extinction) for c in causes])
    budget |= {"noise": extinction.noise_error, "resolution": extinction.resolution_error}
    if calibrated is None:
        empty = np.full(partial.size, np.nan)
        absent = dict.fromkeys(BACKSCATTER_CAUSES, empty)
        return _Solution(profile, budget, empty, absent, Quotient(empty, empty, empty), negative)
    noise = calibrated.respond(np.zeros((partial.size, 1)), fit.noise)
    of_backscatter = summed(BACKSCATTER_CAUSES, [(c.name, c.backscatter) for c in causes])
    of_backscatter["noise"] = np.sqrt(
        calibrated.own**2
        + root_of_squares(noise) ** 2
        + (calibrated.total * calibrated.reference) ** 2
    )
    value = calibrated.total - air.backscatter
    ratios = lidar_ratio_of(extinction, calibrated, value, noise, causes, usable)
    return _Solution(profile, budget, value, of_backscatter, ratios, negative)


def _negative(fit: DepthFit, effects: Sequence[Array], usable: Booleans) -> Booleans:
    """Return the cells from which on extinction is negative in total, by more than its error.

    The total is from a cell to any other beyond. Air without particles has none, so that overlap
    is not complete there, or the background is wrong.
    """
    cells = np.flatnonzero(usable)
    depth, covariance = fit.depth[cells], fit.inverse[np.ix_(cells, cells)]
    own = np.diagonal(covariance)
    variance = own[:, np.newaxis] + own - 2.0 * covariance
    for effect in effects:
        variance += np.subtract.outer(effect[cells], effect[cells]) ** 2
    fall = np.subtract.outer(depth, depth)
    certain = (fall > 0.0) & (fall**2 > COMMON.contradicted**2 * variance)
    negative = np.zeros(usable.size, dtype=np.bool_)
    negative[cells] = np.triu(certain, 1).any(axis=1)
    return negative


def _joined(
    solved: Sequence[_Solution | None],
    quality: Flags,
    window: reference_window.ReferenceWindow,
) -> RamanResult:
    """Return the profiles together, NaN where a bit rejects them."""
    missing = np.full(quality.shape[-1], np.nan)

    def stacked(row: Callable[[_Solution], Array], hidden: Booleans) -> Array:
        rows = [missing if one is None else row(one) for one in solved]
        return np.where(hidden, np.nan, np.reshape(rows, quality.shape))

    fits = [None if one is None else one.profile.fit for one in solved]
    certain = [np.isfinite(missing) if fit is None else fit.certain for fit in fits]
    weak = ~np.array(certain, dtype=np.bool_).reshape(quality.shape)
    first = np.array([0 if fit is None else fit.first for fit in fits], dtype=np.intp)
    no_slope = weak | ((quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0)
    no_slope |= np.arange(missing.size) < first[:, np.newaxis]

    def budget(
        causes: Sequence[str], row: Callable[[_Solution], dict[str, Array]], hidden: Booleans
    ) -> dict[str, Array]:
        def of(cause: str) -> Array:
            return stacked(lambda one: row(one)[cause], hidden)

        return {cause: of(cause) for cause in causes}

    lidar_ratio = stacked(lambda one: one.lidar_ratio.value, no_slope)
    backscatter = stacked(lambda one: one.backscatter, weak)
    return RamanResult(
        extinction=stacked(lambda one: one.profile.extinction.value, no_slope),
        extinction_budget=budget(EXTINCTION_CAUSES, lambda one: one.extinction_budget, no_slope),
        extinction_smoothing_error=stacked(
            lambda one: one.profile.extinction.smoothing_error, no_slope
        ),
        vertical_resolution=stacked(
            lambda one: one.profile.extinction.vertical_resolution, no_slope
        ),
        backscatter=backscatter,
        backscatter_budget=budget(BACKSCATTER_CAUSES, lambda one: one.backscatter_budget, weak),
        lidar_ratio=lidar_ratio,
        lidar_ratio_random=stacked(lambda one: one.lidar_ratio.random, no_slope),
        lidar_ratio_systematic=stacked(lambda one: one.lidar_ratio.systematic, no_slope),
        raman_depth=stacked(lambda one: one.profile.fit.depth, weak),
        raman_depth_error=stacked(lambda one: one.profile.fit.standard_error, weak),
        reference=window,
        quality=_flags(solved, quality, weak, np.isnan(lidar_ratio), np.isnan(backscatter)),
    )


def _flags(
    solved: Sequence[_Solution | None],
    quality: Flags,
    weak: Booleans,
    no_ratio: Booleans,
    no_backscatter: Booleans,
) -> Flags:
    """Return the quality with the bits of the retrieval."""
    flags = quality.copy()
    partial = (quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0
    flags[partial] |= np.int32(RamanQuality.COMMON_OVERLAP)
    flags[weak] |= np.int32(RamanQuality.WEAK_SIGNAL)
    flags[no_ratio] |= np.int32(RamanQuality.NO_LIDAR_RATIO)
    flags[no_backscatter.all(axis=1)] |= np.int32(RamanQuality.NO_REFERENCE)
    for row, one in enumerate(solved):
        if one is not None:
            flags[row, one.negative] |= np.int32(RamanQuality.NEGATIVE_EXTINCTION)
    return flags


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
        least = COMMON.significant * error * (1.0 + (likely - smooth) / total)
    # Particles neither amplify light nor let it pass: noise makes a ratio that is not positive.
    certain = complete & (smooth > 0.0) & (likely > least) & (ratio > 0.0)
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


# Water vapour --------------------------------------------------------------------------------


def particle_transmission(
    settings: RamanSettings, laser: float, raman: float, wavelength: float
) -> tuple[float, float]:
    r"""Return the transmission of particles at the nitrogen line over that of water vapour.

    That is the exponent of its logarithm per fitted optical depth,
    :math:`(\kappa_W - \kappa) / (1 + \kappa)`, and its standard error by the Ångström exponent.

    Parameters
    ----------
    settings : RamanSettings
    laser, raman, wavelength : float
        m, of the laser, and of the channels of nitrogen and of water vapour.
    """
    nitrogen = particle_ratio(settings.angstrom_exponent, laser, raman)
    water = particle_ratio(settings.angstrom_exponent, laser, wavelength)
    exponent = (water - nitrogen) / (1.0 + nitrogen)
    of_nitrogen = nitrogen * np.log(laser / raman)
    of_water = water * np.log(laser / wavelength)
    slope = (of_water - of_nitrogen - exponent * of_nitrogen) / (1.0 + nitrogen)
    return exponent, float(abs(slope)) * settings.angstrom_standard_error


def mixing_ratio(
    water: CellSignal,
    nitrogen: CellSignal,
    fit: tuple[Array, Array],
    partial: Booleans,
    *,
    constant: float,
    particles: tuple[float, float],
    relative_errors: Sequence[Array | float],
) -> Quotient:
    r"""Return the mixing ratio, with the calibration constant of both channels.

    .. math:: w = C \frac{y_W}{e^{-\theta}} e^{(\kappa_W - \kappa) \tau_p}

    Signals are over those of clean air with equal shares of both gases, so that the transmission of
    air is corrected. The nitrogen signal is the smooth one; in partial overlap, that of the cell,
    so that the overlap cancels.

    Parameters
    ----------
    water, nitrogen : CellSignal
        Over the signals of air at their wavelengths.
    fit : ((cell,) float, (cell,) float)
        Fitted optical depth of the nitrogen signal, up to a constant, and its error by noise.
    partial : (cell,) bool
        Cells without full overlap.
    constant : float
        Calibration constant, kg kg-1 per ratio of the signals.
    particles : (float, float)
        From `particle_transmission`.
    relative_errors : sequence of float or (cell,) float
        Relative standard errors of the constant and of what else all profiles share.

    References
    ----------
    `whiteman2003`.
    """
    depth, error = fit
    nearest = float(depth[np.flatnonzero(np.isfinite(depth))[:1]].sum())
    beyond = depth - nearest
    with np.errstate(divide="ignore", invalid="ignore"):
        own = nitrogen.variance / nitrogen.value**2
    level = np.where(partial, nitrogen.value, np.exp(-depth))
    square = np.where(partial, own, error**2)
    factor = constant * inverse_mean(level, square)
    exponent, spread = particles
    factor *= np.exp(exponent * beyond)
    value = factor * water.value
    background, dead_time, baseline = (
        nitrogen.relative(change, level)
        for change in (nitrogen.background, nitrogen.dead_time, nitrogen.baseline)
    )
    noise = factor**2 * (water.variance + water.background**2)
    noise += value**2 * (square + background**2)
    shared = dead_time**2 + baseline**2 + (spread * beyond) ** 2
    shared += sum(np.square(relative) for relative in relative_errors)
    systematic = np.sqrt(value**2 * shared + factor**2 * (water.dead_time**2 + water.baseline**2))
    return Quotient(value, np.sqrt(noise), systematic)

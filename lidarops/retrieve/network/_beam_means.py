"""Means of the powers of a beam over the profiles of a block, and the deviations from them.

Powers are averaged, not results: these are not linear in noise, so that the mean of results is
biased. Each profile is scaled by its own energy, because that of a laser changes. Outlying bins
that stay in a profile are left out, except where most profiles have them: these are air.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.network._condensed_signals import CleanBeam, FitLayout
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS


@dataclass(frozen=True, slots=True, eq=False)
class ScaledBeam:
    """Powers of one beam in the profiles of a block, over their energies."""

    source: CleanBeam
    factor: Array
    """(bin,) logarithm of range^2 / overlap."""
    power: Array
    """(profile, bin) 0 where left out."""
    variance: Array
    """(profile, bin) 0 where left out."""
    kept: Booleans
    """(profile, bin) False where left out."""
    doubt: Array
    """(profile, bin) logarithmic deviations of outlying bins that are not left out."""
    weight: Array
    """(profile,) of a mean; 0 where a profile is no part of it."""

    def mean(self, shares: Array, stop: int) -> CleanBeam:
        """Return means as profiles of a beam.

        Parameters
        ----------
        shares : (mean, profile) float64
            How much each profile counts, beside its weight.
        stop : int
            The bin behind the last one in use.
        """
        weights, source = shares * self.weight, self.source
        total = weights @ self.kept
        power = weights @ self.power / total
        variance = weights**2 @ self.variance / total**2
        known = (power > 0.0) & np.isfinite(variance)
        logs = np.where(known, source.exponent * (np.log(power) + self.factor), 0.0)
        noise = np.where(known, source.exponent**2 * variance / power**2, 0.0)
        doubt = np.nan_to_num(weights @ self.doubt / total)
        place = source.start + np.arange(known.shape[1])
        lost = ~known & (place >= source.low) & (place < stop)
        stops = np.where(lost.any(axis=1), source.start + np.argmax(lost, axis=1), stop)
        codes = np.where(known, GOOD, LOST).astype(np.uint8)
        return CleanBeam(
            source.number, source.start, source.low, power, variance, logs, noise, doubt, codes,
            stops, np.zeros(len(logs), dtype=np.uint8), source.exponent,
        )  # fmt: skip

    def deviations(self, mean: CleanBeam) -> Array:
        """Return (profile, bin) deviations of logarithms from one mean, or one for each profile."""
        known = self.kept & (mean.codes == GOOD)
        ratio = self.power / np.where(mean.codes == GOOD, mean.power, 1.0)
        return np.where(known, self.source.exponent * (ratio - 1.0), 0.0)

    def noise_ratio(self, mean: CleanBeam) -> Array:
        """Return (profile,) variances of noise over those of a mean, for the bins of each."""
        own, start = self.source.stops - self.source.start, self.source.low - self.source.start
        sums = [
            np.concatenate([np.zeros((len(own), 1)), np.cumsum(values, axis=1)], axis=1)
            for values in (self.variance, self.kept * mean.variance)
        ]
        rows = np.arange(len(own))
        part, whole = (total[rows, own] - total[:, start] for total in sums)
        return np.asarray(part / whole)


def scale(beam: CleanBeam, layout: FitLayout, complete: Booleans, stop: int) -> ScaledBeam:
    """Return the powers of a beam over their energies, with weights for means.

    Parameters
    ----------
    beam : CleanBeam
    layout : FitLayout
    complete : (profile,) bool
        Which profiles may count in a mean.
    stop : int
        The bin behind the last one that a mean uses.
    """
    factor = layout.log_factor[beam.number, beam.start : beam.start + beam.logs.shape[1]]
    power, variance = beam.power, beam.variance
    bridged = beam.codes == BRIDGED
    if bridged.any():
        line = np.exp(beam.logs / beam.exponent - factor)
        power = np.where(bridged, line, power)
        variance = np.where(bridged, beam.noise * (line / beam.exponent) ** 2, variance)
    before = np.arange(power.shape[1]) < (beam.stops - beam.start)[:, np.newaxis]
    known = (beam.codes != LOST) | (before & (power <= 0.0))
    kept = known & (beam.codes != KEPT)
    if not kept[complete].all():
        kept |= known & (2 * kept[complete].sum(axis=0) < complete.sum())
    power, variance = np.where(kept, power, 0.0), np.where(kept, variance, 0.0)
    used = slice(beam.low - beam.start, max(stop, beam.low) - beam.start)
    inside = before & kept
    inside[:, : used.start], inside[:, used.stop :] = False, False
    energy = (power * inside).sum(axis=1)
    if not inside.all(axis=1).all():
        counted = complete & (energy > 0.0)
        first = (power[counted] / energy[counted, np.newaxis]).sum(axis=0) / counted.sum()
        energy = energy / (inside * first).sum(axis=1)
    energy = np.where(energy > 0.0, energy, np.nan)[:, np.newaxis]
    power, variance = power / energy, variance / energy**2
    noise = (variance * inside).sum(axis=1)
    able = complete & np.isfinite(noise) & (noise > 0.0)
    if able.any():
        able &= noise <= THRESHOLDS.noisy_profile * np.median(noise[able])
    weight = np.where(able, 1.0 / np.where(able, noise, 1.0), 0.0)
    doubt = np.where(kept, beam.doubt, 0.0)
    finite = np.isfinite(energy)
    return ScaledBeam(
        beam, factor, np.where(finite, power, 0.0), np.where(finite, variance, 0.0),
        kept & finite, doubt, weight,
    )  # fmt: skip

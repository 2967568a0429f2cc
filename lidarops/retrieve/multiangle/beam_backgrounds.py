"""Backgrounds of the beams of a scan, as far as the beams agree on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.multiangle.optical_depth import MultiAngleResult
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


@dataclass(frozen=True, slots=True)
class ScanSignals:
    r"""Signals of the beams of a scan, and the covariance of their backgrounds.

    A background of beam :math:`l` that is too low by :math:`\delta_l` raises the logarithm of its
    signal by :math:`g_l \delta_l` at every altitude, :math:`g = r^2 / S`.
    """

    signal: Array
    """(time, beam, altitude), range-corrected."""
    noise: Array
    """(time, beam, altitude): variance by noise alone."""
    variance: Array
    """(time, beam, altitude): with which the beams are weighted. With that of noise alone, those of
    an uncertain background would pull the first fit."""
    covariance: Array
    """(time, beam, beam): of the backgrounds, by signal that they may hold."""
    path: Array
    """(beam, altitude): slant over vertical path."""
    response: Array
    """(beam, altitude) m2: mean of the square of range over overlap, the change of the signal per
    change of the background."""
    dead_time_change: Array | None = None
    """(time, beam, altitude): of the signal, with one standard error of the dead time; None for
    analog."""

    @classmethod
    def of(
        cls,
        signal: Array,
        noise: Array,
        left: Array,
        path: Array,
        response: Array,
        dead_time_change: Array | None = None,
    ) -> Self:
        """Return the signals of beams.

        Parameters
        ----------
        signal, noise : (time, beam, altitude) float
        left : (time, beam) float
            Standard error of each background by signal in the far range, of which a part
            (`Thresholds.common_background`, of the variance) is common to all beams; NaN for
            missing beams.
        path, response : (beam, altitude) float
        dead_time_change : (time, beam, altitude) float, optional
        """
        left = np.nan_to_num(left)
        covariance = THRESHOLDS.common_background * left[:, :, np.newaxis] * left[:, np.newaxis]
        covariance += (
            (1.0 - THRESHOLDS.common_background) * left[:, np.newaxis] ** 2 * np.eye(left.shape[1])
        )
        variance = noise + (left[..., np.newaxis] * response) ** 2
        return cls(signal, noise, variance, covariance, path, response, dead_time_change)

    def of_beams(self, beams: Integers) -> Self:
        """Return the signals of some beams."""
        change = self.dead_time_change
        return replace(
            self,
            signal=self.signal[:, beams],
            noise=self.noise[:, beams],
            variance=self.variance[:, beams],
            covariance=self.covariance[:, beams[:, np.newaxis], beams],
            path=self.path[beams],
            response=self.response[beams],
            dead_time_change=None if change is None else change[:, beams],
        )

    def agreed(self, retrieval: MultiAngleResult) -> Self:
        r"""Return the signals with the backgrounds with which the beams agree best.

        With the weights :math:`W` of a fit of :math:`c - 2 x \tau` at each altitude, the matrix
        :math:`Q = W - W X (X'WX)^{-1} X'W` that leaves what no :math:`c` and :math:`\tau` explain,
        the residuals :math:`y`, and the number :math:`q` of altitudes per independent residual,

        .. math:: C' = \Big(C^{-1} + \frac1q \sum_z G Q G\Big)^{-1}, \qquad
                  \delta = \frac1q\,C' \sum_z G Q y, \qquad G = \mathrm{diag}\,g .

        With these backgrounds subtracted, weights of noise alone give the optical depths of
        generalised least squares (`shift` has the rest of their error).

        Parameters
        ----------
        retrieval : MultiAngleResult
            Of these signals.
        """
        lines = self._lines(retrieval)
        weight, change = lines.weight, lines.change
        pull = weight * change
        level = pull / np.sqrt(lines.total)[:, np.newaxis]
        slope = pull * lines.arm / np.sqrt(lines.squares)[:, np.newaxis]
        whole = (pull * change).sum(axis=-1)[:, np.newaxis] * np.eye(pull.shape[1])
        information = whole - sum(part @ np.swapaxes(part, 1, 2) for part in (level, slope))
        misfit = (pull * lines.rest(lines.residual)).sum(axis=-1)
        # Without the backgrounds, which are common to all altitudes.
        background, _ = self._posterior(information, misfit)
        rest = lines.rest(lines.residual - change * background[..., np.newaxis])
        together = _altitudes_together(rest * np.sqrt(weight))
        background, covariance = self._posterior(information / together, misfit / together)
        return replace(
            self,
            signal=self.signal - background[..., np.newaxis] * self.response,
            variance=self.noise,
            covariance=0.5 * (covariance + np.swapaxes(covariance, 1, 2)),
        )

    def _posterior(self, information: Array, misfit: Array) -> tuple[Array, Array]:
        """Return mean and covariance of the backgrounds, from the normal equations of a fit."""
        known = np.eye(len(self.path)) + information @ self.covariance
        covariance = self.covariance @ np.linalg.inv(known)
        return (covariance @ misfit[..., np.newaxis])[..., 0], covariance

    def shift(self, retrieval: MultiAngleResult) -> Array:
        r"""Return the standard error of optical depths by the backgrounds, (time, altitude).

        It is carried by half the weighted regression of :math:`g_l \delta_l` on the slant path.
        """
        lines = self._lines(retrieval)
        pull = 0.5 * lines.weight * lines.arm * lines.change / lines.squares[:, np.newaxis]
        square = np.einsum("tbz,tbc,tcz->tz", pull, self.covariance, pull)
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    def shift_by(self, retrieval: MultiAngleResult, change: Array) -> Array:
        """Return the change of optical depths with one of all signals, (time, altitude).

        Parameters
        ----------
        retrieval : MultiAngleResult
            Of these signals.
        change : (time, beam, altitude) float
        """
        lines = self._lines(retrieval)
        relative = lines.change / self.response * np.nan_to_num(change)
        slope = (lines.weight * lines.arm * np.nan_to_num(relative)).sum(axis=1) / lines.squares
        return np.asarray(-0.5 * slope)

    def _lines(self, retrieval: MultiAngleResult) -> _Lines:
        """Return the samples of a retrieval, and the lines through them."""
        seen = np.isfinite(retrieval.residual)
        scatter = np.nan_to_num(retrieval.inhomogeneity)[:, np.newaxis] ** 2
        expected = self._expected(seen, retrieval.optical_depth, scatter)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            # That of the fit: the noise of the signal would be common to change and residual.
            weight = 1.0 / (self.noise / expected**2 + scatter)
            change, residual = self.response / expected, self.signal / expected - 1.0
            used = seen & np.isfinite(residual * change * weight)
        weight, change, residual = (
            np.where(used, values, 0.0) for values in (weight, change, residual)
        )
        total = _infinite_where_zero(weight.sum(axis=1))
        arm = self.path - ((weight * self.path).sum(axis=1) / total)[:, np.newaxis]
        squares = _infinite_where_zero((weight * arm**2).sum(axis=1))
        return _Lines(weight, change, residual, arm, total, squares)

    def _expected(self, seen: Booleans, optical_depth: Array, scatter: Array) -> Array:
        """Return the signals that fit best to the optical depths; NaN where there are none.

        The intercepts of single altitudes do not belong to the optical depths of a profile: where
        few beams are left, together they would give signals off by many orders of magnitude.
        """
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            share = np.exp(-2.0 * self.path * optical_depth[:, np.newaxis])
            expected = np.zeros_like(share)
            # First without inhomogeneity, which is relative to the expected signal.
            for _ in range(2):
                variance = self.noise + scatter * expected**2
                product = np.where(seen, share * self.signal / variance, 0.0).sum(axis=1)
                square = np.where(seen, share**2 / variance, 0.0).sum(axis=1)
                expected = share * (product / square)[:, np.newaxis]
            return np.where(expected > 0.0, expected, np.nan)


class _Lines(NamedTuple):
    """Weighted straight lines over the slant path at each altitude of each cycle."""

    weight: Array
    """(time, beam, altitude): 0 where there is no sample."""
    change: Array
    """Of the logarithm, per background."""
    residual: Array
    """Of the signal, relative to the expected one."""
    arm: Array
    """Path about its mean."""
    total: Array
    """(time, altitude): sum of the weights; infinite where there is none."""
    squares: Array
    """(time, altitude): weighted squares of the arms; infinite where there is none."""

    def rest(self, values: Array) -> Array:
        """Return values minus their line."""
        weighted = self.weight * values
        level = weighted.sum(axis=1) / self.total
        slope = (weighted * self.arm).sum(axis=1) / self.squares
        line = level[:, np.newaxis] + slope[:, np.newaxis] * self.arm
        return np.asarray(np.where(self.weight > 0.0, values - line, 0.0))


def _infinite_where_zero(values: Array) -> Array:
    return np.asarray(np.where(values > 0.0, values, np.inf))


def _altitudes_together(scaled: Array) -> float:
    """Return the number of altitudes per independent residual, of residuals of unit variance."""
    both = (scaled[..., 1:] != 0.0) & (scaled[..., :-1] != 0.0)
    squares = np.where(both, scaled[..., 1:] ** 2 + scaled[..., :-1] ** 2, 0.0).sum()
    products = (scaled[..., 1:] * scaled[..., :-1]).sum()
    correlation = np.clip(
        2.0 * products / squares if squares else 0.0, 0.0, THRESHOLDS.most_correlated
    )
    return float((1.0 + correlation) / (1.0 - correlation))

"""Thresholds of the elastic retrieval, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Limits of the inversion."""

    longest_gap: float = 150.0
    """m; a longer gap without data ends the integration. Assumed."""
    least_denominator: float = 0.05
    """Share of the denominator at the reference. Beyond, errors grow as its inverse. Assumed."""
    least_certainty: float = 5.0
    """Standard errors by which the denominator must exceed zero for first-order errors to hold.
    Simulations, with `skewed`."""
    skewed: float = 5.5
    """Ratio s of the denominator to its noise error at which noise errors are twice those of first
    order. A reference that is too high by noise makes both values and errors too low, so noise
    errors are multiplied by 0.98 + (5.5 / s)^3 where that exceeds 1. Simulations: less than 0.1 %
    of the values are then off by more than 4 errors, without it 1 to 3 % where s is 5 to 8."""
    negative: float = 4.0
    """Standard errors below zero at which backscatter contradicts the signal. Manaus, 355 nm, with
    an overlap that is not full where it was stated to be: 57 standard errors."""
    negative_bins: int = 4
    """Bins in a row that must be that low, so that noise alone is none. Assumed."""
    largest_backscatter: float = 5e-4
    """m-1 sr-1; a check of units: air scatters less than a tenth of this at 0.25 micrometres."""


THRESHOLDS: Final = Thresholds()

"""Choice of the reference window: where a profile has the shape of particle-free air."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen
from lidarops.retrieve.elastic import _window_tests

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Codes = npt.NDArray[np.int32]

FEWEST_BINS: Final = 8
LEAST_SHARE: Final = 0.5
"""Share of the bins of a window that must hold data."""
_MOST_WINDOWS: Final = 10_000


class Rejection(IntFlag):
    """Reason for which a candidate window is rejected."""

    TOO_FEW_BINS = 1 << 0
    """Fewer than 8 bins, or less than half of the window, hold data."""
    EXCLUDED = 1 << 1
    """A layer or another excluded bin lies in the window."""
    LOW_SIGNAL = 1 << 2
    """The signal-to-noise ratio of the mean of the window is too low."""
    SLOPE = 1 << 3
    """The ratio to the air changes linearly along the window."""
    CURVATURE = 1 << 4
    """The ratio to the air is curved along the window."""
    SCATTER = 1 << 5
    """The ratio to the air scatters more than its noise explains."""
    MORE_PARTICLES = 1 << 6
    """Another window that passes all tests has a lower ratio to the air."""


@dataclass(frozen=True, slots=True)
class ReferenceWindow:
    """The chosen window of each profile, with the leading axes of the power.

    Where no candidate passes, floats are NaN and `index` is -1.
    """

    chosen: Mask
    bottom: Array
    """m."""
    top: Array
    """m."""
    index: npt.NDArray[np.int64]
    """Index of the chosen candidate."""
    scale: Array
    """Power over the molecular shape, averaged over the window with inverse variances."""
    scale_standard_error: Array
    slope: Array
    """Slope of the logarithm of the power over the molecular shape, m-1."""
    slope_standard_error: Array
    curvature: Array
    """Curvature of the ratio to the molecular shape, in standard errors."""
    reduced_chi_square: Array
    """Reduced chi-square of the power against the molecular shape alone."""
    rejections: Codes
    """(..., candidate): bits of `Rejection`; 0 for the chosen one and those equally clean."""

    @property
    def edges(self) -> tuple[Array, Array]:
        """Bottom and top in m, the `reference` of `inversion.invert_elastic`."""
        return self.bottom, self.top


def candidate_windows(lowest: float, highest: float, width: float, step: float) -> Array:
    """Return windows of equal width at regular steps.

    Parameters
    ----------
    lowest, highest : float
        m; all windows lie between them.
    width, step : float
        m.

    Returns
    -------
    (candidate, 2) float
        m, bottom and top.

    Raises
    ------
    RetrievalInputError
        Where no window fits, or more than 10 000 do.
    """
    numbers = np.array([lowest, highest, width, step], dtype=np.float64)
    if not np.all(np.isfinite(numbers)) or width <= 0 or step <= 0 or highest - lowest < width:
        raise RetrievalInputError(
            f"no window of {width:g} m, moved by {step:g} m, fits between {lowest:g} and"
            f" {highest:g} m",
            field="candidates",
            remedy="give m, with the width and step positive",
        )
    count = np.floor((highest - lowest - width) / step + 1e-9) + 1
    if count > _MOST_WINDOWS:
        raise RetrievalInputError(
            f"makes {count:.0f} windows", field="step", remedy="give a larger step in m"
        )
    bottom = lowest + step * np.arange(int(count))
    return np.stack([bottom, bottom + width], axis=-1)


def choose_reference(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    molecular_attenuated: npt.ArrayLike,
    candidates: npt.ArrayLike,
    exclude: npt.NDArray[np.bool_] | None = None,
    most_deviation: float = 3.0,
    least_signal: float = 20.0,
) -> ReferenceWindow:
    r"""Return the cleanest window; of equally clean ones, the best determined.

    In each candidate the power is fitted with the molecular shape :math:`\phi` by weighted
    least squares: :math:`P = \phi (a_0 + a_1 p_1(R) + a_2 p_2(R))`, with polynomials that are
    orthogonal under the noise, so the three tests are independent. A candidate passes where

    - at least 8 bins and half of the window hold data, and none is excluded;
    - :math:`a_0` exceeds `least_signal` of its standard errors;
    - :math:`a_1` and :math:`a_2` are below `most_deviation` of theirs;
    - chi-square of the power against :math:`\phi a_0` is less than `most_deviation` standard
      deviations above its mean (as Gaussian: :math:`\chi^2/\nu < 1 + k \sqrt{2/\nu}`).

    The anchor is the passing window with the lowest upper bound of :math:`a_0`, at
    `most_deviation` standard errors. Windows whose :math:`a_0` differs from it by less than
    `most_deviation` standard errors of the difference count as equally clean. Of these, the one
    with the smallest standard error of :math:`a_0` is chosen, the nearest one in a tie. That
    error follows from the variances and not from the power, so the choice favours no
    fluctuation. The tests favour one slightly, because they keep windows whose noise looks flat.
    In simulations the scale of the chosen window is 0.1 standard errors too low (where `variance`
    is not estimated from the noisy power itself). Particles raise it by less than 3 standard
    errors in 95 percent of layered profiles: no test of shape detects a thin layer that the
    noise hides. Include this in the error of the reference.

    Parameters
    ----------
    power : (..., range) float
        Any unit, background subtracted; NaN where missing.
    range : (range,) float
        m.
    variance : (..., range) float
        Noise variance in the square of the power's unit, broadcast against `power`.
    molecular_attenuated : (..., range) float
        The shape :math:`\phi = \beta_m T_m^2 / R^2` times any constant, broadcast against
        `power`.
    candidates : (candidate, 2) float
        m, bottom and top of each window; see `candidate_windows`.
    exclude : (..., range) bool, optional
        Bins that no window may contain, such as the mask of `layers.find_layers`.
    most_deviation : float
        Largest deviation from the molecular shape, in standard errors.
    least_signal : float
        Least signal-to-noise ratio of the mean of a window.

    Returns
    -------
    ReferenceWindow
        No window is chosen where no candidate passes; `rejections` gives the reasons.

    Raises
    ------
    RetrievalInputError
        For invalid arguments, among them candidates outside the range.
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    shape = inputs.noise_rows(molecular_attenuated, "molecular_attenuated", grid, leading)
    if not np.all(shape >= 0.0) or np.any(np.isinf(shape)):
        raise RetrievalInputError(
            "is negative or not finite",
            field="molecular_attenuated",
            remedy="give a value for each bin",
        )
    if not (most_deviation > 0.0 and least_signal > 0.0):
        raise RetrievalInputError(
            "must be positive", field="most_deviation" if least_signal > 0.0 else "least_signal"
        )
    windows, edges = _edges(candidates, grid)
    statistics = np.full((rows.shape[0], windows.shape[0], _window_tests.FIELDS), np.nan)
    _window_tests.compare_with_air(
        frozen(rows),
        frozen(inputs.variance_rows(variance, grid, leading)),
        frozen(shape),
        frozen(grid.values),
        frozen(_excluded(exclude, grid, leading)),
        edges,
        statistics,
    )
    rejections = _rejections(statistics, np.diff(edges)[:, 0], most_deviation, least_signal)
    index = _pick(statistics, rejections, most_deviation)
    return _result(statistics, rejections, index, windows, leading)


def _edges(
    candidates: npt.ArrayLike, grid: inputs.RangeGrid
) -> tuple[Array, npt.NDArray[np.int64]]:
    windows = inputs.real_array(candidates, "candidates").astype(np.float64)
    if windows.ndim == 1:
        windows = windows[np.newaxis]
    if windows.ndim != 2 or windows.shape[1] != 2 or windows.shape[0] == 0:
        raise RetrievalInputError(
            f"has the shape {windows.shape}", field="candidates", remedy="give (candidate, 2) in m"
        )
    if not np.all(np.isfinite(windows)) or not np.all(windows[:, 0] < windows[:, 1]):
        raise RetrievalInputError(
            "holds windows that are not finite or end before they begin", field="candidates"
        )
    first = np.searchsorted(grid.values, windows[:, 0], side="left")
    stop = np.searchsorted(grid.values, windows[:, 1], side="right")
    if not np.any(stop > first):
        raise RetrievalInputError(
            f"hold no bin of the range, which reaches from {grid.values[0]:g} to"
            f" {grid.values[-1]:g} m",
            field="candidates",
        )
    return windows, np.stack([first, stop], axis=-1).astype(np.int64)


def _excluded(
    exclude: npt.NDArray[np.bool_] | None, grid: inputs.RangeGrid, leading: tuple[int, ...]
) -> Mask:
    if exclude is None:
        return np.zeros((1, grid.size), dtype=np.bool_)
    mask = np.asarray(exclude)
    if mask.dtype != np.bool_:
        raise RetrievalInputError(f"holds {mask.dtype}, not booleans", field="exclude")
    return inputs.noise_rows(mask.astype(np.float64), "exclude", grid, leading) > 0.0


def _rejections(
    statistics: Array, lengths: npt.NDArray[np.int64], most_deviation: float, least_signal: float
) -> Codes:
    """Return the bits of `Rejection` of each window; 0 for those that pass all tests."""
    f = np.moveaxis(statistics, -1, 0)
    count = np.nan_to_num(f[_window_tests.COUNT])
    freedom = np.maximum(count - 1.0, 1.0)
    fewest = np.maximum(FEWEST_BINS, LEAST_SHARE * lengths)
    passes = {
        Rejection.TOO_FEW_BINS: count >= fewest,
        Rejection.EXCLUDED: ~(f[_window_tests.EXCLUDED_BINS] > 0.0),
        Rejection.LOW_SIGNAL: f[_window_tests.SCALE] >= least_signal * f[_window_tests.SCALE_ERROR],
        Rejection.SLOPE: np.abs(f[_window_tests.SLOPE])
        <= most_deviation * f[_window_tests.SLOPE_ERROR],
        Rejection.CURVATURE: np.abs(f[_window_tests.CURVATURE]) <= most_deviation,
        Rejection.SCATTER: f[_window_tests.SCATTER]
        <= 1.0 + most_deviation * np.sqrt(2.0 / freedom),
    }
    rejections = np.zeros(count.shape, dtype=np.int32)
    for reason, passed in passes.items():
        rejections[~passed] |= np.int32(reason)
    # Too few bins do not define a shape; the tests of the shape do not apply.
    has_few_bins = (rejections & np.int32(Rejection.TOO_FEW_BINS)) != 0
    rejections[has_few_bins] &= np.int32(Rejection.TOO_FEW_BINS | Rejection.EXCLUDED)
    return rejections


def _pick(statistics: Array, rejections: Codes, most_deviation: float) -> npt.NDArray[np.int64]:
    """Return the index of the chosen window or -1; mark those with more particles as rejected."""
    scale, error = statistics[..., _window_tests.SCALE], statistics[..., _window_tests.SCALE_ERROR]
    passed = rejections == 0
    upper = np.where(passed, scale + most_deviation * error, np.inf)
    anchor = np.argmin(upper, axis=-1)[:, np.newaxis]
    lowest = np.take_along_axis(scale, anchor, axis=-1)
    lowest_error = np.take_along_axis(error, anchor, axis=-1)
    has_more_particles = passed & (scale - lowest > most_deviation * np.hypot(error, lowest_error))
    rejections[has_more_particles] |= np.int32(Rejection.MORE_PARTICLES)
    precision = np.where(rejections == 0, error, np.inf)
    best = np.argmin(precision, axis=-1)
    return np.where(np.any(passed, axis=-1), best, -1).astype(np.int64)


def _result(
    statistics: Array,
    rejections: Codes,
    index: npt.NDArray[np.int64],
    windows: Array,
    leading: tuple[int, ...],
) -> ReferenceWindow:
    chosen = index >= 0
    rows = np.arange(index.size)

    def chosen_value(field: int) -> Array:
        return np.where(chosen, statistics[rows, index, field], np.nan).reshape(leading)

    return ReferenceWindow(
        chosen=chosen.reshape(leading),
        bottom=np.where(chosen, windows[index, 0], np.nan).reshape(leading),
        top=np.where(chosen, windows[index, 1], np.nan).reshape(leading),
        index=index.reshape(leading),
        scale=chosen_value(_window_tests.SCALE),
        scale_standard_error=chosen_value(_window_tests.SCALE_ERROR),
        slope=chosen_value(_window_tests.SLOPE),
        slope_standard_error=chosen_value(_window_tests.SLOPE_ERROR),
        curvature=chosen_value(_window_tests.CURVATURE),
        reduced_chi_square=chosen_value(_window_tests.SCATTER),
        rejections=rejections.reshape(*leading, windows.shape[0]),
    )

"""Fit the background of a profile whose far range is free of aerosol, by the molecular shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import _shape_fit
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Flags, Integers, frozen
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON

_UNKNOWN: Final = frozen(np.full(1, np.nan))
_ENDLESS: Final = frozen(np.full(1, np.inf))
"""Ends of a window that are not given."""


@dataclass(frozen=True, slots=True)
class KnownShapeResult:
    """Background and amplitude of every profile, with their errors, tests and quality bits."""

    background: Array
    """In the unit of the power; NaN where there is none."""
    background_standard_error: Array
    """Of random noise, and of the choice of the window where there is more than one."""
    amplitude: Array
    """Power over shape."""
    amplitude_standard_error: Array
    """Of random noise."""
    chi2: Array
    """Sum of the squared residuals over their variances."""
    degrees_of_freedom: Integers
    """Bins less 2, at least 0."""
    allowed: Integers
    """Bins from the first one of the window on that may be used, if their power is known."""
    condition: Array
    """Standard error of the background over that of the mean of the same bins: 1 where the shape
    dies away in the window, infinite where it cannot be distinguished from a constant."""
    curvature: Array
    """Slope along range of the residuals relative to the shape, in standard errors; positive
    where the signal falls less steeply than the shape."""
    waves: Array
    """Chi-square of the mean residuals of blocks of the window; the expectation is 12 for the 14
    blocks of a given window or of the longest one, and 2 less for each shorter one."""
    start: Array
    """m, range of the first bin of the window."""
    stop: Array
    """m, range of the last bin of the window."""
    poor_fit: Booleans
    """The residuals vary systematically along range: the window is not free of aerosol, the
    shape is not that of the air, or the noise is not white along range."""
    singular: Booleans
    """The window is too short for the shape to differ from a constant
    (`Thresholds.largest_condition`); use another method."""
    quality: Flags
    """INPUT_MISSING, TOO_FEW_BINS, NO_SIGNAL (all bins of a window equal, which noise never gives;
    not for counts), NEGATIVE_AMPLITUDE, NOT_HOMOGENEOUS (where `poor_fit`)."""


def molecular_shape(
    backscatter: npt.ArrayLike,
    extinction: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
) -> Array:
    r"""Return the signal of clear air up to a constant factor.

    .. math:: \varphi(R) = \frac{\beta(R)}{R^2} \exp\left(-2 \int_0^R \alpha \, dr\right)

    by trapezoids from the first bin on; nearer, the extinction is that of the first bin.

    Parameters
    ----------
    backscatter : (..., range) float
        m-1 sr-1.
    extinction : (..., range) float
        m-1.
    range : (range,) float
        m.

    Returns
    -------
    (..., range) float
        m-3 sr-1.

    References
    ----------
    vasylkivskyi2009
    """
    beta = inputs.real_array(backscatter, "backscatter").astype(np.float64)
    alpha = inputs.real_array(extinction, "extinction").astype(np.float64)
    grid = inputs.range_grid(range)
    depth = np.empty(alpha.shape)
    depth[..., :1] = alpha[..., :1] * grid[0]
    slices = 0.5 * (alpha[..., 1:] + alpha[..., :-1]) * np.diff(grid)
    depth[..., 1:] = depth[..., :1] + np.cumsum(slices, axis=-1)
    return np.asarray(beta * np.exp(-2.0 * depth) / grid**2)


def fit_known_shape(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    shape: npt.ArrayLike,
    *,
    variance: npt.ArrayLike | None = None,
    exposure: npt.ArrayLike | None = None,
    start: npt.ArrayLike | None = None,
    stop: npt.ArrayLike | None = None,
    mask: Booleans | None = None,
) -> KnownShapeResult:
    r"""Fit background and amplitude of a signal whose shape is known, by weighted least squares.

    .. math:: P(R) = b + C \varphi(R), \qquad
              C = \frac{\sum w (\varphi - \bar\varphi)(P - \bar P)}
                       {\sum w (\varphi - \bar\varphi)^2}, \qquad
              b = \bar P - C \bar\varphi

    with weighted means and :math:`w = 1 / v`. This is equation (4) of potapova2021 with the
    molecular shape in place of that of a homogeneous path. There is no iteration.

    All sums are those of 14 equal blocks of the longest window. The variance of counts is that of
    the fitted model, :math:`v = (b + C \bar\varphi) / E` with the mean shape of a block, from two
    fits of the same sums. Weights from the counts themselves would follow their noise and bias the
    background low.

    Parameters
    ----------
    power : (..., range) float
        Any unit; bins that are not finite are skipped.
    range : (range,) float
        m.
    shape : (..., range) float
        Any unit, broadcast against `power`; bins where it is not positive and finite are
        skipped. See `molecular_shape`.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`. It must not
        follow the noise of the single bin. Either it or `exposure` is required.
    exposure : (...) float, optional
        For Poisson counts: counts per unit of power. That is the number of shots where power is
        a mean count per shot, and shots times bin time in microseconds where it is in MHz.
    start, stop : (...) float, optional
        m, ends of the window. Where `start` is not given, five windows are tried: from
        `Thresholds.nearest_start` of the farthest usable range on, and without the first one to
        four sevenths of its bins. The result is that of the longest window whose residuals show
        neither curvature nor waves and whose background agrees with those of all shorter windows
        (each at `Thresholds.rejection`), else that of the shortest.
    mask : (..., range) bool, optional
        True where a bin may be used; broadcast against `power`.

    Returns
    -------
    KnownShapeResult
        With the leading axes of `power`. The standard errors cover random noise. Where windows
        are tried, that of the background also covers aerosol that the tests may miss: it is the
        root mean square about the chosen background over all windows that pass the tests, each
        weighted by the odds that the far range is clean from its start on
        (`Thresholds.aerosol_odds`). They do not cover an error of the shape, which `curvature`
        and `waves` show only where it exceeds the noise.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    potapova2021, golub1973
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    rows = frozen(rows.astype(np.float64, copy=False))
    air = inputs.noise_rows(shape, "shape", grid, leading)
    counts = _exposures(variance, exposure, leading)
    noise = inputs.noise_rows(variance, "variance", grid, leading, negative=False)
    usable = np.ones((1, grid.size), dtype=np.bool_)
    if mask is not None:
        usable = inputs.broadcast(mask, (*leading, grid.size), "mask").reshape(-1, grid.size)
    edges = (
        _UNKNOWN if start is None else frozen(inputs.profile_values(start, "start", leading)),
        _ENDLESS if stop is None else frozen(inputs.profile_values(stop, "stop", leading)),
    )
    if np.any(edges[0] > grid[-1]):
        raise RetrievalInputError(
            f"lies beyond the range, which ends at {grid[-1]:g} m", field="start"
        )
    limits = _limits(THRESHOLDS.rejection, _shape_fit.WINDOWS if start is None else 1)
    out = np.full(len(rows), np.nan, _shape_fit.ROW)
    # Squares of shapes and of powers must stay in the range of floats together.
    unit = np.max(air, axis=-1, keepdims=True, initial=0.0, where=(air > 0.0) & (air < HUGE))
    unit = np.where(unit > 0.0, unit, 1.0)
    given = frozen(air / unit), frozen(noise), frozen(usable), counts
    _shape_fit.fit_shape(rows, given, frozen(grid), edges, limits, out)
    if exposure is not None:
        # In the dark, a whole window may be without a count.
        out["constant"] = 0.0
    return inputs.with_leading_axes(_result(out, grid, unit[:, 0]), leading)


def _exposures(
    variance: npt.ArrayLike | None, exposure: npt.ArrayLike | None, leading: tuple[int, ...]
) -> Array:
    """Return counts per unit of power, (profile or 1,); 0 where variances are given."""
    if (variance is None) == (exposure is None):
        raise RetrievalInputError(
            "is given for counts" if exposure is not None else "is missing",
            field="variance",
            remedy="give the exposure of counts, else the variance",
        )
    if exposure is None:
        return frozen(np.zeros(1))
    counts = inputs.profile_values(exposure, "exposure", leading)
    if np.any(counts <= 0):
        raise RetrievalInputError(
            "is not positive", field="exposure", remedy="mask profiles without shots"
        )
    return frozen(counts)


@cache
def _limits(false_alarm: float, windows: int) -> _shape_fit.Limits:
    """Return the limits of waves and curvature for a joint rate of false alarms."""
    rate = 0.5 * false_alarm
    freedom = _shape_fit.BLOCKS - _shape_fit.STEP * np.arange(windows) - 2.0
    return _shape_fit.Limits(
        nearest=THRESHOLDS.nearest_start,
        waves=frozen(special.chdtri(freedom, rate)),
        deviation=float(-special.ndtri(0.5 * rate)),
        aerosol=THRESHOLDS.aerosol_odds,
    )


def _result(out: npt.NDArray[np.void], grid: Array, unit: Array) -> KnownShapeResult:
    """Return the fits of the kernel, with shapes in a unit, as a result of (profile,)."""
    fit = {name: np.ascontiguousarray(out[name]) for name in _shape_fit.ROW.names or ()}
    bins, condition = fit["bins"], fit["condition"]
    amplitude_error = np.sqrt(fit["amplitude_variance"]) / unit
    amplitude = fit["amplitude"] / unit
    limits = _limits(COMMON.misfit_false_alarm, _shape_fit.WINDOWS)
    poor = np.abs(fit["curvature"]) > limits.deviation
    poor |= fit["waves"] > limits.waves[fit["window"].astype(np.intp)]
    few, empty = bins < COMMON.fewest_bins, bins == 0
    quality = np.zeros(len(out), dtype=np.int32)
    for bit, found in (
        (Quality.INPUT_MISSING, empty),
        (Quality.TOO_FEW_BINS, few & ~empty),
        (Quality.NO_SIGNAL, ~few & (fit["constant"] > 0)),
        (Quality.NEGATIVE_AMPLITUDE, amplitude < -COMMON.significant * amplitude_error),
        (Quality.NOT_HOMOGENEOUS, poor),
    ):
        quality[found] |= np.int32(bit)
    first, past = (np.where(empty, 1, fit[name]).astype(np.intp) for name in ("first", "past"))
    return KnownShapeResult(
        background=fit["background"],
        background_standard_error=np.sqrt(fit["background_variance"]),
        amplitude=amplitude,
        amplitude_standard_error=amplitude_error,
        chi2=fit["chi2"],
        degrees_of_freedom=np.maximum(bins - 2, 0).astype(np.int64),
        allowed=fit["allowed"].astype(np.int64),
        condition=condition,
        curvature=fit["curvature"],
        waves=fit["waves"],
        start=np.where(empty, np.nan, grid[first]),
        stop=np.where(empty, np.nan, grid[past - 1]),
        poor_fit=poor,
        singular=~(condition <= THRESHOLDS.largest_condition) & ~empty,
        quality=quality,
    )

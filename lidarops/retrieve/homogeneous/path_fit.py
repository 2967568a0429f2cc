"""Fit background, amplitude and extinction of a homogeneous path: the public entry point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.background.cubic_and_tail import BackgroundResult, solve_cubic
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import HUGE, Array, Flags, frozen
from lidarops.retrieve.homogeneous import _direct
from lidarops.retrieve.homogeneous._fit_quality import curved_widening, judge_fit
from lidarops.retrieve.homogeneous._problem import (
    COLUMNS,
    CONSTANT,
    FITTED,
    ROW,
    HomogeneousResult,
    PathEstimate,
    PathProblem,
)
from lidarops.retrieve.homogeneous._projection import make_grid
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.signal.thresholds import THRESHOLDS as SIGNAL

__all__ = ["HomogeneousMethod", "HomogeneousResult", "Noise", "fit_homogeneous_path"]


class HomogeneousMethod(StrEnum):
    """Methods to solve a homogeneous path."""

    DIRECT = "direct"
    CUBIC = "cubic"
    LINEARIZED = "linearized"
    KNOWN_BACKGROUND = "known_background"
    KNOWN_EXTINCTION = "known_extinction"


_TAKES: Final = {
    "extinction": {HomogeneousMethod.LINEARIZED, HomogeneousMethod.KNOWN_EXTINCTION},
    "background": {HomogeneousMethod.KNOWN_BACKGROUND},
    "background_standard_error": {HomogeneousMethod.KNOWN_BACKGROUND},
    "lag": {HomogeneousMethod.CUBIC},
}
"""Arguments that only these methods accept."""
_REQUIRED: Final = ("extinction", "background")
"""Of these, those that they require."""


class Noise(NamedTuple):
    """What is known of the noise beside its variance."""

    relative: bool = False
    """Whether the variance is known up to a common factor only, which the residuals of each profile
    give: for a variance that is estimated from the same data."""
    correlation_length: npt.ArrayLike = 1.0
    """(...) float, bins, at least 1; the integral correlation length
    (`lidarops.retrieve.signal.noise_correlation`), 1 where bins are independent."""
    exposure: npt.ArrayLike | None = None
    """(...) float, of Poisson counts: counts per unit of power, as for
    `lidarops.retrieve.background.known_shape.fit_known_shape`. With few counts, the limits of
    OUTLIER and POOR_FIT are those of Poisson noise of the given variance, which is required."""


_INDEPENDENT: Final = Noise()


def fit_homogeneous_path(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    variance: npt.ArrayLike | None = None,
    noise: Noise = _INDEPENDENT,
    method: str = "direct",
    extinction: npt.ArrayLike | None = None,
    background: npt.ArrayLike | None = None,
    background_standard_error: npt.ArrayLike | None = None,
    lag: int | None = None,
) -> HomogeneousResult:
    r"""Return background, amplitude and extinction of a homogeneous path.

    .. math:: P(R) = P^* + B R^{-2} e^{-2 \sigma R}

    Parameters
    ----------
    power : (..., range) float
        Any unit. Bins that are not finite are excluded.
    range : (range,) float
        m, positive and ascending, in any spacing.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`; a scalar
        holds for every bin. Bins whose variance is zero or not finite are excluded. For counts,
        give that of a mean profile: variances from the counts of the profile itself bias the fit.
    noise : Noise, optional
    method : str
        One of the methods of the notes below.
    extinction : (...) float, optional
        m-1. The prior of "linearized"; taken as exact by "known_extinction".
    background : (...) float, optional
        For "known_background", in the unit of the power.
    background_standard_error : (...) float, optional
        Of the given background, which must not come from the same bins; 0 where not given.
    lag : int, optional
        Of "cubic": bins between those of a triple, by default that of
        `lidarops.retrieve.background.cubic`.

    Returns
    -------
    HomogeneousResult
        Without a `variance`, or with a relative one, the noise is estimated from second
        differences of the residuals along range and scales the standard errors; with n bins they
        have 0.51 (n - 2) degrees of freedom. They are widened by Student's distribution, so that
        1.96 of them hold 95 percent: by 1 percent at 225 bins, 5 at 50, 15 at 20, and 60 at 8. No
        factor can also hold the normal share of values within 4 of them: beyond are 0.03 percent at
        50 bins, 0.12 at 20 and 0.7 at 8. NOISE_UNCERTAIN marks values from fewer than 32 bins.

        With a correlation length s, standard errors are sqrt(s) times those of independent bins,
        and where s exceeds 1, noise is estimated from second differences of bins a twentieth of
        the section apart, at most 10 (`Thresholds.most_correlated_bins` of the signal chain).

        Bits of `quality` and their limits: ``docs/algorithms/homogeneous.md``. A constant profile
        raises NO_SIGNAL: its value is the background, the amplitude is 0 and the extinction NaN.
        Fewer than 4 bins give NaN.

        Each profile is solved on its own: a result does not depend on the other profiles.

    Raises
    ------
    RetrievalInputError
        For invalid shapes, units or values, or arguments that the method does not accept.

    Notes
    -----
    direct
        The least-squares solution by Newton steps over the bins, with background and amplitude
        eliminated (variable projection, golub1973), from the best of every third of 24 extinctions
        and its neighbours.
    cubic
        The background of `lidarops.retrieve.background.cubic` (bobrovsky2024, equations (8) and
        (12) to (16), corrected there),
        then a fit of amplitude and extinction above it. It needs no start value and no search,
        but a uniform range without gaps and a signal that starts well above the noise. Its
        scatter is larger than the least possible one, as its standard errors state.
    linearized
        Linear least squares for three unknowns about a prior extinction, equation (3) of
        potapova2021:

        .. math:: P \approx P^* + [B + G (R - R_c)] R^{-2} e^{-2 \sigma_0 R},
            \qquad \sigma = \sigma_0 - G / 2B

        Three linear equations, one Gauss-Newton step of the full problem, for a prior known to
        some percent, such as from a neighbouring profile. The standard errors include an estimate
        of the neglected second-order term. R_c is the centroid of information, where B and G are
        independent. The paper expands about R_c = 0, where B is extrapolated.
    known_background
        Amplitude and extinction above a given background, by converged least squares; equation
        (5) of potapova2021, in two unknowns, is one step of it. For a background that is measured
        separately, such as before the laser fires. The error of the background is propagated.
    known_extinction
        Background and amplitude by linear least squares at a given extinction, equation (4) of
        potapova2021, weighted here. The extinction counts as exact, with a standard error of 0; the
        other errors are conditional on it.

    References
    ----------
    golub1973; bobrovsky2024; potapova2021.

    Examples
    --------
    >>> import numpy as np
    >>> distance = np.arange(2500.0, 10500.0, 37.5)
    >>> power = 370.0 + 6.25e9 / distance**2 * np.exp(-2 * 3e-5 * distance)
    >>> float(np.round(fit_homogeneous_path(power, distance).extinction, 12))
    3e-05
    """
    chosen_method = inputs.choice(method, HomogeneousMethod, "method")
    _check_arguments(
        chosen_method,
        {
            "extinction": extinction,
            "background": background,
            "background_standard_error": background_standard_error,
            "lag": lag,
        },
    )
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    stated = 0.0 if background_standard_error is None else background_standard_error
    error = inputs.profile_values(stated, "background_standard_error", leading)
    if np.any(error < 0):
        raise RetrievalInputError("is negative", field="background_standard_error")
    length = float(grid[-1] - grid[0]) if grid.size > 1 else 1.0
    known_variance = variance is not None and not noise.relative
    given = np.full(1, np.nan)
    if extinction is not None:
        given = _known_extinction(extinction, length, leading)
    elif background is not None:
        given = inputs.profile_values(background, "background", leading)
    correlation_length, exposure = _noise_of_profiles(noise, leading, known_variance=known_variance)
    problem = PathProblem(
        power=rows,
        range=grid,
        noise=inputs.noise_rows(variance, "variance", grid, leading, negative=False),
        known_variance=known_variance,
        bounds=(
            THRESHOLDS.lowest_extinction / float(grid[-1]),
            THRESHOLDS.highest_optical_depth / length,
        ),
        correlation_length=correlation_length,
        given=given,
        background_variance=error**2,
        exposure=exposure,
        lag=lag,
    )
    return inputs.with_leading_axes(_SOLVERS[chosen_method](problem), leading)


def _noise_of_profiles(
    noise: Noise, leading: tuple[int, ...], *, known_variance: bool
) -> tuple[Array, Array | None]:
    """Return correlation length and exposure, (profile or 1,)."""
    name = "noise.correlation_length"
    correlated = inputs.profile_values(noise.correlation_length, name, leading)
    if np.any(correlated < 1):
        raise RetrievalInputError("is less than 1 bin", field=name)
    if noise.exposure is None:
        return correlated, None
    counted = inputs.profile_values(noise.exposure, "noise.exposure", leading)
    if not (known_variance and np.all(counted > 0)):
        raise RetrievalInputError(
            "is not positive, or given without variance",
            field="noise.exposure",
            remedy="give counts per unit of power with the variance of the counts",
        )
    return correlated, counted


def _known_extinction(extinction: npt.ArrayLike, length: float, leading: tuple[int, ...]) -> Array:
    """Return the prior or known extinction in m-1, (profile or 1,)."""
    prior = inputs.profile_values(extinction, "extinction", leading)
    limit = THRESHOLDS.largest_optical_depth / length
    if np.any(np.abs(prior) > limit):
        raise RetrievalInputError(
            f"holds values up to {np.max(np.abs(prior)):g} m-1: it must be in m-1",
            field="extinction",
            remedy=f"stay within +-{limit:g} m-1"
            f" ({THRESHOLDS.largest_optical_depth:g} over the length)",
        )
    return prior


def _check_arguments(method: HomogeneousMethod, given: Mapping[str, object]) -> None:
    for name, value in given.items():
        methods = _TAKES[name]
        if value is not None and method not in methods:
            raise RetrievalInputError(
                f"is not accepted by the method {str(method)!r}",
                field=name,
                remedy=f"leave it out, or choose {' or '.join(sorted(methods))}",
            )
        if value is None and name in _REQUIRED and method in methods:
            raise RetrievalInputError(f"is required by the method {str(method)!r}", field=name)


_NOTHING: Final = np.zeros(1, dtype=np.int32)


def solve_by_direct_fit(problem: PathProblem) -> HomogeneousResult:
    """Solve by least squares for all three unknowns."""
    return _solution(_estimate(problem, problem.given), problem)


def solve_by_linearization(problem: PathProblem) -> HomogeneousResult:
    """Solve by one linear step from the prior extinction."""
    fit = _estimate(problem, problem.given, _direct.PRIOR)
    # What one step neglects is about what another one would add.
    shifts = (fit.background_shift, fit.amplitude_shift, fit.extinction_shift)
    with np.errstate(over="ignore", invalid="ignore"):
        added = tuple(shift**2 for shift in shifts)
    return _solution(fit, problem, added=added)


def solve_with_known_extinction(problem: PathProblem) -> HomogeneousResult:
    """Solve for background and amplitude at the given extinction."""
    fit = _estimate(problem, problem.given, _direct.EXTINCTION)
    return _solution(fit, problem, unknowns=2)


def solve_with_known_background(problem: PathProblem) -> HomogeneousResult:
    """Solve for amplitude and extinction above the given background."""
    fit, variance = _estimate(problem, problem.given), problem.background_variance
    with np.errstate(over="ignore", invalid="ignore"):
        by_slopes = (variance * slope**2 for slope in (fit.amplitude_slope, fit.extinction_slope))
        added = (variance, *by_slopes)
    return _solution(fit, problem, unknowns=2, added=added)


def solve_by_cubic(problem: PathProblem) -> HomogeneousResult:
    """Take the background from the cubic and propagate its error into the other parameters."""
    estimate, gradients = solve_cubic(
        problem.power,
        problem.range,
        problem.lag,
        problem.noise,
        known_variance=problem.known_variance,
        want_gradients=True,
    )
    return _fit_above(problem, estimate, gradients)


def _fit_above(
    problem: PathProblem, estimate: BackgroundResult, gradients: Array
) -> HomogeneousResult:
    """Fit amplitude and extinction above a background that depends on the same power.

    `gradients`, (profile or 1, bin), are the derivatives of the background by the power, through
    which noise is propagated to first order.
    """
    background, near = estimate.background, problem.range[0]
    fit = _estimate(problem, background)
    length, middle = np.ptp(problem.range), 0.5 * (near + problem.range[-1])
    with np.errstate(all="ignore"):
        weights = _weights(problem)
        decay = np.exp(-2.0 * fit.extinction[:, np.newaxis] * problem.range)
        signal = fit.amplitude[:, np.newaxis] * decay / problem.range**2
        pull = weights * signal
        norm, lever = (pull * signal).sum(axis=-1), -2.0 * problem.range
        lever = lever - ((lever * pull * signal).sum(axis=-1) / norm)[:, np.newaxis]
        centroid = np.asarray(near + 0.5 * lever[:, 0])
        # Without the background, then through it.
        extinction = lever * pull / (lever**2 * pull * signal).sum(axis=-1)[:, np.newaxis]
        logarithm = pull / norm[:, np.newaxis] + 2.0 * centroid[:, np.newaxis] * extinction
        extinction = extinction + fit.extinction_slope[:, np.newaxis] * gradients
        logarithm = logarithm + fit.amplitude_slope[:, np.newaxis] * gradients
        used = weights > 0.0
        bent = np.where(used, gradients * signal, 0.0) * (problem.range - middle) ** 2
        bend = bent.sum(axis=-1) / length
        variance = np.where(used, 1.0 / weights, 0.0)
    fit = replace(
        fit,
        status=np.where(np.isnan(background), np.nan, fit.status),
        background=background,
        background_variance=(gradients**2 * variance).sum(axis=-1),
        background_slope_variance=np.zeros(1),
        amplitude_relative_variance=(logarithm**2 * variance).sum(axis=-1),
        extinction_variance=(extinction**2 * variance).sum(axis=-1),
        background_bend=bend,
        extinction_bend=fit.extinction_bend + fit.extinction_slope * bend,
    )
    return _solution(fit, problem, quality=estimate.quality)


def _weights(problem: PathProblem) -> Array:
    """Return the weights of all bins, 0 of those that are left out."""
    weights = 1.0 / problem.noise
    usable = (np.abs(problem.power) < HUGE) & (weights > 0.0) & (weights < HUGE)
    return np.where(usable, weights, 0.0)


def _estimate(problem: PathProblem, given: Array, kind: int = _direct.BACKGROUND) -> PathEstimate:
    """Fit the profiles with what is given beside them."""
    record = np.empty(1, ROW)
    columns = np.empty((len(COLUMNS), problem.power.shape[0]))
    # Second differences over more than a twentieth of a section would hold its misfit.
    widest = min(SIGNAL.most_correlated_bins, problem.range.size // 20)
    spacing = np.where(problem.correlation_length > 1.0, max(widest, 1), 1).astype(np.int64)
    grid = make_grid(problem.range.tobytes(), problem.bounds)
    # Relative rounding of the power and of the kernels, as a standard deviation.
    rounding = 0.3 * float(np.finfo(problem.power.dtype).eps) + 8.0 * float(np.finfo(float).eps)
    noise = (frozen(problem.noise), problem.known_variance, rounding, frozen(spacing))
    _direct.solve_path(
        frozen(problem.power),
        noise,
        frozen(given),
        kind,
        grid,
        (record, record.view(float), columns),
    )
    return PathEstimate(*columns)


def _solution(
    fit: PathEstimate,
    problem: PathProblem,
    *,
    unknowns: int = 3,
    quality: Flags = _NOTHING,
    added: tuple[Array, ...] = (np.zeros(1),) * 3,
) -> HomogeneousResult:
    """Judge an estimate and return the solution.

    `added` are variances from sources other than the noise of the fit: of the background, of the
    logarithm of the amplitude, and of the extinction.
    """
    of_background, of_amplitude, of_extinction = added
    verdict = judge_fit(fit, problem, unknowns=unknowns, added_variance=of_extinction)
    length = problem.correlation_length
    fitted, constant = fit.status == FITTED, fit.status == CONSTANT
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        level = verdict.noise * verdict.widening**2 * length
        curved = fit.background_slope_variance * (
            curved_widening(verdict.relative_error) ** 2 - 1.0
        )
        background_variance = fit.background_variance + np.where(fitted, curved, 0.0)
        background_error = np.sqrt(background_variance * level + of_background)
        relative_error = np.sqrt(fit.amplitude_relative_variance * level + of_amplitude)
        extinction_error = np.sqrt(fit.extinction_variance * level + of_extinction)
        amplitude_error = np.abs(fit.amplitude) * relative_error

    known = constant & problem.known_variance
    departure = THRESHOLDS.model_error * (np.abs(fit.extinction) + 1.0 / fit.mean_range)
    # A signal bent by c (x - 1/2)^2 has slopes of -c and c over the length at its ends.
    background_model = 2.0 * departure * np.abs(fit.background_bend)
    extinction_model = departure * np.hypot(1.0, 2.0 * np.abs(fit.extinction_bend))
    return HomogeneousResult(
        background=np.where(fitted | constant, fit.background, np.nan),
        background_standard_error=np.where(fitted | known, background_error, np.nan),
        background_model_error=np.where(fitted, background_model, np.nan),
        amplitude=np.where(constant, 0.0, np.where(fitted, fit.amplitude, np.nan)),
        amplitude_standard_error=np.where(fitted, amplitude_error, np.nan),
        extinction=np.where(fitted, fit.extinction, np.nan),
        extinction_standard_error=np.where(fitted, extinction_error, np.nan),
        extinction_model_error=np.where(fitted, extinction_model, np.nan),
        reduced_chi2=np.where(fitted, verdict.reduced_chi2, np.nan),
        valid_bins=fit.bins.astype(np.int32),
        quality=verdict.quality | quality,
    )


_SOLVERS: Final[dict[HomogeneousMethod, Callable[[PathProblem], HomogeneousResult]]] = {
    HomogeneousMethod.DIRECT: solve_by_direct_fit,
    HomogeneousMethod.CUBIC: solve_by_cubic,
    HomogeneousMethod.LINEARIZED: solve_by_linearization,
    HomogeneousMethod.KNOWN_BACKGROUND: solve_with_known_background,
    HomogeneousMethod.KNOWN_EXTINCTION: solve_with_known_extinction,
}

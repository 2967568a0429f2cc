"""Fit background, amplitude and extinction of a homogeneous path: the public entry point."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.background import photon_counts
from lidarops.retrieve.background.cubic_and_tail import Statistics
from lidarops.retrieve.common import inputs
from lidarops.retrieve.homogeneous import _methods, _robust, _routing, _sections
from lidarops.retrieve.homogeneous._problem import (
    Array,
    Centre,
    Flags,
    PathProblem,
    PathSolution,
)

LOWEST_EXTINCTION: Final = -0.3
"""Default lower bound, over the far end of the section. Where extinction approaches
-1 / range, the shape stops falling and a second minimum appears."""
HIGHEST_OPTICAL_DEPTH: Final = 60.0
"""Default upper bound, over the length of the section: the signal vanishes after two bins."""
MODEL_ERROR: Final = 0.05
"""Default relative error of the slope of the model: a share of extinction + 1 / mean range."""
_LARGEST_OPTICAL_DEPTH: Final = 300.0
"""Beyond this, the exponential leaves the range of floats."""


class HomogeneousMethod(StrEnum):
    """Methods to solve a homogeneous path."""

    AUTO = "auto"
    COMPRESSED = "compressed"
    FAST = "fast"
    DIRECT = "direct"
    CUBIC = "cubic"
    LINEARIZED = "linearized"
    KNOWN_BACKGROUND = "known_background"
    KNOWN_EXTINCTION = "known_extinction"
    TAIL_MEAN = "tail_mean"


_SOLVERS: Final[dict[HomogeneousMethod, Callable[[PathProblem], PathSolution]]] = {
    HomogeneousMethod.AUTO: _routing.compressed,
    HomogeneousMethod.COMPRESSED: _routing.compressed,
    HomogeneousMethod.FAST: _routing.fast,
    HomogeneousMethod.DIRECT: _methods.solve_by_direct_fit,
    HomogeneousMethod.CUBIC: _methods.solve_by_cubic,
    HomogeneousMethod.LINEARIZED: _methods.solve_by_linearization,
    HomogeneousMethod.KNOWN_BACKGROUND: _methods.solve_with_known_background,
    HomogeneousMethod.KNOWN_EXTINCTION: _methods.solve_with_known_extinction,
    HomogeneousMethod.TAIL_MEAN: _methods.solve_by_tail_mean,
}

_NEEDS: Final[dict[str, set[HomogeneousMethod]]] = {
    "extinction": {HomogeneousMethod.LINEARIZED, HomogeneousMethod.KNOWN_EXTINCTION},
    "background": {HomogeneousMethod.KNOWN_BACKGROUND},
}
"""Arguments that these methods require and no other accepts."""
_TAKES: Final[dict[str, set[HomogeneousMethod]]] = {
    "background_standard_error": {HomogeneousMethod.KNOWN_BACKGROUND},
    "centre": {HomogeneousMethod.LINEARIZED},
    "lag": {HomogeneousMethod.CUBIC},
    "tail_start": {HomogeneousMethod.TAIL_MEAN},
}
"""Arguments that only these methods accept."""


@dataclass(frozen=True, slots=True)
class HomogeneousResult:
    """Parameters of a homogeneous path, with the leading axes of the power.

    If sections are given, they are the last axis.

    Standard errors are conditional on the model. A change of the profile along the model's own
    shapes leaves no trace in the residuals: backscatter that decreases along the path as
    ``exp(-R / H)`` mimics an extinction of 1 / (2 H), on a vertical path as on any other.
    `extinction_model_error` and `background_model_error` allow for that, separately from the
    random error; they are not bounds. For random violations of every size (``lidarops bench
    stability``), this share of unflagged values differs from the truth by more than 4 combined
    errors:

    ==========================================  ==========  ==========
    violation                                   extinction  background
    ==========================================  ==========  ==========
    backscatter exp(-R / H), H of 1 to 100 km   7 %         0.5 %
    plume                                       10 %        1.1 %
    top of the signal cut off                   8 %         0.1 %
    backscatter that bends                      2.5 %       5 %
    afterpulse                                  0.5 %       2.4 %
    incomplete overlap                          0.5 %       0.01 %
    eddies                                      0.1 %       0.4 %
    detector not linear                         0.1 %       0.02 %
    ==========================================  ==========  ==========

    Most of these leave little trace. Cases in which the misfit due to the violation is 5 standard
    deviations of the noise or more are at most 0.3 % of all unflagged values (0.6 % where the top
    is cut off). A test that knows the shape of a violation, but not its sign, with the same rate
    of false alarms, misses 7 % at 5 standard deviations, half at 3.5 and nearly all at 1.
    """

    background: Array
    """P*, in the unit of the power."""
    background_standard_error: Array
    """In the unit of the power; random error only."""
    background_model_error: Array
    """In the unit of the power: first-order change of the background by a signal whose logarithmic
    slope departs from the model at both ends of the section, with opposite signs, as where
    backscatter bends along the path. The departure is `model_error` times the slope at mean range,
    2 (absolute extinction + 1 / mean range)."""
    amplitude: Array
    """B of ``P = P* + B R^-2 exp(-2 extinction R)``, in the unit of the power times m2."""
    amplitude_standard_error: Array
    """To first order. B is extrapolated to range zero: above some 30 percent, the interval holds
    for the logarithm of B rather than for B."""
    extinction: Array
    """m-1."""
    extinction_standard_error: Array
    """m-1; random error only."""
    extinction_model_error: Array
    """m-1; `model_error` times (absolute extinction + 1 / mean range), for the departure of the
    slope of `background_model_error` all along the section, and, in quadrature, the first-order
    change of extinction by the bend there. The second term dominates where extinction and
    background are hard to separate."""
    signal_to_noise: Array
    """Amplitude over its standard error at known extinction, with the sign of the amplitude."""
    reduced_chi2: Array
    """1 where the residuals are noise; relative to the estimated noise without a variance."""
    curvature_misfit: Array
    """Energy of the residuals in smooth shapes that the model lacks, over the noise: a chi-square
    of the compressed methods; NaN for the others."""
    valid_bins: Flags
    """Bins used."""
    quality: Flags
    """Bits of `lidarops.flags.Quality`; 0 where no test failed."""


def fit_homogeneous_path(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    variance: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    method: str = "auto",
    extinction_bounds: tuple[float, float] | None = None,
    extinction: npt.ArrayLike | None = None,
    background: npt.ArrayLike | None = None,
    background_standard_error: npt.ArrayLike | None = None,
    centre: str | None = None,
    lag: int | None = None,
    tail_start: float | None = None,
    statistics: str = "gauss",
    shots: npt.ArrayLike | None = None,
    sections: Sequence[tuple[float, float]] | None = None,
    robust_passes: int = 0,
    model_error: float = MODEL_ERROR,
) -> HomogeneousResult:
    r"""Return background, amplitude and extinction of a homogeneous path.

    .. math:: P(R) = P^* + B R^{-2} e^{-2 \sigma R}

    Parameters
    ----------
    power : (..., range) float
        Any unit. Bins that are not finite are excluded.
    range : (range,) float
        m, positive, in any strict order and spacing.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`; a scalar
        holds for every bin. Bins whose variance is zero or not finite are excluded.
    weights : (..., range) float, optional
        Inverse variances up to a common factor, in place of `variance`. Bins whose weight is
        not positive and finite are excluded.
    method : str
        One of the methods of the notes below.
    extinction_bounds : (float, float), optional
        Lowest and highest extinction in m-1; -0.3 / (last range) and 60 / (last - first range)
        where not given. The lower bound excludes a second, unphysical minimum near -1 / (last
        range), which is too narrow to be found reliably; it is negative so that noise about
        zero is not clipped.
    extinction : (...) float, optional
        m-1. The prior of "linearized"; taken as exact by "known_extinction".
    background : (...) float, optional
        For "known_background", in the unit of the power.
    background_standard_error : (...) float, optional
        Of the given background, which must not come from the same bins; 0 where not given.
    centre : {"centroid", "zero"}, optional
        The range about which "linearized" expands; the centroid of information where not given.
    lag : int, optional
        Of "cubic"; `lidarops.retrieve.background.cubic_and_tail.default_lag` where not given.
    tail_start : float, optional
        m; "tail_mean" averages the bins from here on, the last tenth where not given.
    statistics : {"gauss", "poisson"}
        "poisson" means that `power` is mean counts per shot. Weights are then required, from a
        mean profile (`lidarops.retrieve.background.mean_profile_variance`): weights from the
        counts of the profile itself bias the fit, and weights pooled over the profiles of a call
        would make a result depend on its neighbours.
    shots : (...) float, optional
        Number of shots of which `power` is the mean count; 1 where not given. Requires
        "poisson".
    sections : sequence of (float, float), optional
        m; each section holds the bins with near <= R < far and is solved on its own. Sections
        are the last axis of the result.
    robust_passes : int
        How often to exclude bins that deviate by more than 4 standard deviations of the noise
        and fit again; 2 suffice for a cloud or spikes. Excluded bins raise OUTLIER. The standard
        deviation is at least that of the median deviation, so that a bad fit does not exclude
        most of its bins. Not with "cubic", which allows no gaps.
    model_error : float
        Departure of the logarithmic slope of the signal from the model, as a share of
        2 (absolute extinction + 1 / mean range), both all along the section and at its ends with
        opposite signs; `extinction_model_error` and `background_model_error` follow from it.

    Returns
    -------
    HomogeneousResult
        Without `variance`, the noise is estimated from second differences of the residuals
        along range and scales the standard errors; with n bins they have 0.51 (n - 2) degrees
        of freedom. They are widened by Student's distribution, so that 4 standard errors have the
        coverage of a known variance: by 4 percent at 225 bins, 20 at 50, 70 at 20, and by a factor
        of 7.6 at 8.

        A result is valid (no bit raised) if the signal exceeds 5 standard errors (else
        LOW_SIGNAL), the standard error of extinction is below 15 percent of extinction
        + 1 / mean range (POORLY_DETERMINED), the amplitude is positive (NEGATIVE_AMPLITUDE) and
        the extinction is not at a bound (AT_BOUND). Three further tests have a false-alarm rate
        of 4e-4 each: the reduced chi-square is within the limits for its degrees of freedom
        (POOR_FIT), the residuals do not contain the shapes of backscatter that bends along the
        path or of a nonlinear detector (NOT_HOMOGENEOUS), and none exceeds 5 standard deviations
        (OUTLIER). Fewer than 8 bins raise TOO_FEW_BINS, fewer than 4 give NaN; none raises
        INPUT_MISSING. A constant profile raises NO_SIGNAL: its value is the background, the
        amplitude is 0 and the extinction NaN.

        Each profile is solved on its own: a result does not depend on the other profiles.

    Raises
    ------
    RetrievalInputError
        For invalid shapes, units or values, or arguments that the method does not accept.

    Notes
    -----
    auto
        "compressed".
    compressed
        The least-squares solution from 11 linear functionals of the profile, which hold all but
        a millionth of its information on extinction: within 0.01 standard errors of "direct" in
        a fifteenth of its time. (Where a weak signal vanishes within some bins, at an optical
        depth of 40, one profile in 10,000 was half a standard error apart.) It applies to
        profiles without gaps on a uniform range of at most 4096 bins with common weights: its
        tables need 15 kB per bin while they are made. Other profiles are solved by Newton steps
        over their bins, within 1e-4 standard errors of "direct"; sections of less than 32 bins
        by "direct". Here NOT_HOMOGENEOUS tests `curvature_misfit`, the energy of the residuals
        in the functionals, and their projection on the square of the shape, each at half the
        rate of false alarms.
    fast
        The same from 7 functionals: up to 0.4 percent more scatter, within 0.3 standard errors
        of "direct". With a known variance, residuals are not computed: no `reduced_chi2`, no
        POOR_FIT, no OUTLIER.
    direct
        The least-squares solution by a fixed number of closed-form steps: the best of 24
        extinctions with background and amplitude eliminated (variable projection, golub1973),
        the peak of a parabola through it, then seven Newton steps. It accepts gaps, weights and
        any spacing, and reaches the least possible scatter.
    cubic
        The background of `lidarops.retrieve.background.cubic` (bobrovsky2024, corrected there),
        then a fit of amplitude and extinction above it. It needs no start value and no search,
        but a uniform range without gaps and a signal that starts well above the noise. Its
        scatter is 1.3 to 3 times the least possible one, as its standard errors state.
    linearized
        Linear least squares for three unknowns about a prior extinction (potapova2021):

        .. math:: P \approx P^* + [B + G (R - R_c)] R^{-2} e^{-2 \sigma_0 R},
            \qquad \sigma = \sigma_0 - G / 2B

        Three linear equations, one Gauss-Newton step of the full problem, for a prior known to
        some percent, such as from a neighbouring profile. The standard errors include an estimate
        of the neglected second-order term. By default R_c is the centroid of information, where
        B and G are independent. The paper expands about R_c = 0 (centre="zero"), where B is
        extrapolated: from a prior 20 percent low, the error is 6 to 8 times larger at strong
        extinction, about the same at weak extinction. There the estimate of the neglected term
        is also too small: with priors off by up to a factor of 2, 1 to 3 percent of the unflagged
        values are off by more than 4 standard errors, against 0.01 percent about the centroid.
    known_background
        Amplitude and extinction above a given background, by converged least squares; equation
        (5) of the paper, in two unknowns, is one step of it. For a background that is measured
        separately, such as before the laser fires: at weak extinction, the scatter is 3 to 11
        times less than with three unknowns. The error of the background is propagated.
    known_extinction
        Background and amplitude by linear least squares at a given extinction, equation (4) of
        the paper, weighted here. The extinction counts as exact, with a standard error of 0; the
        other errors are conditional on it. The paper puts this background into (5) and reports
        that two unknowns are more accurate than three. This holds only if the background does
        not come from the same profile; otherwise alternating the two steps converges slowly to
        the least-squares solution, with its errors.
    tail_mean
        Background as the mean of the far bins, then as "known_background", with its noise
        propagated. For comparison only: signal that remains in the tail biases the background
        by many standard errors, which POOR_FIT detects only in part. For random paths, a third
        of the unflagged values are off by more than 4 standard errors.

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
            "centre": centre,
            "lag": lag,
            "tail_start": tail_start,
        },
    )
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    noise, known_variance = _noise(variance, weights, grid, leading)
    error = inputs.profile_values(background_standard_error, "background_standard_error", leading)
    if error is not None and np.any(error < 0):
        raise RetrievalInputError("is negative", field="background_standard_error")
    problem = PathProblem(
        power=rows,
        range=grid.values,
        noise=noise,
        common_noise=np.ndim(np.asarray(weights if variance is None else variance)) <= 1,
        known_variance=known_variance,
        bounds=(np.nan, np.nan),
        extinction=_prior(extinction, grid.values, leading),
        background=inputs.profile_values(background, "background", leading),
        background_variance=None if error is None else error**2,
        shots=_shots(
            statistics, shots, rows, leading, weighted=variance is not None or weights is not None
        ),
        lag=lag,
        centre=inputs.choice(centre or Centre.CENTROID, Centre, "centre"),
        tail_start=tail_start,
    )
    solver = _robust.RobustSolver(_SOLVERS[chosen_method], _passes(robust_passes, chosen_method))
    solutions = [
        solver(problem.cut(bins, _bounds(extinction_bounds, grid.values[bins])))
        for bins in _sections.section_bins(sections, grid.values)
    ]
    shape = leading if sections is None else (*leading, len(solutions))
    return _result(solutions, shape, _share(model_error))


def _noise(
    variance: npt.ArrayLike | None,
    weights: npt.ArrayLike | None,
    grid: inputs.RangeGrid,
    leading: tuple[int, ...],
) -> tuple[Array, bool]:
    if variance is None:
        return inputs.noise_rows(weights, "weights", grid, leading), False
    if weights is not None:
        raise RetrievalInputError(
            "is given together with variance", field="weights", remedy="give one of the two"
        )
    return inputs.variance_rows(variance, grid, leading), True


def _shots(
    statistics: str,
    shots: npt.ArrayLike | None,
    power: inputs.Floats,
    leading: tuple[int, ...],
    *,
    weighted: bool,
) -> Array | None:
    """Return the shots of each profile, None for Gaussian noise."""
    if inputs.choice(statistics, Statistics, "statistics") is Statistics.GAUSS:
        if shots is not None:
            raise RetrievalInputError(
                "is given for Gaussian noise", field="shots", remedy="choose statistics='poisson'"
            )
        return None
    if not weighted:
        raise RetrievalInputError(
            "is missing for counts",
            field="variance",
            remedy="give mean_profile_variance(power, shots) of the whole block",
        )
    return photon_counts.checked_shots(power, shots, leading)


def _prior(
    extinction: npt.ArrayLike | None, range_: Array, leading: tuple[int, ...]
) -> Array | None:
    values = inputs.profile_values(extinction, "extinction", leading)
    limit = _LARGEST_OPTICAL_DEPTH / _length(range_)
    if values is not None and np.any(np.abs(values) > limit):
        raise RetrievalInputError(
            f"holds values up to {np.max(np.abs(values)):g} m-1: it must be in m-1",
            field="extinction",
            remedy=f"stay within +-{limit:g} m-1 (300 over the length)",
        )
    return values


def _check_arguments(method: HomogeneousMethod, given: Mapping[str, object]) -> None:
    for name, value in given.items():
        methods = (_NEEDS | _TAKES)[name]
        if value is not None and method not in methods:
            raise RetrievalInputError(
                f"is not accepted by the method {str(method)!r}",
                field=name,
                remedy=f"leave it out, or choose {' or '.join(sorted(methods))}",
            )
        if value is None and name in _NEEDS and method in methods:
            raise RetrievalInputError(f"is required by the method {str(method)!r}", field=name)


def _passes(passes: int, method: HomogeneousMethod) -> int:
    if not isinstance(passes, int | np.integer) or passes < 0:
        raise RetrievalInputError(
            f"is {passes!r}", field="robust_passes", remedy="give 0, 1, 2 or more passes"
        )
    if passes and method is HomogeneousMethod.CUBIC:
        raise RetrievalInputError(
            f"is {passes}, but the cubic allows no gaps",
            field="robust_passes",
            remedy="choose another method",
        )
    return int(passes)


def _share(model_error: float) -> float:
    if not isinstance(model_error, int | float | np.number) or not (
        np.isfinite(model_error) and model_error >= 0
    ):
        raise RetrievalInputError(
            f"is {model_error!r}", field="model_error", remedy="give a fraction, such as 0.05"
        )
    return float(model_error)


def _result(
    solutions: Sequence[PathSolution], shape: tuple[int, ...], model_error: float
) -> HomogeneousResult:
    columns = {
        field.name: _stacked([getattr(solution, field.name) for solution in solutions]).reshape(
            shape
        )
        for field in fields(PathSolution)
    }
    departure = model_error * (np.abs(columns["extinction"]) + 1.0 / columns.pop("mean_range"))
    bend = {name: np.abs(columns.pop(f"{name}_bend")) for name in ("background", "extinction")}
    return HomogeneousResult(
        **columns,
        # A signal bent by c (x - 1/2)^2 has slopes of -c and c over the length at its ends.
        background_model_error=2.0 * departure * bend["background"],
        extinction_model_error=departure * np.hypot(1.0, 2.0 * bend["extinction"]),
    )


def _stacked(columns: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    return columns[0] if len(columns) == 1 else np.stack(columns, axis=-1)


def _length(range_: Array) -> float:
    return float(range_[-1] - range_[0]) if range_.size > 1 else 1.0


def _bounds(bounds: tuple[float, float] | None, range_: Array) -> tuple[float, float]:
    length = _length(range_)
    if bounds is None:
        return LOWEST_EXTINCTION / float(range_[-1]), HIGHEST_OPTICAL_DEPTH / length
    limit = _LARGEST_OPTICAL_DEPTH / length
    pair = inputs.real_array(bounds, "extinction_bounds")
    lowest, highest = pair.tolist() if pair.shape == (2,) else (np.nan, np.nan)
    if not -limit <= lowest < highest <= limit:
        raise RetrievalInputError(
            f"is {bounds} m-1",
            field="extinction_bounds",
            remedy=f"give two ascending values within +-{limit:g} m-1 (300 over the length)",
        )
    return lowest, highest

"""Background, amplitude and extinction of a homogeneous path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve import _cubic, _direct, _inputs
from lidarops.retrieve._verdict import Estimate, judge
from lidarops.retrieve.background import solve_cubic

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

LOWEST_EXTINCTION: Final = -0.3
"""Default lower bound, over the far end of the section. Where extinction approaches
-1 / range, the shape stops falling and a second minimum appears."""
HIGHEST_OPTICAL_DEPTH: Final = 60.0
"""Default upper bound, over the length of the section: the signal is gone after two bins."""
_LARGEST_OPTICAL_DEPTH: Final = 300.0
"""Beyond this the exponential leaves the numbers that a computer has."""


class Method(StrEnum):
    """Ways to solve a homogeneous path."""

    AUTO = "auto"
    DIRECT = "direct"
    CUBIC = "cubic"


@dataclass(frozen=True, slots=True)
class HomogeneousResult:
    """What a homogeneous path was found to be, with the leading axes of the power.

    Standard errors are conditional on the model. What changes the profile along the model's own
    shapes leaves no trace in the residuals: backscatter that falls along the path as
    ``exp(-R / H)`` is taken for 1 / (2 H) of extinction, on a vertical path as on any other.
    """

    background: Array
    """P*, in the unit of the power."""
    background_standard_error: Array
    amplitude: Array
    """B of ``P = P* + B R^-2 exp(-2 extinction R)``, in the unit of the power times m2."""
    amplitude_standard_error: Array
    extinction: Array
    """m-1."""
    extinction_standard_error: Array
    reduced_chi2: Array
    """1 where the residuals are noise; relative to the estimated noise without a variance."""
    valid_bins: Flags
    quality: Flags
    """Bits of `lidarops.flags.Quality`; 0 where no test failed."""


@dataclass(frozen=True, slots=True)
class _Problem:
    power: _inputs.Floats
    """(profile, bin)."""
    range: Array
    """m, ascending."""
    noise: Array
    """(profile or 1, bin): variances or relative weights."""
    known_variance: bool
    bounds: tuple[float, float]
    """m-1."""


@dataclass(frozen=True, slots=True)
class _Solution:
    estimate: Estimate
    quality: Flags
    """What the solver itself has to say."""


def solve(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    variance: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    method: str = "auto",
    extinction_bounds: tuple[float, float] | None = None,
) -> HomogeneousResult:
    r"""Find background, amplitude and extinction of a homogeneous path.

    .. math:: P(R) = P^* + B R^{-2} e^{-2 \sigma R}

    Parameters
    ----------
    power : (..., range) float
        Any unit. Bins that are not finite are left out of the fit.
    range : (range,) float
        m, positive, in any strict order and spacing.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`; a scalar
        holds for every bin. Bins whose variance is zero or not finite are left out.
    weights : (..., range) float, optional
        Inverse variances up to a common factor, in place of `variance`. Bins whose weight is
        not positive and finite are left out.
    method : {"auto", "direct", "cubic"}
        "direct" is the least-squares solution by a fixed number of closed-form steps: the best
        of 24 extinctions with background and amplitude eliminated (variable projection), the
        vertex of a parabola through it, five Newton steps. It takes gaps, weights and any
        spacing, and reaches the least possible scatter. "cubic" takes the background of
        `lidarops.retrieve.background.cubic`, then fits amplitude and extinction to what is
        above it; it needs a uniform range without gaps and scatters 1.3 to 3 times as much,
        with standard errors that say so. "auto" chooses "direct".
    extinction_bounds : (float, float), optional
        Lowest and highest extinction in m-1; -0.3 / (last range) and 60 / (last - first range)
        where not given. The lower one keeps a second, unphysical minimum near -1 / (last
        range) out; it is negative so that noise about zero is not clipped.

    Returns
    -------
    HomogeneousResult
        Without `variance`, the noise is estimated from second differences of the residuals
        along range and scales the standard errors; with n bins they have 0.51 (n - 2) degrees
        of freedom, which matters below some 50 bins.

        A result stands (no bit raised) when the signal is more than 5 times its standard error
        (else LOW_SIGNAL), the standard error of extinction less than 15 percent of extinction
        + 1 / mean range (POORLY_DETERMINED), the amplitude positive (NEGATIVE_AMPLITUDE) and
        the extinction off its bounds (AT_BOUND); when the reduced chi-square is within what
        its degrees of freedom allow (POOR_FIT), the residuals are free of the shapes of
        backscatter that bends along the path and of a detector that is not linear
        (NOT_HOMOGENEOUS), and none is beyond 5 standard deviations (OUTLIER); each of these
        three at a false-alarm rate of 5e-4. Fewer than 8 bins are TOO_FEW_BINS, fewer than 4
        give NaN; none at all is INPUT_MISSING. A constant profile is NO_SIGNAL: its value is
        the background, the amplitude is 0 and the extinction NaN.

        Each profile is solved on its own: a result does not depend on what else is in `power`.

    Raises
    ------
    RetrievalInputError
        For arguments whose shapes, units or values cannot be right.

    References
    ----------
    golub1973 (variable projection); bobrovsky2024 (cubic); potapova2023 (linearised step, here
    about the centroid of information, not about range zero).

    Examples
    --------
    >>> import numpy as np
    >>> distance = np.arange(2500.0, 10500.0, 37.5)
    >>> power = 370.0 + 6.25e9 / distance**2 * np.exp(-2 * 3e-5 * distance)
    >>> float(np.round(solve(power, distance).extinction, 12))
    3e-05
    """
    grid = _inputs.range_grid(range)
    rows, leading = _inputs.profiles(power, grid)
    if variance is not None and weights is not None:
        raise RetrievalInputError(
            "is given together with variance", field="weights", remedy="give one of the two"
        )
    if variance is not None:
        noise = _inputs.variance_rows(variance, grid, leading)
    else:
        noise = _inputs.noise_rows(weights, "weights", grid, leading)
    problem = _Problem(
        power=rows,
        range=grid.values,
        noise=noise,
        known_variance=variance is not None,
        bounds=_bounds(extinction_bounds, grid.values),
    )
    solution = _SOLVERS[_method(method)](problem)
    return _result(solution, problem, leading)


def _solve_direct(problem: _Problem) -> _Solution:
    background = np.full(1, np.nan)
    return _Solution(_estimate(problem, background), np.zeros(1, dtype=np.int32))


def _solve_cubic(problem: _Problem) -> _Solution:
    """Take the background from the cubic and propagate its error into the rest."""
    with np.errstate(divide="ignore"):
        variance = problem.noise if problem.known_variance else 1.0 / problem.noise
    found, gradients = solve_cubic(
        problem.power,
        problem.range,
        None,
        variance,
        known_variance=problem.known_variance,
        want_gradients=True,
    )
    fit = _estimate(problem, found.background)
    errors = np.empty((fit.extinction.size, 3))
    _cubic.propagate(
        np.ascontiguousarray(fit.extinction),
        np.ascontiguousarray(fit.amplitude),
        problem.range,
        variance,
        gradients,
        errors,
    )
    fit = replace(
        fit,
        status=np.where(np.isnan(found.background), np.nan, fit.status),
        background=found.background,
        background_variance=errors[:, 0],
        amplitude_relative_variance=errors[:, 1],
        extinction_variance=errors[:, 2],
    )
    return _Solution(fit, found.quality)


def _estimate(problem: _Problem, background: Array) -> Estimate:
    """Run the kernel, with the background fitted where `background` is NaN."""
    table = np.full((problem.power.shape[0], len(_direct.COLUMNS)), np.nan)
    # Half a unit in the last place, as a standard deviation, and what the kernel itself loses.
    rounding = 0.3 * np.finfo(problem.power.dtype).eps + 8.0 * np.finfo(np.float64).eps
    _direct.solve_profiles(
        problem.power,
        problem.noise,
        problem.known_variance,
        background,
        float(rounding),
        _direct.make_grid(problem.range, problem.bounds),
        table,
    )
    return Estimate(**dict(zip(_direct.COLUMNS, table.T, strict=True)))


_SOLVERS: Final[dict[Method, Callable[[_Problem], _Solution]]] = {
    Method.AUTO: _solve_direct,
    Method.DIRECT: _solve_direct,
    Method.CUBIC: _solve_cubic,
}


def _result(solution: _Solution, problem: _Problem, leading: tuple[int, ...]) -> HomogeneousResult:
    fit = solution.estimate
    verdict = judge(fit, known_variance=problem.known_variance)
    fitted, constant = fit.status == _direct.FITTED, fit.status == _direct.CONSTANT

    def shaped(values: Array, where: npt.NDArray[np.bool_], other: float = np.nan) -> Array:
        return np.where(where, values, other).reshape(leading)

    with np.errstate(invalid="ignore", over="ignore"):
        background_error = np.sqrt(fit.background_variance * verdict.noise)
        relative_error = np.sqrt(fit.amplitude_relative_variance * verdict.noise)
        amplitude_error = np.abs(fit.amplitude) * relative_error
        extinction_error = np.sqrt(fit.extinction_variance * verdict.noise)
    return HomogeneousResult(
        background=shaped(fit.background, fitted | constant),
        background_standard_error=shaped(
            background_error, fitted | (constant & problem.known_variance)
        ),
        amplitude=np.where(constant.reshape(leading), 0.0, shaped(fit.amplitude, fitted)),
        amplitude_standard_error=shaped(amplitude_error, fitted),
        extinction=shaped(fit.extinction, fitted),
        extinction_standard_error=shaped(extinction_error, fitted),
        reduced_chi2=shaped(verdict.reduced_chi2, fitted),
        valid_bins=np.nan_to_num(fit.bins).astype(np.int32).reshape(leading),
        quality=(verdict.quality | solution.quality).reshape(leading),
    )


def _method(name: str) -> Method:
    try:
        return Method(name)
    except ValueError:
        raise RetrievalInputError(
            f"is {name!r}", field="method", remedy=f"choose one of {', '.join(Method)}"
        ) from None


def _bounds(bounds: tuple[float, float] | None, range_: Array) -> tuple[float, float]:
    length = float(range_[-1] - range_[0]) if range_.size > 1 else 1.0
    if bounds is None:
        return LOWEST_EXTINCTION / float(range_[-1]), HIGHEST_OPTICAL_DEPTH / length
    lowest, highest = (float(bound) for bound in bounds)
    limit = _LARGEST_OPTICAL_DEPTH / length
    if not -limit <= lowest < highest <= limit:
        raise RetrievalInputError(
            f"is ({lowest:g}, {highest:g}) m-1",
            field="extinction_bounds",
            remedy=f"give two rising values within +-{limit:g} m-1 (300 over the length)",
        )
    return lowest, highest

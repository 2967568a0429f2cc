"""Fit background, amplitude and extinction of a homogeneous path: the public entry point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.homogeneous import _methods
from lidarops.retrieve.homogeneous._problem import HomogeneousResult, PathProblem
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

__all__ = ["HomogeneousMethod", "HomogeneousResult", "Noise", "fit_homogeneous_path"]


class HomogeneousMethod(StrEnum):
    """Methods to solve a homogeneous path."""

    DIRECT = "direct"
    CUBIC = "cubic"
    LINEARIZED = "linearized"
    KNOWN_BACKGROUND = "known_background"
    KNOWN_EXTINCTION = "known_extinction"


_SOLVERS: Final[dict[HomogeneousMethod, Callable[[PathProblem], HomogeneousResult]]] = {
    HomogeneousMethod.DIRECT: _methods.solve_by_direct_fit,
    HomogeneousMethod.CUBIC: _methods.solve_by_cubic,
    HomogeneousMethod.LINEARIZED: _methods.solve_by_linearization,
    HomogeneousMethod.KNOWN_BACKGROUND: _methods.solve_with_known_background,
    HomogeneousMethod.KNOWN_EXTINCTION: _methods.solve_with_known_extinction,
}

_NEEDS: Final[dict[str, set[HomogeneousMethod]]] = {
    "extinction": {HomogeneousMethod.LINEARIZED, HomogeneousMethod.KNOWN_EXTINCTION},
    "background": {HomogeneousMethod.KNOWN_BACKGROUND},
}
"""Arguments that these methods require and no other accepts."""
_TAKES: Final = {
    "background_standard_error": {HomogeneousMethod.KNOWN_BACKGROUND},
    "lag": {HomogeneousMethod.CUBIC},
}
"""Arguments that only these methods accept."""


class Noise(NamedTuple):
    """What is known of the noise beside its variance."""

    relative: bool = False
    """Whether the variance is known up to a common factor only, which the residuals of each profile
    give: for a variance that is estimated from the same data."""
    correlation_length: npt.ArrayLike | None = None
    """(...) float, bins, at least 1; the integral correlation length
    (`lidarops.retrieve.signal.noise_correlation`). Bins are independent where not given."""
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
    error = inputs.profile_values(background_standard_error, "background_standard_error", leading)
    if error is not None and np.any(error < 0):
        raise RetrievalInputError("is negative", field="background_standard_error")
    length = float(grid[-1] - grid[0]) if grid.size > 1 else 1.0
    known_variance = variance is not None and not noise.relative
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
        extinction=_known_extinction(extinction, length, leading),
        background=inputs.profile_values(background, "background", leading),
        background_variance=None if error is None else error**2,
        exposure=exposure,
        lag=lag,
    )
    return inputs.with_leading_axes(_SOLVERS[chosen_method](problem), leading)


def _noise_of_profiles(
    noise: Noise, leading: tuple[int, ...], *, known_variance: bool
) -> tuple[Array, Array | None]:
    """Return correlation length and exposure, (profile or 1,)."""
    correlated = inputs.profile_values(
        noise.correlation_length, "noise.correlation_length", leading
    )
    if correlated is not None and np.any(correlated < 1):
        raise RetrievalInputError("is less than 1 bin", field="noise.correlation_length")
    counted = inputs.profile_values(noise.exposure, "noise.exposure", leading)
    if counted is not None and not (known_variance and np.all(counted > 0)):
        raise RetrievalInputError(
            "is not positive, or given without variance",
            field="noise.exposure",
            remedy="give counts per unit of power with the variance of the counts",
        )
    return np.ones(1) if correlated is None else correlated, counted


def _known_extinction(
    extinction: npt.ArrayLike | None, length: float, leading: tuple[int, ...]
) -> Array | None:
    """Return the prior or known extinction in m-1, (profile or 1,)."""
    prior = inputs.profile_values(extinction, "extinction", leading)
    limit = THRESHOLDS.largest_optical_depth / length
    if prior is not None and np.any(np.abs(prior) > limit):
        raise RetrievalInputError(
            f"holds values up to {np.max(np.abs(prior)):g} m-1: it must be in m-1",
            field="extinction",
            remedy=f"stay within +-{limit:g} m-1"
            f" ({THRESHOLDS.largest_optical_depth:g} over the length)",
        )
    return prior


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

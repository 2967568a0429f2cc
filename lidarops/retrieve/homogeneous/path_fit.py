"""Background, amplitude and extinction of a homogeneous path."""

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
from lidarops.retrieve.homogeneous import _dense, _methods, _robust, _sections
from lidarops.retrieve.homogeneous._problem import Array, Centre, Flags, Flat, PathProblem

LOWEST_EXTINCTION: Final = -0.3
"""Default lower bound, over the far end of the section. Where extinction approaches
-1 / range, the shape stops falling and a second minimum appears."""
HIGHEST_OPTICAL_DEPTH: Final = 60.0
"""Default upper bound, over the length of the section: the signal is gone after two bins."""
MODEL_ERROR: Final = 0.05
"""Default share of extinction + 1 / mean range that the model's slope is trusted to."""
_LARGEST_OPTICAL_DEPTH: Final = 300.0
"""Beyond this the exponential leaves the numbers that a computer has."""


class HomogeneousMethod(StrEnum):
    """Ways to solve a homogeneous path."""

    AUTO = "auto"
    COMPRESSED = "compressed"
    FAST = "fast"
    DIRECT = "direct"
    CUBIC = "cubic"
    LINEARIZED = "linearized"
    KNOWN_BACKGROUND = "known_background"
    KNOWN_EXTINCTION = "known_extinction"
    TAIL_MEAN = "tail_mean"


_SOLVERS: Final[dict[HomogeneousMethod, Callable[[PathProblem], Flat]]] = {
    HomogeneousMethod.AUTO: _dense.compressed,
    HomogeneousMethod.COMPRESSED: _dense.compressed,
    HomogeneousMethod.FAST: _dense.fast,
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
"""Arguments that these methods need and no other takes."""
_TAKES: Final[dict[str, set[HomogeneousMethod]]] = {
    "background_standard_error": {HomogeneousMethod.KNOWN_BACKGROUND},
    "centre": {HomogeneousMethod.LINEARIZED},
    "lag": {HomogeneousMethod.CUBIC},
    "tail_start": {HomogeneousMethod.TAIL_MEAN},
}
"""Arguments that these methods take and no other."""


@dataclass(frozen=True, slots=True)
class HomogeneousResult:
    """What a homogeneous path was found to be, with the leading axes of the power.

    Where sections were asked for, they are the last axis.

    Standard errors are conditional on the model. What changes the profile along the model's own
    shapes leaves no trace in the residuals: backscatter that falls along the path as
    ``exp(-R / H)`` is taken for 1 / (2 H) of extinction, on a vertical path as on any other.
    `extinction_model_error` and `background_model_error` are an allowance for that, apart from the
    random error, and no bound. Over random violations of every size (``lidarops bench stability``),
    these shares of the values that no bit rejects are off by more than 4 of both errors together:

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

    Most of these leave little trace. Those where what the model cannot take up of the violation
    is 5 standard deviations of the noise or more are 0.3 % at most of all values that no bit
    rejects (0.6 % where the top is cut off). A test that is told the very shape of a violation,
    though not its sign, and gives as few false alarms as ours misses 7 % at 5 standard
    deviations, half at 3.5 and nearly all at 1.
    """

    background: Array
    """P*, in the unit of the power."""
    background_standard_error: Array
    """In the unit of the power; random error alone."""
    background_model_error: Array
    """In the unit of the power: what the background takes up, to first order, of a signal whose
    logarithmic slope departs from the model by `model_error` times
    2 (absolute extinction + 1 / mean range), the slope at mean range, at either end of the section,
    with opposite signs, as where backscatter bends along the path."""
    amplitude: Array
    """B of ``P = P* + B R^-2 exp(-2 extinction R)``, in the unit of the power times m2."""
    amplitude_standard_error: Array
    """Relative to first order: B is extrapolated to range zero, and above some 30 percent of it
    the interval holds for its logarithm rather than for B."""
    extinction: Array
    """m-1."""
    extinction_standard_error: Array
    """m-1; random error alone."""
    extinction_model_error: Array
    """m-1; `model_error` times (absolute extinction + 1 / mean range), for a slope that departs by
    as much as in `background_model_error` all along the section, and, in quadrature, what the
    extinction takes up to first order of the bend there: most of it where extinction and
    background are hard to tell apart."""
    signal_to_noise: Array
    """Amplitude over its standard error at known extinction, with the sign of the amplitude."""
    reduced_chi2: Array
    """1 where the residuals are noise; relative to the estimated noise without a variance."""
    curvature_misfit: Array
    """Energy of the residuals in the smooth shapes that the model lacks, over the noise: a
    chi-square of the compressed methods; NaN for the others."""
    valid_bins: Flags
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
    method : str
        One of the methods of the notes below.
    extinction_bounds : (float, float), optional
        Lowest and highest extinction in m-1; -0.3 / (last range) and 60 / (last - first range)
        where not given. The lower one keeps a second, unphysical minimum near -1 / (last
        range) out, which is too narrow to be found by all means if it is let in; it is
        negative so that noise about zero is not clipped.
    extinction : (...) float, optional
        m-1. The prior of "linearized"; taken as exact by "known_extinction".
    background : (...) float, optional
        For "known_background", in the unit of the power.
    background_standard_error : (...) float, optional
        Of the given background, which must not stem from the same bins; 0 where not given.
    centre : {"centroid", "zero"}, optional
        The range about which "linearized" expands; the centroid of information where not given.
    lag : int, optional
        Of "cubic"; `lidarops.retrieve.background.cubic_and_tail.default_lag` where not given.
    tail_start : float, optional
        m; "tail_mean" averages the bins from here on, the last tenth where not given.
    statistics : {"gauss", "poisson"}
        "poisson" says that `power` are mean counts per shot. The weights must then be given,
        and those of a mean profile (`mean_profile_variance`): weights from the counts of the
        profile itself bias the fit, and weights pooled over whatever happens to be in one call
        would make a result depend on its neighbours.
    shots : (...) float, optional
        Number of shots of which `power` is the mean count; 1 where not given. Needs "poisson".
    sections : sequence of (float, float), optional
        m; each section holds the bins with near <= R < far and is solved on its own. The
        result gets a last axis, section.
    robust_passes : int
        How often to leave out the bins that are more than 4 standard deviations of the noise
        off the fit, and to fit again; 2 suffice for a cloud or spikes. What is left out raises
        OUTLIER. The standard deviation is not less than the median deviation tells, so that a
        bad fit does not shed most of its bins. Not with "cubic", which takes no gaps.
    model_error : float
        Share of 2 (absolute extinction + 1 / mean range) by which the logarithmic slope of the
        signal may depart, all along the section and at its ends with opposite signs: the
        violations that `extinction_model_error` and `background_model_error` stand for.

    Returns
    -------
    HomogeneousResult
        Without `variance`, the noise is estimated from second differences of the residuals
        along range and scales the standard errors; with n bins they have 0.51 (n - 2) degrees
        of freedom. They are widened so that 4 of them are passed as rarely as with a known
        variance, as Student's distribution has it: by 4 percent at 225 bins, 20 at 50, 70 at 20,
        and 7.6 times at 8.

        A result stands (no bit raised) when the signal is more than 5 times its standard error
        (else LOW_SIGNAL), the standard error of extinction less than 15 percent of extinction
        + 1 / mean range (POORLY_DETERMINED), the amplitude positive (NEGATIVE_AMPLITUDE) and
        the extinction off its bounds (AT_BOUND); when the reduced chi-square is within what
        its degrees of freedom allow (POOR_FIT), the residuals are free of the shapes of
        backscatter that bends along the path and of a detector that is not linear
        (NOT_HOMOGENEOUS), and none is beyond 5 standard deviations (OUTLIER); each of these
        three at a false-alarm rate of 4e-4. Fewer than 8 bins are TOO_FEW_BINS, fewer than 4
        give NaN; none at all is INPUT_MISSING. A constant profile is NO_SIGNAL: its value is
        the background, the amplitude is 0 and the extinction NaN.

        Each profile is solved on its own: a result does not depend on what else is in `power`.

    Raises
    ------
    RetrievalInputError
        For arguments whose shapes, units or values cannot be right, or that the method does not
        take.

    Notes
    -----
    auto
        "compressed".
    compressed
        The least-squares solution from 11 linear functionals of the profile, which hold all but
        a millionth of what it says of the extinction: within 0.01 standard errors of "direct" in
        a fifteenth of its time. (Where a weak signal is gone within some bins, at an optical
        depth of 40, one profile in 10,000 was half a standard error apart.) For profiles without
        gaps on a uniform range of at most 4096 bins with weights that all share: its tables
        take 15 kB a bin while they are made. Other profiles get the same answer,
        within 1e-4 standard errors of "direct", by Newton steps over their bins; sections of
        less than 32 bins are given to "direct". Here NOT_HOMOGENEOUS is a test of
        `curvature_misfit`, the energy of the functionals that the model leaves over, and of
        their projection on the square of the shape, each at half the rate of false alarms.
    fast
        The same from 7 functionals: up to 0.4 percent more scatter, within 0.3 standard errors
        of "direct". With a known variance the residuals are not looked at: no `reduced_chi2`,
        no POOR_FIT, no OUTLIER.
    direct
        The least-squares solution by a fixed number of closed-form steps: the best of 24
        extinctions with background and amplitude eliminated (variable projection, golub1973),
        the vertex of a parabola through it, seven Newton steps. It takes gaps, weights and any
        spacing, and reaches the least possible scatter.
    cubic
        The background of `lidarops.retrieve.background.cubic_and_tail.cubic` (bobrovsky2024, corrected there),
        then amplitude and extinction fitted to what is above it. No start value and no search,
        but a uniform range without gaps, a signal that starts well above the noise, and 1.3 to
        3 times the least possible scatter, which its standard errors state.
    linearized
        Linear least squares for three unknowns about a prior extinction (potapova2023):

        .. math:: P \approx P^* + [B + G (R - R_c)] R^{-2} e^{-2 \sigma_0 R},
            \qquad \sigma = \sigma_0 - G / 2B

        Three linear equations, one Gauss-Newton step of the full problem: for a prior that is
        known to some percent, as from a neighbouring profile. What the neglected term of second
        order does is estimated and part of the standard errors. By default R_c is the centroid
        of information, where B and G are independent. The paper expands about R_c = 0
        (centre="zero"), where B is extrapolated: from a prior 20 percent low, the error at
        strong extinction is 6 to 8 times larger, that at weak extinction about the same. There
        the estimate of the neglected term falls short too: of priors that are off by up to a
        factor of 2, 1 to 3 percent of what is accepted is off by more than 4 standard errors,
        0.01 percent about the centroid.
    known_background
        Amplitude and extinction above a given background, by converged least squares; the
        paper's (5), in two unknowns, is one step of it. For a background that is measured
        elsewhere, as before the laser fires: at weak extinction, the scatter is 3 to 11
        times less than with three unknowns. The error of the background is propagated.
    known_extinction
        Background and amplitude by linear least squares at a given extinction, the paper's (4),
        weighted here. The extinction is taken as exact, with a standard error of 0; the others
        are conditional on it. The paper takes this background into (5) and finds two unknowns
        more accurate than three: true only for a background that the profile itself did not
        tell. Otherwise the two steps in turn just descend towards the least-squares solution,
        slowly, with its errors.
    tail_mean
        Background as mean of the far bins, then as "known_background", with its noise
        propagated. For comparison only: what is left of the signal in the tail is part of the
        background: a bias of many standard errors, which POOR_FIT tells in part. Over random
        paths, a third of what is accepted is off by more than 4 standard errors.

    References
    ----------
    golub1973; bobrovsky2024; potapova2023.

    Examples
    --------
    >>> import numpy as np
    >>> distance = np.arange(2500.0, 10500.0, 37.5)
    >>> power = 370.0 + 6.25e9 / distance**2 * np.exp(-2 * 3e-5 * distance)
    >>> float(np.round(solve(power, distance).extinction, 12))
    3e-05
    """
    way = inputs.choice(method, HomogeneousMethod, "method")
    _check_arguments(
        way,
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
    solver = _robust.Robust(_SOLVERS[way], _passes(robust_passes, way))
    found = [
        solver(problem.cut(bins, _bounds(extinction_bounds, grid.values[bins])))
        for bins in _sections.section_bins(sections, grid.values)
    ]
    shape = leading if sections is None else (*leading, len(found))
    return _result(found, shape, _share(model_error))


def mean_profile_variance(
    power: npt.ArrayLike,
    shots: npt.ArrayLike = 1.0,
) -> Array:
    """Return the variance of photon counts, from the mean profile of a block.

    Weights from a profile's own counts favour the bins that happen to be low, and bias the fit.
    Those of the mean profile of a block that shares its scale do not, and are as good: over a
    dynamic range of 1e4 the scatter is within 2 percent of the least possible one.

    The mean profile is averaged along range only as far as it takes to hold 1000 counts, at most
    over 15 bins, so that steep strong signals keep their shape. Choose the block once and pass
    the result with every part of it: the solver does not pool on its own, since results would
    then depend on how an archive is cut.

    Parameters
    ----------
    power : (..., range) float
        Mean counts per shot. Bins that are not finite are passed over.
    shots : (...) float
        Number of shots of which each profile is the mean count.

    Returns
    -------
    (..., range) float
        Variance of `power`: the mean profile over the number of shots; (range,) for one number
        of shots. NaN where no profile has a finite value.

    Raises
    ------
    RetrievalInputError
        Where counts are negative or shots not positive.
    """
    return photon_counts.mean_profile_variance(power, shots)


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
        takers = (_NEEDS | _TAKES)[name]
        if value is not None and method not in takers:
            raise RetrievalInputError(
                f"is not taken by the method {str(method)!r}",
                field=name,
                remedy=f"leave it out, or choose {' or '.join(sorted(takers))}",
            )
        if value is None and name in _NEEDS and method in takers:
            raise RetrievalInputError(f"is needed by the method {str(method)!r}", field=name)


def _passes(passes: int, method: HomogeneousMethod) -> int:
    if not isinstance(passes, int | np.integer) or passes < 0:
        raise RetrievalInputError(
            f"is {passes!r}", field="robust_passes", remedy="give 0, 1, 2 or more passes"
        )
    if passes and method is HomogeneousMethod.CUBIC:
        raise RetrievalInputError(
            f"is {passes}, but the cubic takes no gaps",
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


def _result(found: Sequence[Flat], shape: tuple[int, ...], model_error: float) -> HomogeneousResult:
    columns = {
        field.name: _stacked([getattr(flat, field.name) for flat in found]).reshape(shape)
        for field in fields(Flat)
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
            remedy=f"give two rising values within +-{limit:g} m-1 (300 over the length)",
        )
    return lowest, highest

"""Backscatter and extinction of particles from an elastic lidar, with an error budget.

The two-component solution of Fernald and Sasano: the scattering ratio is known in a reference
window, the lidar ratio everywhere; from the window on the lidar equation is solved in closed
form, towards the lidar and away from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen
from lidarops.retrieve.elastic import _fernald, outlying_bins

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Reference = tuple[npt.ArrayLike, npt.ArrayLike] | npt.NDArray[np.bool_]

LONGEST_GAP: Final = 150.0
"""m. Over more bins without data than this, nothing is known of what lies beyond."""

LEAST_DENOMINATOR: Final = 0.05
"""Of that at the reference. Away from the lidar, errors grow as the inverse of this share."""

LEAST_CERTAINTY: Final = 5.0
"""Standard errors by which the denominator must exceed zero, for errors of first order."""

SKEWED: Final = 5.5
"""Standard errors s of the denominator by noise at which the errors by noise are twice those of
first order: a reference that is high by noise gives values that are low, and errors that are low
as well. Multiplied by 0.98 + (5.5 / s)^3, where that is above 1 (s below 20), 4 of them are passed
by less than 1 in 1000 values; of first order, by 1 to 3 percent where s is 5 to 8 (simulations)."""

LARGEST_BACKSCATTER: Final = 5e-4
"""m-1 sr-1. Air scatters less than a tenth of this at 0.25 micrometres: a guard of units."""


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """What each cause adds to the error of a quantity, all of its shape.

    The errors of one cause but the noise are fully correlated along range, and keep their
    signs: they are the change of the quantity where the cause is one standard error too large,
    and add up along range before they are squared.
    """

    noise: Array
    """Standard error by the noise of the power; NaN where no variance was given."""
    background: Array
    """By the background that was not subtracted."""
    reference: Array
    """By the scattering ratio of the reference window."""
    lidar_ratio: Array
    molecular: Array
    """By the density of the air."""

    @property
    def total(self) -> Array:
        """Standard error by all causes, which are independent; NaN where one is unknown."""
        parts = (self.noise, self.background, self.reference, self.lidar_ratio, self.molecular)
        square = np.zeros_like(self.noise)
        for part in parts:
            square += part * part
        return np.asarray(np.sqrt(square))


@dataclass(frozen=True, slots=True)
class ElasticResult:
    """Particles along the beam, with the shape of the power, and one calibration a profile."""

    backscatter: Array
    """m-1 sr-1, of the particles; NaN where not `valid`."""
    budget: ErrorBudget
    """m-1 sr-1, of `backscatter`."""
    attenuated_backscatter: Array
    """m-1 sr-1, of particles and air, attenuated by both from the lidar on."""
    attenuated_backscatter_standard_error: Array
    lidar_constant: Array
    """Unit of the power times m3 sr, with the leading axes of the power."""
    lidar_constant_standard_error: Array
    molecular_backscatter: Array
    """m-1 sr-1, as given, broadcast to the power."""
    lidar_ratio: Array
    """sr, as given, broadcast to the power."""
    lidar_ratio_standard_error: Array
    """sr, as given, broadcast to the power."""
    molecular_relative_error: Array
    """As given, broadcast to the power."""
    valid: Mask
    unstable: Mask
    """Withheld: the denominator of the solution is too small, or not certain to be positive."""
    calibrated: Mask
    """Whether the reference window holds a positive signal, with the leading axes of the power."""
    outlying: Mask
    """The bin lies off on its own: the value is that of its neighbours (`outlying_bins.bridge_outliers`)."""

    @property
    def backscatter_standard_error(self) -> Array:
        """Of all causes, m-1 sr-1."""
        return self.budget.total

    @property
    def extinction(self) -> Array:
        """Of the particles, m-1: lidar ratio times backscatter."""
        return np.asarray(self.lidar_ratio * self.backscatter)

    @property
    def extinction_budget(self) -> ErrorBudget:
        """Of `extinction`, m-1."""
        ratio, part = self.lidar_ratio, self.budget
        return ErrorBudget(
            ratio * part.noise,
            ratio * part.background,
            ratio * part.reference,
            ratio * part.lidar_ratio + self.lidar_ratio_standard_error * self.backscatter,
            ratio * part.molecular,
        )

    @property
    def scattering_ratio(self) -> Array:
        """Backscatter of particles and air over that of the air; NaN where there is no air."""
        return 1.0 + self.backscatter * self._per_air()

    @property
    def scattering_ratio_budget(self) -> ErrorBudget:
        """Of `scattering_ratio`."""
        air, part = self._per_air(), self.budget
        return ErrorBudget(
            air * part.noise,
            air * part.background,
            air * part.reference,
            air * part.lidar_ratio,
            air * (part.molecular - self.molecular_relative_error * self.backscatter),
        )

    def _per_air(self) -> Array:
        return 1.0 / np.where(self.molecular_backscatter > 0.0, self.molecular_backscatter, np.nan)


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """Spread of perturbed solutions, for the errors of `ElasticResult` without linearisation."""

    budget: ErrorBudget
    """m-1 sr-1, of the backscatter of particles, each cause alone, with the sign of its effect."""
    standard_error: Array
    """m-1 sr-1, of the backscatter of particles by all causes at once."""
    bias: Array
    """m-1 sr-1, mean of the solutions with all causes less the unperturbed solution."""
    lidar_constant_standard_error: Array
    solved: Array
    """Share of the samples of all causes that have a solution."""


@dataclass(frozen=True, slots=True)
class _Problem:
    """The arguments as the kernel wants them: rows of profiles, ascending in range."""

    grid: inputs.RangeGrid
    leading: tuple[int, ...]
    power: inputs.Floats
    variance: Array | None
    window: Mask
    air: tuple[Array, Array, Array]
    """Backscatter and extinction of the air, lidar ratio."""
    outlying: Mask
    scattering_ratio: Array
    errors: tuple[Array, Array]
    """Of the lidar ratio, of the air."""
    causes: Array
    """Standard error of the background, relative one of the scattering ratio."""


def invert_elastic(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    molecular_backscatter: npt.ArrayLike,
    molecular_extinction: npt.ArrayLike,
    lidar_ratio: npt.ArrayLike,
    reference: Reference,
    reference_scattering_ratio: npt.ArrayLike = 1.0,
    variance: npt.ArrayLike | None = None,
    background_standard_error: npt.ArrayLike = 0.0,
    lidar_ratio_standard_error: npt.ArrayLike = 0.0,
    reference_relative_error: npt.ArrayLike = 0.0,
    molecular_relative_error: npt.ArrayLike = 0.0,
) -> ElasticResult:
    r"""Invert elastic profiles for the backscatter of particles, without iteration.

    With :math:`g = R^2 \exp 2 \int (\alpha_m - S \beta_m)`, :math:`q = g P` and the bin
    :math:`R_c` in the middle of the reference window, the total backscatter is

    .. math:: \beta = \frac{q}{D_c - 2 \int_{R_c}^R S q},
        \quad D_c = \frac{\sum P}{\sum \beta_0 \exp(-2 \int_{R_c}^R S \beta_0) / g},

    the sums over all bins of the window, in which :math:`\beta_0` is the molecular backscatter
    times the scattering ratio there. Integrals are trapezoids, so that signals of either sign
    count alike: a bin is off by less than 1e-4 where scattering changes over 100 m or more and
    bins are 7.5 m apart. Errors are of first order, those by noise widened where the reference is
    noisy (`SKEWED`); noise is taken as independent from bin to bin, and carried through integrals
    and window as they correlate it. A lone bin that its variance does not explain is bridged.

    Parameters
    ----------
    power : (..., range) float
        Any unit, free of background, not corrected for range; NaN where missing or where the
        overlap is incomplete. Negative values are used as they are.
    range : (range,) float
        m, of the centres of the bins.
    molecular_backscatter : (..., range) float
        m-1 sr-1, broadcast against `power`.
    molecular_extinction : (..., range) float
        m-1, broadcast against `power`.
    lidar_ratio : float or (..., range) float
        Of particles, sr.
    reference : (bottom, top) or (..., range) bool
        m, numbers or one for each profile (NaN: none for this profile); or the bins themselves.
    reference_scattering_ratio : float or (...) float
        In the reference window; 1 is air free of particles.
    variance : (..., range) float, optional
        Of the noise of a bin, in the square of the power's unit, broadcast against `power`.
        Where not given, the noise is unknown and so are the total errors.
    background_standard_error : float or (...) float
        In the unit of `power`: one error for all bins of a profile.
    lidar_ratio_standard_error : float or (..., range) float
        sr; one error of this shape along range.
    reference_relative_error : float or (...) float
        Standard error of the scattering ratio in the reference window over that ratio. Nothing
        else covers particles there that fall off with height nearly as air does, which no test
        of the signal tells: with 0.02, 12 percent of the values are off by more than 4 standard
        errors where such haze scatters 0.35 to 35 percent of what air does at 7 km, and 0.001
        percent where it is a tenth of that (`lidarops bench stability`).
    molecular_relative_error : float or (..., range) float
        Standard error of the density of the air over that density; one error of this shape
        along range.

    Returns
    -------
    ElasticResult
        Nothing is solved where the reference window has no positive signal (`calibrated`),
        beyond a gap of `LONGEST_GAP`, and where the denominator is below `LEAST_DENOMINATOR`
        of its value at the reference or `LEAST_CERTAINTY` of its standard errors
        (`unstable`); away from the lidar all farther bins are withheld with such a one.
        The lidar constant and what rests on it take the extinction by particles of the nearest
        solved bin to hold down to the lidar. The errors of the attenuated backscatter leave
        out that the noise of a bin is part of the constant too.

    Raises
    ------
    RetrievalInputError
        For arguments that cannot be right, among them units other than m.

    References
    ----------
    fernald1984, sasano1985.
    """
    problem = _prepare(
        power,
        range,
        variance,
        reference,
        (molecular_backscatter, molecular_extinction, lidar_ratio),
        reference_scattering_ratio,
        (lidar_ratio_standard_error, molecular_relative_error),
        (background_standard_error, reference_relative_error),
    )
    out, scalars, state = _invert(problem, problem.power)
    return _result(problem, out, scalars, state)


def monte_carlo(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    molecular_backscatter: npt.ArrayLike,
    molecular_extinction: npt.ArrayLike,
    lidar_ratio: npt.ArrayLike,
    reference: Reference,
    reference_scattering_ratio: npt.ArrayLike = 1.0,
    variance: npt.ArrayLike,
    background_standard_error: npt.ArrayLike = 0.0,
    lidar_ratio_standard_error: npt.ArrayLike = 0.0,
    reference_relative_error: npt.ArrayLike = 0.0,
    molecular_relative_error: npt.ArrayLike = 0.0,
    samples: int = 200,
    seed: int,
) -> MonteCarlo:
    """Solve perturbed profiles, for errors that are too large for those of first order.

    Normal deviates perturb the power, its background, the scattering ratio of the reference, the
    lidar ratio and the air, each alone and all at once. All profiles get the same deviates, so
    that a profile's result does not depend on its neighbours in the array.

    Parameters
    ----------
    power, range, variance
        As in `invert_elastic`, but the variance is needed.
    molecular_backscatter, molecular_extinction, lidar_ratio
        As in `invert_elastic`.
    reference, reference_scattering_ratio
        As in `invert_elastic`.
    background_standard_error, lidar_ratio_standard_error
        As in `invert_elastic`.
    reference_relative_error, molecular_relative_error
        As in `invert_elastic`.
    samples : int
        At least 2; a standard error from n of them is good to 1 / sqrt(2 n).
    seed : int
        The same seed gives the same result.

    Returns
    -------
    MonteCarlo
        NaN where `invert_elastic` has no value, or where less than 95 percent of the samples have one.

    Raises
    ------
    RetrievalInputError
        As in `invert_elastic`, and for fewer than 2 samples.
    """
    problem = _prepare(
        power,
        range,
        variance,
        reference,
        (molecular_backscatter, molecular_extinction, lidar_ratio),
        reference_scattering_ratio,
        (lidar_ratio_standard_error, molecular_relative_error),
        (background_standard_error, reference_relative_error),
    )
    if samples < 2:
        raise RetrievalInputError(f"is {samples}", field="samples", remedy="give 2 or more")
    return _sample(problem, samples, np.random.default_rng(seed))


def _sample(problem: _Problem, samples: int, rng: np.random.Generator) -> MonteCarlo:
    solution, scalars, _ = _invert(problem, problem.power)
    true, constant = solution[_fernald.BACKSCATTER], scalars[:, _fernald.CONSTANT]
    spreads = [_Spread.like(true) for _ in _CAUSES]
    together, of_constant = _Spread.like(true), _Spread.like(constant)
    for _ in range(samples):
        noise, deviates = rng.standard_normal(problem.grid.size), rng.standard_normal(4)
        for cause, spread in enumerate(spreads):
            chosen = np.where(np.arange(4) == cause - 1, deviates, 0.0)
            found, _ = _perturbed(problem, noise if cause == 0 else 0.0 * noise, chosen)
            spread.add(found - true, float(deviates[cause - 1]) if cause else 0.0)
        found, its_constant = _perturbed(problem, noise, deviates)
        together.add(found - true, 0.0)
        of_constant.add(its_constant - constant, 0.0)
    shape = (*problem.leading, problem.grid.size)

    def turned(rows: Array) -> Array:
        return np.asarray(problem.grid.turn(rows.reshape(shape)))

    parts = [turned(spread.signed_error()) for spread in spreads]
    return MonteCarlo(
        budget=ErrorBudget(*parts),
        standard_error=turned(together.error()),
        bias=turned(together.mean()),
        lidar_constant_standard_error=of_constant.error().reshape(problem.leading),
        solved=turned(together.count / samples),
    )


_CAUSES: Final = ("noise", "background", "reference", "lidar_ratio", "molecular")
_LEAST_SOLVED: Final = 0.95


@dataclass(slots=True)
class _Spread:
    """Sums over the samples that have a solution."""

    count: Array
    total: Array
    square: Array
    tilt: Array
    """Deviations times the deviates that caused them."""
    samples: int = 0

    @classmethod
    def like(cls, values: Array) -> _Spread:
        count, total, square, tilt = np.zeros((4, *values.shape))
        return cls(count, total, square, tilt)

    def add(self, deviation: Array, deviate: float) -> None:
        solved = np.isfinite(deviation)
        part = np.where(solved, deviation, 0.0)
        self.samples += 1
        self.count += solved
        self.total += part
        self.square += part * part
        self.tilt += deviate * part

    def mean(self) -> Array:
        enough = self.count >= max(_LEAST_SOLVED * self.samples, 2.0)
        return np.where(enough, self.total, np.nan) / np.maximum(self.count, 1.0)

    def error(self) -> Array:
        square = self.square - self.count * self.mean() ** 2
        return np.asarray(np.sqrt(np.maximum(square, 0.0) / np.maximum(self.count - 1.0, 1.0)))

    def signed_error(self) -> Array:
        return np.asarray(np.where(self.tilt < 0.0, -1.0, 1.0) * self.error())


def _perturbed(problem: _Problem, noise: Array, deviates: Array) -> tuple[Array, Array]:
    """Return backscatter and lidar constant with the noise and the causes so many errors off."""
    background, reference, ratio, air = deviates
    variance = problem.variance if problem.variance is not None else np.zeros((1, 1))
    power = problem.power + noise * np.sqrt(variance) + background * problem.causes[:, :1]
    scale = 1.0 + air * problem.errors[1]
    wrong = replace(
        problem,
        variance=None,
        air=(
            problem.air[0] * scale,
            problem.air[1] * scale,
            problem.air[2] + ratio * problem.errors[0],
        ),
        scattering_ratio=problem.scattering_ratio * (1.0 + reference * problem.causes[:, 1]),
        errors=(np.zeros((1, problem.grid.size)), np.zeros((1, problem.grid.size))),
        causes=np.zeros((1, 2)),
    )
    out, scalars, _ = _invert(wrong, power)
    return out[_fernald.BACKSCATTER], scalars[:, _fernald.CONSTANT]


def _invert(problem: _Problem, power: inputs.Floats) -> tuple[Array, Array, _fernald.Codes]:
    count, bins = power.shape
    known = problem.variance is not None
    out = np.empty((_fernald.FIELDS, count, bins))
    scalars = np.empty((count, _fernald.SCALARS))
    state = np.empty((count, bins), dtype=np.uint8)
    variance = problem.variance if problem.variance is not None else np.zeros((1, bins))
    _fernald.invert_fernald(
        frozen(power),
        frozen(variance),
        frozen(problem.window),
        frozen(problem.grid.values),
        (frozen(problem.air[0]), frozen(problem.air[1]), frozen(problem.air[2])),
        frozen(problem.scattering_ratio),
        (frozen(problem.errors[0]), frozen(problem.errors[1])),
        frozen(problem.causes),
        np.array([LONGEST_GAP, LEAST_DENOMINATOR, LEAST_CERTAINTY**2, SKEWED**2]),
        out,
        scalars,
        state,
    )
    if not known:
        out[[_fernald.NOISE, _fernald.ATTENUATED_ERROR]] = np.nan
        scalars[:, _fernald.CONSTANT_ERROR] = np.nan
    return out, scalars, state


def _result(problem: _Problem, out: Array, scalars: Array, state: _fernald.Codes) -> ElasticResult:
    shape = (*problem.leading, problem.grid.size)

    def profiles(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        whole = rows.reshape(shape) if rows.shape[0] != 1 else np.broadcast_to(rows[0], shape)
        return problem.grid.turn(whole)

    fields = [profiles(part) for part in out]
    return ElasticResult(
        backscatter=fields[_fernald.BACKSCATTER],
        budget=ErrorBudget(*fields[_fernald.NOISE : _fernald.MOLECULAR + 1]),
        attenuated_backscatter=fields[_fernald.ATTENUATED],
        attenuated_backscatter_standard_error=fields[_fernald.ATTENUATED_ERROR],
        lidar_constant=scalars[:, _fernald.CONSTANT].reshape(problem.leading),
        lidar_constant_standard_error=scalars[:, _fernald.CONSTANT_ERROR].reshape(problem.leading),
        molecular_backscatter=profiles(problem.air[0]),
        lidar_ratio=profiles(problem.air[2]),
        lidar_ratio_standard_error=profiles(problem.errors[0]),
        molecular_relative_error=profiles(problem.errors[1]),
        valid=profiles(state == _fernald.VALID),
        unstable=profiles(state == _fernald.UNSTABLE),
        calibrated=np.any(state != _fernald.MISSING, axis=-1).reshape(problem.leading),
        outlying=profiles(problem.outlying),
    )


def _prepare(
    power: npt.ArrayLike,
    range_: npt.ArrayLike,
    variance: npt.ArrayLike | None,
    reference: Reference,
    air: tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike],
    scattering_ratio: npt.ArrayLike,
    errors: tuple[npt.ArrayLike, npt.ArrayLike],
    causes: tuple[npt.ArrayLike, npt.ArrayLike],
) -> _Problem:
    grid = inputs.range_grid(range_)
    rows, leading = inputs.profiles(power, grid)
    backscatter = inputs.noise_rows(air[0], "molecular_backscatter", grid, leading)
    extinction = inputs.noise_rows(air[1], "molecular_extinction", grid, leading)
    lidar_ratio = inputs.noise_rows(air[2], "lidar_ratio", grid, leading)
    _require_air(backscatter, "molecular_backscatter", LARGEST_BACKSCATTER)
    _require_air(extinction, "molecular_extinction", 10.0 * LARGEST_BACKSCATTER)
    _require(lidar_ratio > 0.0, lidar_ratio, "lidar_ratio", "give positive sr")
    ratio = _per_profile(scattering_ratio, "reference_scattering_ratio", leading)
    _require(
        ratio > 0.0, ratio, "reference_scattering_ratio", "give 1 where air is free of particles"
    )
    noise, outlying = None, np.zeros((1, grid.size), dtype=np.bool_)
    if variance is not None:
        noise = inputs.variance_rows(variance, grid, leading)
        rows, noise, outlying = outlying_bins.bridge_rows(rows, noise, grid)
    return _Problem(
        grid,
        leading,
        rows,
        noise,
        _window(reference, grid, leading),
        (backscatter, extinction, lidar_ratio),
        outlying,
        ratio,
        (
            _errors(errors[0], "lidar_ratio_standard_error", grid, leading),
            _errors(errors[1], "molecular_relative_error", grid, leading),
        ),
        _causes(causes, leading),
    )


def _causes(causes: tuple[npt.ArrayLike, npt.ArrayLike], leading: tuple[int, ...]) -> Array:
    names = ("background_standard_error", "reference_relative_error")
    columns = []
    for values, name in zip(causes, names, strict=True):
        column = _per_profile(values, name, leading)
        _require((column >= 0.0) | np.isnan(column), column, name, "give a standard error")
        columns.append(column)
    return np.ascontiguousarray(np.stack(np.broadcast_arrays(*columns), axis=-1))


def _errors(
    values: npt.ArrayLike, name: str, grid: inputs.RangeGrid, leading: tuple[int, ...]
) -> Array:
    rows = inputs.noise_rows(values, name, grid, leading)
    _require(rows >= 0.0, rows, name, "give finite standard errors, 0 for none")
    return rows


def _require_air(rows: Array, name: str, largest: float) -> None:
    _require(rows >= 0.0, rows, name, "give values of the air for every bin")
    _require(rows < largest, rows, name, "give m-1, not km-1")


def _require(fine: Mask, values: Array, name: str, remedy: str) -> None:
    # The comparison is False for NaN, infinities are no values either.
    wrong = ~fine | np.isinf(values)
    if np.any(wrong):
        raise RetrievalInputError(f"holds {values[wrong][0]:g}", field=name, remedy=remedy)


def _per_profile(values: npt.ArrayLike, name: str, leading: tuple[int, ...]) -> Array:
    """Return one value a profile as (profile or 1,); NaN stays."""
    array = inputs.real_array(values, name).astype(np.float64, copy=False)
    if array.size == 1:
        return array.reshape(1)
    try:
        return np.ascontiguousarray(np.broadcast_to(array, leading)).reshape(-1)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, which does not broadcast to the shape {leading} of"
            " the profiles",
            field=name,
        ) from None


def _window(reference: Reference, grid: inputs.RangeGrid, leading: tuple[int, ...]) -> Mask:
    """Return the bins of the reference window as (profile or 1, bin)."""
    if isinstance(reference, np.ndarray) and reference.dtype == np.bool_:
        rows = inputs.noise_rows(reference.astype(np.float64), "reference", grid, leading)
        return rows > 0.0
    if not isinstance(reference, tuple) or len(reference) != 2:
        raise RetrievalInputError(
            "is neither a pair of ranges nor a boolean array",
            field="reference",
            remedy="give (bottom, top) in m",
        )
    bottom, top = (_per_profile(edge, "reference", leading) for edge in reference)
    if np.any(bottom >= top):
        raise RetrievalInputError(
            "ends before it begins", field="reference", remedy="give (bottom, top) in m"
        )
    inside = (grid.values >= bottom[:, np.newaxis]) & (grid.values <= top[:, np.newaxis])
    if inside.shape[0] == 1 and not np.any(inside) and np.isfinite(bottom[0] + top[0]):
        raise RetrievalInputError(
            f"{bottom[0]:g} to {top[0]:g} m holds no bin of the range, which reaches from"
            f" {grid.values[0]:g} to {grid.values[-1]:g} m",
            field="reference",
        )
    return np.asarray(inside)

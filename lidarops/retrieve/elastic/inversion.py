"""Particle backscatter and extinction from elastic lidar profiles, with an error budget.

The two-component solution of Fernald and Sasano. Given are the scattering ratio in a reference
window and the lidar ratio in all bins. The lidar equation is then solved in closed form from the
window towards the lidar and away from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Codes, frozen
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.elastic import _fernald

CAUSES: Final = (
    "noise", "background", "reference", "lidar_ratio", "molecular", "dead_time", "baseline"
)  # fmt: skip
"""Causes of error; see `ElasticResult.budget`."""
_LARGEST_BACKSCATTER: Final = 5e-4
"""m-1 sr-1; a check of units: air scatters less than a tenth of this at 0.25 micrometres."""


class Thresholds(NamedTuple):
    """Limits of the inversion."""

    longest_gap: float = 150.0
    """m; a longer gap without data ends the integration. Simulations: 1 km without data at the top
    of a mixed layer shifts all nearer values by 14 %."""
    least_denominator: float = 0.05
    """Share of the denominator at the reference; errors grow as its inverse. It alone withholds
    values beyond a cloud where no error of the lidar ratio is stated
    (`test_integration_away_from_the_lidar_through_a_cloud_is_withheld`). Assumed."""
    skewed: float = 5.5
    """Ratio s of the denominator to its noise error at which noise errors are twice those of first
    order. A reference that is too high by noise makes both values and errors too low, so noise
    errors are multiplied by 0.98 + (5.5 / s)^3 where that exceeds 1. Simulations: less than 0.1 %
    of the values are then off by more than 4 errors, without it 1 to 3 % where s is 5 to 8."""
    negative_bins: int = 4
    """Bins in a row that must be that low, so that noise alone is none. Assumed."""


THRESHOLDS: Final = Thresholds()


class Air(NamedTuple):
    """Clean air along the beam, broadcast against the power."""

    backscatter: npt.ArrayLike
    """(..., range), m-1 sr-1."""
    extinction: npt.ArrayLike
    """(..., range), m-1."""
    relative_error: npt.ArrayLike = 0.0
    """Number or (..., range): relative standard error of the density; one error of this shape,
    common to all bins."""


class LidarRatio(NamedTuple):
    """Lidar ratio of the particles, a number or (..., range)."""

    value: npt.ArrayLike
    """sr."""
    standard_error: npt.ArrayLike = 0.0
    """sr; one error of this shape, common to all bins."""


class Reference(NamedTuple):
    """The reference window, and the air in it."""

    edges: tuple[npt.ArrayLike, npt.ArrayLike]
    """Bottom and top in m, one pair or one for each profile (NaN: none for that profile)."""
    scattering_ratio: npt.ArrayLike = 1.0
    """Number or (...); 1 is air free of particles."""
    relative_error: npt.ArrayLike = 0.0
    """Number or (...): relative standard error of the scattering ratio. It alone covers particles
    whose backscatter falls with height nearly as that of air, which no test of the signal
    reveals."""


@dataclass(frozen=True, slots=True)
class ElasticResult:
    """Particle optical properties with the shape of the power, and one calibration a profile."""

    backscatter: Array
    """m-1 sr-1, of the particles; NaN where not `valid`."""
    budget: dict[str, Array]
    """Errors of `backscatter`, m-1 sr-1, by each of these causes:

    - ``noise``: standard error by the noise of the power; NaN where no variance was given,
    - ``background``: error by residual background,
    - ``reference``: by the scattering ratio of the reference window,
    - ``lidar_ratio``: by the lidar ratio,
    - ``molecular``: by the density of the air,
    - ``dead_time``: by the dead time of photon counting,
    - ``baseline``: by the baseline of analog signals, without sign.

    Except for noise, the errors of one cause are fully correlated along range and keep their
    signs: they are the change of the quantity where the cause is one standard error too large.
    Sum them along range before squaring. Causes are independent.
    """
    backscatter_standard_error: Array
    """m-1 sr-1, by all causes; so are those of extinction and scattering ratio."""
    extinction: Array
    """m-1, of the particles: lidar ratio times backscatter."""
    extinction_standard_error: Array
    scattering_ratio: Array
    """Total backscatter over molecular backscatter; NaN where the latter is 0."""
    scattering_ratio_standard_error: Array
    attenuated_backscatter: Array
    """m-1 sr-1, total backscatter times the two-way transmission of particles and air."""
    attenuated_backscatter_standard_error: Array
    lidar_constant: Array
    """Unit of the power times m3 sr, with the leading axes of the power."""
    lidar_constant_standard_error: Array
    valid: Booleans
    unstable: Booleans
    """No value: the denominator of the solution is too small, or not certain to be positive."""
    calibrated: Booleans
    """Whether the reference window holds a positive signal, with the leading axes of the power."""


def invert_elastic(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    air: Air,
    lidar_ratio: LidarRatio,
    reference: Reference,
    variance: npt.ArrayLike | None = None,
    background_standard_error: npt.ArrayLike = 0.0,
    dead_time_error: npt.ArrayLike = 0.0,
    baseline_error: npt.ArrayLike = 0.0,
    noise_correlation_length: npt.ArrayLike = 1.0,
) -> ElasticResult:
    r"""Return particle backscatter and extinction of elastic profiles, without iteration.

    With :math:`g = R^2 \exp 2 \int (\alpha_m - S \beta_m)`, :math:`q = g P` and the bin
    :math:`R_c` in the middle of the reference window, the total backscatter is

    .. math:: \beta = \frac{q}{D_c - 2 \int_{R_c}^R S q},
        \quad D_c = \frac{\sum P}{\sum \beta_0 \exp(-2 \int_{R_c}^R S \beta_0) / g},

    where the sums run over the bins of the window and :math:`\beta_0` is the molecular
    backscatter times the scattering ratio there. Integrals are trapezoidal, so signals of either
    sign have the same weight. The relative error of the trapezoids is below 1e-4 where scattering
    changes over 100 m or more and bins are 7.5 m apart. Errors are of first order; noise errors
    are widened where the reference is noisy (`Thresholds.skewed`). The noise of a bin enters its
    own value with its variance; that of other bins enters the reference and the integrals with
    the variance times the correlation length. Replace outlying bins before
    (`outlying_bins.bridge_outliers`).

    Parameters
    ----------
    power : (..., range) float
        Any unit, background subtracted, not range-corrected; NaN where missing or where the
        overlap is incomplete. Negative values are used as they are.
    range : (range,) float
        m, bin centres.
    air : Air
    lidar_ratio : LidarRatio
    reference : Reference
    variance : (..., range) float, optional
        Noise variance of a bin, in the square of the power's unit, broadcast against `power`.
        Without it, the noise error and the total errors are NaN.
    background_standard_error : float or (...) float
        In the unit of `power`; one error common to all bins of a profile.
    dead_time_error : float or (..., range) float
        In the unit of `power`: its change with one standard error of the dead time, common to all
        bins; broadcast against `power`. The inversion is repeated with it.
    baseline_error : float or (..., range) float
        The same with one standard error of the baseline of analog signals; that of the reference
        window and that of all other bins are independent.
    noise_correlation_length : float or (...) float
        Bins; the integral correlation length of the noise, 1 where bins are independent
        (`lidarops.retrieve.signal.noise_correlation`).

    Returns
    -------
    ElasticResult
        There is no value where the reference window has no positive signal (`calibrated`),
        beyond a gap of `Thresholds.longest_gap`, and where the denominator is below
        `Thresholds.least_denominator` of its value at the reference or
        5 standard errors (`unstable`). Beyond the reference, no
        bin farther than an unstable one has a value. The lidar constant and quantities derived
        from it assume the particle extinction of the nearest solved bin from there down to the
        lidar. The errors of the attenuated backscatter neglect that the noise of a bin also enters
        the lidar constant.

    Raises
    ------
    RetrievalInputError
        For invalid arguments, among them units other than m.

    References
    ----------
    fernald1984, sasano1985.
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    noise = np.zeros((1, grid.size))
    if variance is not None:
        noise = inputs.noise_rows(variance, "variance", grid, leading, negative=False)
    ratio_error = _errors(lidar_ratio.standard_error, "lidar_ratio_standard_error", grid, leading)
    air_error = _errors(air.relative_error, "molecular_relative_error", grid, leading)
    causes = {
        "background_standard_error": background_standard_error,
        "reference_relative_error": reference.relative_error,
        "noise_correlation_length": noise_correlation_length,
    }
    window = _window(reference.edges, grid, leading)
    given = _fernald.Given(
        frozen(noise),
        frozen(window),
        frozen(grid),
        _air(air, lidar_ratio.value, grid, leading),
        frozen(_scattering_ratio(reference, leading)),
        (frozen(ratio_error), frozen(air_error)),
        frozen(_causes(causes, leading)),
    )
    solution = _Solution(rows.astype(np.float64, copy=False), given)
    dead_time = solution.shifted(
        inputs.noise_rows(dead_time_error, "dead_time_error", grid, leading)
    )
    change = inputs.noise_rows(baseline_error, "baseline_error", grid, leading)
    # Its shape is not known: that of the window and that of the other bins would cancel. The
    # inversion is not linear where it exceeds the signal of the window, so both signs are tried.
    parts = [
        np.where(inside, change, 0.0) if change.any() else change for inside in (window, ~window)
    ]
    baseline = np.hypot(*(solution.shifted(part, -part) for part in parts))
    if variance is None:
        solution.out[[_fernald.NOISE, _fernald.ATTENUATED_ERROR]] = np.nan
        solution.scalars[:, _fernald.CONSTANT_ERROR] = np.nan
    return solution.result(leading, dead_time, baseline)


class _Solution:
    """The solution of profiles, (profile, bin), and its changes with their power."""

    def __init__(self, rows: Array, given: _fernald.Given) -> None:
        self._rows, self._given = rows, given
        self.out, self.scalars, self._state = self._solved(rows)

    def _solved(self, rows: Array) -> tuple[Array, Array, Codes]:
        """Return the values of bins and of profiles, and the states of bins."""
        out = np.empty((_fernald.FIELDS, *self._rows.shape))
        scalars = np.empty((len(self._rows), _fernald.SCALARS))
        state = np.empty(self._rows.shape, dtype=np.uint8)
        t = THRESHOLDS
        limits = np.array([t.longest_gap, t.least_denominator, COMMON.first_order**2, t.skewed**2])
        _fernald.invert_fernald(frozen(rows), self._given, limits, out, scalars, state)
        return out, scalars, state

    def shifted(self, *changes: Array) -> Array:
        """Return the largest change of the backscatter, and add those of others to their errors."""
        if not changes[0].any():
            return np.zeros((1, self._rows.shape[1]))
        others = [self._solved(self._rows + change) for change in changes]
        both, constant = [_fernald.BACKSCATTER, _fernald.ATTENUATED], _fernald.CONSTANT
        shift = _largest(self.out[both], [out[both] for out, _, _ in others])
        of_constant = _largest(
            self.scalars[:, constant], [scalars[:, constant] for _, scalars, _ in others]
        )
        for errors, change in (
            (self.out[_fernald.ATTENUATED_ERROR], shift[1]),
            (self.scalars[:, _fernald.CONSTANT_ERROR], of_constant),
        ):
            errors[:] = np.hypot(errors, change)
        return np.asarray(shift[0])

    def result(self, leading: tuple[int, ...], dead_time: Array, baseline: Array) -> ElasticResult:
        """Return the result with the leading axes of the power."""

        def profiles(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
            shape = (*leading, rows.shape[-1])
            return rows.reshape(shape) if rows.shape[0] != 1 else np.broadcast_to(rows[0], shape)

        values = [profiles(rows) for rows in self.out]
        derived = np.empty((len(_fernald.DERIVED), *self._rows.shape))
        _fernald.derive(self._given, self.out, frozen(dead_time), frozen(baseline), derived)
        errors = (
            *values[_fernald.NOISE : _fernald.MOLECULAR + 1],
            *map(profiles, (dead_time, baseline)),
        )
        return ElasticResult(
            backscatter=values[_fernald.BACKSCATTER],
            budget=dict(zip(CAUSES, errors, strict=True)),
            **dict(zip(_fernald.DERIVED, map(profiles, derived), strict=True)),
            attenuated_backscatter=values[_fernald.ATTENUATED],
            attenuated_backscatter_standard_error=values[_fernald.ATTENUATED_ERROR],
            lidar_constant=self.scalars[:, _fernald.CONSTANT].reshape(leading),
            lidar_constant_standard_error=self.scalars[:, _fernald.CONSTANT_ERROR].reshape(leading),
            valid=profiles(self._state == _fernald.VALID),
            unstable=profiles(self._state == _fernald.UNSTABLE),
            calibrated=np.any(self._state != _fernald.MISSING, axis=-1).reshape(leading),
        )


def _largest(former: Array, moved: Sequence[Array]) -> Array:
    """Return the larger of one or two changes, by size."""
    # Where the changed signal has no solution, the value itself is uncertain.
    shifts = [np.where(np.isfinite(new), new - former, former) for new in moved]
    first, last = shifts[0], shifts[-1]
    return np.where(np.abs(first) >= np.abs(last), first, last)


def _air(
    air: Air, lidar_ratio: npt.ArrayLike, grid: Array, leading: tuple[int, ...]
) -> tuple[Array, Array, Array]:
    """Return backscatter and extinction of the air, and the lidar ratio, (profile or 1, bin)."""
    backscatter = inputs.noise_rows(air.backscatter, "molecular_backscatter", grid, leading)
    extinction = inputs.noise_rows(air.extinction, "molecular_extinction", grid, leading)
    ratio = inputs.noise_rows(lidar_ratio, "lidar_ratio", grid, leading)
    # The lidar ratio of air is below 10 sr.
    for rows, name, most in (
        (backscatter, "molecular_backscatter", _LARGEST_BACKSCATTER),
        (extinction, "molecular_extinction", 10.0 * _LARGEST_BACKSCATTER),
    ):
        _require(rows >= 0.0, rows, name, "give a molecular value of 0 or more for every bin")
        _require(rows < most, rows, name, "give m-1, not km-1")
    _require(ratio > 0.0, ratio, "lidar_ratio", "give positive sr")
    return frozen(backscatter), frozen(extinction), frozen(ratio)


def _scattering_ratio(reference: Reference, leading: tuple[int, ...]) -> Array:
    name = "reference_scattering_ratio"
    ratio = inputs.profile_values(reference.scattering_ratio, name, leading, finite=False)
    _require(ratio > 0.0, ratio, name, "give 1 where air is free of particles")
    return ratio


def _causes(causes: dict[str, npt.ArrayLike], leading: tuple[int, ...]) -> Array:
    columns = []
    for name, values in causes.items():
        column = inputs.profile_values(values, name, leading, finite=False)
        least = 1.0 if name == "noise_correlation_length" else 0.0
        _require(
            (column >= least) | np.isnan(column), column, name, f"give a value of {least:g} or more"
        )
        columns.append(column)
    return np.ascontiguousarray(np.stack(np.broadcast_arrays(*columns), axis=-1))


def _errors(values: npt.ArrayLike, name: str, grid: Array, leading: tuple[int, ...]) -> Array:
    rows = inputs.noise_rows(values, name, grid, leading)
    _require(rows >= 0.0, rows, name, "give finite standard errors, 0 for none")
    return rows


def _require(acceptable: Booleans, values: Array, name: str, remedy: str) -> None:
    # Comparisons are False for NaN; infinities are refused as well.
    invalid = ~acceptable | np.isinf(values)
    if np.any(invalid):
        raise RetrievalInputError(f"holds {values[invalid][0]:g}", field=name, remedy=remedy)


def _window(
    edges: tuple[npt.ArrayLike, npt.ArrayLike], grid: Array, leading: tuple[int, ...]
) -> Booleans:
    """Return the bins of the reference window as (profile or 1, bin)."""
    bottom, top = (
        inputs.profile_values(edge, "reference", leading, finite=False) for edge in edges
    )
    if np.any(bottom >= top):
        raise RetrievalInputError(
            "ends before it begins", field="reference", remedy="give (bottom, top) in m"
        )
    inside = (grid >= bottom[:, np.newaxis]) & (grid <= top[:, np.newaxis])
    if inside.shape[0] == 1 and not np.any(inside) and np.isfinite(bottom[0] + top[0]):
        raise RetrievalInputError(
            f"{bottom[0]:g} to {top[0]:g} m holds no bin of the range, which reaches from"
            f" {grid[0]:g} to {grid[-1]:g} m",
            field="reference",
        )
    return np.asarray(inside)

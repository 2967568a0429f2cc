"""Background, amplitude and extinction of a homogeneous path, without iteration to convergence.

`solve` fits ``P = P* + B R^-2 exp(-2 sigma R)`` by least squares in a fixed number of closed-form
steps (`golub1973`, `potapova2023`), tests the fit, and says by quality bits what to think of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve import _direct as direct
from lidarops.retrieve import background as backgrounds
from lidarops.retrieve._arguments import Array, Profiles, profiles, spread

Method = Literal["auto", "direct", "cubic"]
METHODS: Final = ("auto", "direct", "cubic")

LOWEST: Final = -0.3
"""Lower bound of extinction times the far end of the range: below it a second optimum lies."""
HIGHEST: Final = 60.0
"""Upper bound of extinction times the length of the section."""
MIN_DETECTION: Final = 5.0
"""Signal over its standard error below which there is no signal to speak of."""
MAX_RELATIVE_ERROR: Final = 0.15
"""Standard error over (extinction + 1 / mean range) above which extinction is not determined."""
MIN_BINS: Final = 8
FALSE_ALARM: Final = 5e-4
"""Share of clean profiles that a test of the misfit may flag."""
OUTLIER_LIMIT: Final = 5.0
"""Smallest residual, in standard deviations of a bin, that makes an outlier."""
_DIFFERENCE_SPREAD: Final = 1.9
"""Bins times variance of the ratio of mean square to second-difference noise estimate, / 1."""


@dataclass(frozen=True, slots=True)
class HomogeneousResult:
    """What a homogeneous path is made of; arrays over the leading axes of the power."""

    background: Array
    """P*, in the unit of the power."""
    background_standard_error: Array
    amplitude: Array
    """B, in the unit of the power times m2."""
    amplitude_standard_error: Array
    extinction: Array
    """sigma, m-1."""
    extinction_standard_error: Array
    reduced_chi2: Array
    """Of the residuals, against the variance given or the noise of neighbouring bins."""
    valid_bins: npt.NDArray[np.int32]
    quality: npt.NDArray[np.int32]
    """Bits of `lidarops.flags.Quality`; 0 = no test failed."""


def solve(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    variance: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    method: Method = "auto",
    extinction_bounds: tuple[float, float] | None = None,
) -> HomogeneousResult:
    r"""Fit background, amplitude and extinction of a homogeneous path.

    .. math:: P(R) = P^* + B R^{-2} e^{-2 \sigma R}

    Background and amplitude are linear and are projected out; extinction is found by a matched
    grid of 24 nodes, a parabola, and five Newton steps that cannot leave the bracket of the best
    node. Standard errors are those of the information matrix at the solution.

    Parameters
    ----------
    power : (..., range) float
        Signal with its background, in any unit. NaN and infinity leave the bin out.
    range : (range,) float
        m, positive and monotonic; need not be uniform.
    variance : float or (..., range) float, optional
        Noise variance of the power; broadcasts. A bin whose variance is not positive and finite
        is left out. Where absent, the noise is estimated from second differences of the
        residuals between neighbouring bins.
    weights : (..., range) float, optional
        Relative weights (inverse variance up to a factor) where there is no variance.
    method : {"auto", "direct", "cubic"}
        ``direct`` is the fit; ``auto`` chooses it; ``cubic`` takes the background from
        `lidarops.retrieve.background.cubic` and fits the rest, for comparison.
    extinction_bounds : (float, float), optional
        m-1; ``(-0.3 / R_end, 60 / L)`` where absent, L being the length of the section. Below
        the lower one a second, false optimum lies near ``-1 / R_end``.

    Returns
    -------
    HomogeneousResult
        Not finite where `quality` says why. ``TOO_FEW_BINS``: fewer than 8 valid bins;
        ``NO_SIGNAL``: constant power; ``LOW_SIGNAL``, ``POORLY_DETERMINED``,
        ``NEGATIVE_AMPLITUDE``, ``AT_BOUND``: not solved; ``POOR_FIT``, ``NOT_HOMOGENEOUS``,
        ``OUTLIER``: the model does not describe the data, at a false-alarm rate of 5e-4 each.

    Raises
    ------
    RetrievalInputError
        Where arguments cannot be right, naming the argument.

    References
    ----------
    golub1973, potapova2023, bobrovsky2024
    """
    if method not in METHODS:
        raise RetrievalInputError(
            f"{method!r} is not known", field="method", remedy=f"choose {', '.join(METHODS)}"
        )
    if variance is not None and weights is not None:
        raise RetrievalInputError(
            "cannot be given together with variance", field="weights", remedy="give one of them"
        )
    given = profiles(power, range)
    grid = direct.make_grid(given.range, _bounds(given.range, extinction_bounds))
    noise = _noise(given, variance, weights)
    known = variance is not None
    if method == "cubic":
        return _with_cubic(given, grid, noise, known=known)
    return _finish(given, _fit(given, grid, noise, known=known), known=known)


def _bounds(distance: Array, given: tuple[float, float] | None) -> tuple[float, float]:
    length = float(distance[-1] - distance[0]) or 1.0
    low, high = given or (LOWEST / float(distance[-1]), HIGHEST / length)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise RetrievalInputError(
            f"({low}, {high}) are no bounds",
            field="extinction_bounds",
            remedy="give two finite values in m-1, the lower first",
        )
    return low, high


def _noise(given: Profiles, variance: npt.ArrayLike | None, weights: npt.ArrayLike | None) -> Array:
    if variance is not None:
        return spread(variance, given, "variance")
    if weights is not None:
        return spread(weights, given, "weights")
    return np.ones((1, given.range.size))


_Columns = dict[str, Array]


def _fit(
    given: Profiles,
    grid: direct.Grid,
    noise: Array,
    *,
    known: bool,
    background: Array | None = None,
) -> _Columns:
    out = np.full((given.power.shape[0], len(direct.COLUMNS)), np.nan)
    # Rounding to the type of the power is noise that no variance tells of.
    rounding = float(np.finfo(given.power.dtype).eps) / np.sqrt(12.0)
    held = np.full(1, np.nan) if background is None else background
    if out.size:
        direct.solve_profiles(given.power, noise, known, held, rounding, grid, out)
    return dict(zip(direct.COLUMNS, out.T, strict=True))


def _finish(
    given: Profiles, found: _Columns, *, known: bool, extra: _Columns | None = None
) -> HomogeneousResult:
    """Scale errors by the noise, judge the fit, and give the result its shape."""
    with np.errstate(all="ignore"):
        level = _level(found, known=known)
        free = np.where(found["status"] == direct.FITTED, found["bins"] - 3.0, np.nan)
        chi2 = np.where(free > 0, found["misfit"] / free / level, np.nan)
        extra = extra or {}
        errors = {
            name: np.sqrt(found[f"{name}_variance"] * level + extra.get(name, 0.0))
            for name in ("background", "amplitude", "extinction")
        }
        quality = _judge(found, level, chi2, errors["extinction"], known=known)
    constant = found["status"] == direct.CONSTANT
    amplitude = np.where(constant, 0.0, found["amplitude"])

    def shaped(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return given.shaped(np.ascontiguousarray(values))

    return HomogeneousResult(
        background=shaped(found["background"]),
        background_standard_error=shaped(errors["background"]),
        amplitude=shaped(amplitude),
        amplitude_standard_error=shaped(errors["amplitude"]),
        extinction=shaped(found["extinction"]),
        extinction_standard_error=shaped(errors["extinction"]),
        reduced_chi2=shaped(chi2),
        valid_bins=shaped(np.nan_to_num(found["bins"]).astype(np.int32)),
        quality=shaped(quality),
    )


def _level(found: _Columns, *, known: bool) -> Array:
    """Return the variance of the noise in units of the variance or inverse weight given."""
    rounding = np.nan_to_num(found["rounding"])
    if known:
        return 1.0 + rounding
    # A second difference of white noise has six times its variance; the fit takes little of it.
    estimate: Array = found["bends"] / (6.0 * found["bend_count"]) + rounding
    return estimate


def _judge(
    found: _Columns, level: Array, chi2: Array, error: Array, *, known: bool
) -> npt.NDArray[np.int32]:
    status, bins = found["status"], np.nan_to_num(found["bins"])
    fitted = status == direct.FITTED
    detection = np.sqrt(found["signal_energy"] / level)
    relative = error / (found["extinction"] + 1.0 / found["mean_range"])
    trend = found["trend"] / level
    largest = found["largest"] / np.sqrt(level)
    limit = np.maximum(
        OUTLIER_LIMIT, special.ndtri(1.0 - FALSE_ALARM / (2.0 * np.maximum(bins, 1)))
    )
    # Compared so that NaN fails the test.
    failed = {
        Quality.INPUT_MISSING: status == direct.EMPTY,
        Quality.TOO_FEW_BINS: (bins < MIN_BINS) & (status != direct.EMPTY),
        Quality.NO_SIGNAL: status == direct.CONSTANT,
        Quality.LOW_SIGNAL: fitted & ~(detection > MIN_DETECTION),
        Quality.POORLY_DETERMINED: fitted & ~(relative < MAX_RELATIVE_ERROR),
        Quality.NEGATIVE_AMPLITUDE: fitted & ~(found["amplitude"] > 0.0),
        Quality.AT_BOUND: fitted & (found["bounded"] != 0.0),
        Quality.POOR_FIT: fitted & (bins > 3) & ~_plausible(chi2, bins, known=known),
        Quality.NOT_HOMOGENEOUS: fitted & ~(trend <= _trend_limit(found["trend_count"])),
        Quality.OUTLIER: fitted & ~(largest <= limit),
    }
    quality = np.zeros(status.shape, np.int32)
    for bit, where in failed.items():
        quality[where] |= np.int32(bit)
    return quality


def _plausible(chi2: Array, bins: Array, *, known: bool) -> npt.NDArray[np.bool_]:
    """Return whether a reduced chi-square is what noise alone gives."""
    freedom = np.maximum(bins - 3.0, 1.0)
    if known:
        low = special.chdtri(freedom, 1.0 - FALSE_ALARM / 2.0) / freedom
        high = special.chdtri(freedom, FALSE_ALARM / 2.0) / freedom
    else:
        width = special.ndtri(1.0 - FALSE_ALARM / 2.0) * np.sqrt(_DIFFERENCE_SPREAD / freedom)
        low, high = 1.0 / (1.0 + width), 1.0 + width
    inside: npt.NDArray[np.bool_] = (chi2 >= low) & (chi2 <= high)
    return inside


def _trend_limit(count: Array) -> Array:
    """Return the energy that `count` shapes of noise exceed with the rate of false alarms."""
    limit: Array = np.where(count > 0, special.chdtri(np.maximum(count, 1.0), FALSE_ALARM), np.inf)
    return limit


def _with_cubic(
    given: Profiles, grid: direct.Grid, noise: Array, *, known: bool
) -> HomogeneousResult:
    """Hold the background of the cubic, and carry its error into the other two."""
    of_cubic = backgrounds.cubic(given.power, given.range, variance=noise if known else None)
    held, error = of_cubic.background, of_cubic.background_standard_error
    found = _fit(given, grid, noise, known=known, background=held)
    moved = _fit(given, grid, noise, known=known, background=held + error)
    extra = {name: (moved[name] - found[name]) ** 2 for name in ("amplitude", "extinction")}
    extra["background"] = error**2
    found["background"], found["background_variance"] = held, np.zeros_like(held)
    result = _finish(given, found, known=known, extra=extra)
    quality = result.quality | given.shaped(of_cubic.quality.reshape(-1))
    return HomogeneousResult(
        **{
            field: getattr(result, field)
            for field in result.__dataclass_fields__
            if field != "quality"
        },
        quality=quality,
    )

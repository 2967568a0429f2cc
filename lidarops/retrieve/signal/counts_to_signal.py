"""Raw counts to signals with known noise.

`analog_signal` converts ADC counts to mV and subtracts the dark signal. `photon_signal` converts
photon counts to MHz and corrects for dead time, which is done nowhere else.

The last axis is range, the one before it time. Quantities other than the signals are in SI units.
Arrays may have any memory layout, byte order and integer or float type; masked entries are
missing. The result of a profile does not depend on the other profiles, to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.constants import (
    DEAD_TIME_UNCERTAINTY,
    DEFAULT_DEAD_TIME,
    LICEL_RANGE_PER_MICROSECOND,
)
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Flags, Indices, frozen
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal import _noise_kernels as noise_kernels
from lidarops.retrieve.signal import _signal_kernels as kernels
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation
from lidarops.retrieve.signal.thresholds import THRESHOLDS

MIN_NOISE_BINS = kernels.BLOCK
"""Smallest half-width of such a window in bins: 16."""

_DIFFERENCE_ERROR: Final = 4.62
"""Relative variance of a mean of squared third differences, times their number: 2 times the sum of
squares of their correlations 1, 3/4, 3/10 and 1/20 on either side. Computed."""
_Number = TypeVar("_Number", bound=np.generic)
_COUNT_LIMITS = np.iinfo(np.int32)


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal with the variance of its noise and its quality, all of one shape."""

    power: Array
    """mV or MHz; NaN where `quality` holds INPUT_MISSING or SATURATED."""
    variance: Array
    """Noise variance in the square of the signal's unit."""
    quality: Flags
    """Bits of `lidarops.flags.Quality`."""
    correlation_length: Array
    """(...), bins: integral correlation length of the noise along range, without the last axis;
    see `lidarops.retrieve.signal.noise_correlation`."""


def analog_signal(
    counts: npt.NDArray[np.int32],
    shots: npt.NDArray[np.integer],
    range: Array,  # noqa: A002 - the field's word
    *,
    adc_bits: int,
    input_range: Array,
    dark: Array | None = None,
    dark_variance: Array | None = None,
    noise_variance: float | None = None,
    full_overlap_range: float = 0.0,
) -> Signal:
    r"""Return the voltage and its noise variance of summed ADC counts.

    .. math:: U = \frac{n \cdot 1000\, U_{max}}{N \, 2^{b}} - D

    with counts :math:`n`, shots :math:`N`, bits :math:`b`, input range :math:`U_{max}` in V and
    dark signal :math:`D` in mV. A bin is SATURATED at full scale, :math:`n \ge N (2^b - 1)`, and
    within 3.5 standard deviations of a shot below it, where single shots were clipped. A bin is
    INPUT_MISSING at an extreme of the integer type, in a profile without shots or of zeros only,
    and without a finite input range or dark signal.

    Each shot is rounded to whole steps of the digitiser. Where the noise of a shot exceeds half
    a step, rounding errors average out and are part of the measured noise. Where it is less, all
    shots err to one side, by up to half a step for any number of shots, and the variance is
    raised to cover this. That part of the error is the same in neighbouring bins: a mean over
    bins does not reduce it.

    Parameters
    ----------
    counts : (..., time, range) int32
        Sum over the shots.
    shots : (..., time) int
    range : (range,) float
        m.
    adc_bits : int
    input_range : (..., time) float
        V.
    dark, dark_variance : (range,) or (..., time, range) float, optional
        Mean of the dark files in mV, and the variance of that mean in mV^2; common to all
        profiles, or one for each.
    noise_variance : float, optional
        mV^2, of one profile; where not given, estimated from the profile (`difference_variance`),
        and raised where the noise of neighbouring bins is correlated
        (`lidarops.retrieve.signal.noise_correlation`).
    full_overlap_range : float
        m; nearer bins are INCOMPLETE_OVERLAP.

    Returns
    -------
    Signal
        In mV.

    Raises
    ------
    RetrievalInputError
        For counts that are not 32-bit integers, shapes that do not match, a range that is not
        finite or repeats a bin, a noise variance that is negative or not finite.

    References
    ----------
    licel2023
    """
    grid = _grid(range)
    summed = _counts(counts, grid, shots)
    leading = summed.shape[:-1]
    fired = _per_profile(shots, "shots", leading)
    with np.errstate(divide="ignore", invalid="ignore"):
        step = _per_profile(input_range, "input_range", leading) * 1000.0 / (fired * 2.0**adc_bits)
    power, quality = np.empty(summed.shape), np.empty(summed.shape, np.int32)
    kernels.voltage_profiles(
        frozen(_rows(summed)),
        frozen(fired),
        frozen(step),
        frozen(fired * (2.0**adc_bits - 1.0)),
        frozen(_per_bin(dark, "dark", summed.shape)),
        _overlap_bits(grid, full_overlap_range),
        _rows(power),
        _rows(quality),
    )
    scale = _Scale(summed, step, fired * (2.0**adc_bits - 1.0), fired)
    if noise_variance is None:
        variance = difference_variance(power, grid)
        clipped = _flag_clipped(power, quality, scale, variance)
        if clipped.size:
            # Clipped bins are less noisy than others and lowered the estimate.
            _rows(variance)[clipped] = difference_variance(_rows(power)[clipped], grid)
        correlation = estimate_noise_correlation(_rows(power), _rows(variance))
        variance *= correlation.excess.reshape(*leading, 1)
        length = correlation.length.reshape(leading)
        error = np.sqrt(_DIFFERENCE_ERROR / summed.shape[-1])
        return Signal(power, _add_rounding(variance, scale, error), quality, length)
    _require(0.0 <= noise_variance < np.inf, noise_variance, "noise_variance", "a variance in mV^2")
    noise = np.full(power.shape, noise_variance)
    dark_noise = _per_bin(dark_variance, "dark_variance", summed.shape)
    _flag_clipped(power, quality, scale, (_rows(noise) + dark_noise).reshape(power.shape))
    variance = _rows(_add_rounding(noise, scale)) + dark_noise
    length = estimate_noise_correlation(_rows(power), variance).length.reshape(leading)
    return Signal(power, variance.reshape(power.shape), quality, length)


class _Scale(NamedTuple):
    """Summed counts of profiles, and their conversion to mV."""

    counts: npt.NDArray[np.int32]
    """(..., time, range)"""
    step: Array
    """(profile,), mV of the mean per count of the sum."""
    top: Array
    """(profile,), counts at full scale."""
    shots: Array
    """(profile,)"""


def _add_rounding(variance: Array, scale: _Scale, relative_error: float = 0.0) -> Array:
    """Return the noise variances plus that of rounding errors which the scatter does not show.

    Each shot is rounded separately. With noise of half a step or more, rounding adds a variance
    of 1 / 12 squared steps, which is part of the measured noise and averages out. With less
    noise, the shots err to one side: an error that neither decreases with the number of shots nor
    shows in the scatter, uniform within half a step where there is no noise at all. In between,
    shots fall on two steps with variance m (1 - m), and their mean m may be off by
    sqrt(1/4 - m (1 - m)); above a variance of 1/4 the first harmonic of the error remains. The
    variance of a bin scatters, the median of a profile does not: the smaller of the two decides,
    less its standard error.
    """
    raised_variance = variance.copy()
    rows = _rows(raised_variance)
    # Without a shot, the noise is unknown.
    rows[scale.shots <= 0] += np.inf
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        unit = scale.step**2 * scale.shots
        fine = THRESHOLDS.fine * unit
        coarse = np.flatnonzero((rows < fine[:, np.newaxis]).any(axis=-1))
        middle = (rows.shape[-1] - 1) // 2
        median = np.partition(rows[coarse], middle, axis=-1)[:, middle] / unit[coarse]
        place, bins = np.nonzero(rows[coarse] < fine[coarse, np.newaxis])
        profile = coarse[place]
        measured = rows[profile, bins] / unit[profile]
        noise = np.fmin(measured, median[place]) / (1.0 + relative_error)
        harmonic = np.exp(-4.0 * np.pi**2 * np.maximum(noise - 1.0 / 12.0, 0.0)) / (2.0 * np.pi**2)
        common = np.maximum((0.25 - noise) / 3.0, harmonic)
        raised = np.maximum(measured, 1.0 / 12.0) + scale.shots[profile] * common
        rows[profile, bins] = unit[profile] * raised
    return raised_variance


def _flag_clipped(power: Array, quality: Flags, scale: _Scale, variance: Array) -> Indices:
    """Mark bins in which single shots were clipped although their mean is below full scale.

    Returns
    -------
    (profile,) int
        Indices of the profiles with such bins.
    """
    rows, noise = _rows(scale.counts), _rows(variance)
    fired = (scale.shots > 0)[:, np.newaxis]
    bright = rows > THRESHOLDS.near_full_scale * scale.top[:, np.newaxis]
    profile, bins = np.nonzero(fired & bright)
    shot_deviation = np.sqrt(noise[profile, bins] * scale.shots[profile])
    margin = (scale.top[profile] - rows[profile, bins]) * scale.step[profile]
    clipped = margin < THRESHOLDS.clipping * shot_deviation
    indices = profile[clipped], bins[clipped]
    _rows(power)[indices] = np.nan
    _rows(quality)[indices] |= np.int32(Quality.SATURATED)
    return np.unique(indices[0])


def photon_signal(
    counts: npt.NDArray[np.int32],
    shots: npt.NDArray[np.integer],
    range: Array,  # noqa: A002 - the field's word
    *,
    bin_width: float,
    dead_time: float | None = None,
    dead_time_uncertainty: float = DEAD_TIME_UNCERTAINTY,
    full_overlap_range: float = 0.0,
) -> Signal:
    r"""Return the count rate, corrected for dead time, and its noise variance of photon counts.

    The measured rate is :math:`m = n / (N T)`, with the nominal bin time :math:`T` = bin width
    / 150 m per microsecond. It is corrected for a non-paralysable dead time :math:`\tau` by

    .. math:: r = \frac{m}{1 - m \tau}, \qquad \mathrm{var}(r) = \frac{r}{N T (1 - m \tau)}

    (renewal statistics: :math:`\mathrm{var}(n) = n (1 - m\tau)^2`). The variance is that of the
    rate smoothed over +- 10 % of range, so that weights derived from it do not follow the noise
    of the single bin. PILE_UP is raised where the correction exceeds 10 %. Without a dead time
    nothing is corrected: 4 ns are assumed for the flags and for
    :math:`\mathrm{var}(m) = m (1 - m\tau)^2 / (N T)`, and PILE_UP is raised where more than 1 % is
    left uncorrected.

    An error of the dead time changes all rates together, by
    :math:`\delta r = r^2 \delta\tau` (`dead_time_standard_error`); it is not part of the variance.
    SATURATED is raised where it exceeds 8 % of the rate, and where :math:`m \tau > 0.5`. Within 5
    standard deviations of the limit, the smoothed rate decides.

    Parameters
    ----------
    counts : (..., time, range) int32
        Sum over the shots.
    shots : (..., time) int
    range : (range,) float
        m.
    bin_width : float
        m.
    dead_time : float, optional
        s; 0 for a counter without.
    dead_time_uncertainty : float
        Relative standard error of the dead time; without a dead time, the whole correction is
        the error.
    full_overlap_range : float
        m; nearer bins are INCOMPLETE_OVERLAP.

    Returns
    -------
    Signal
        In MHz.

    Raises
    ------
    RetrievalInputError
        For counts that are not 32-bit integers, shapes that do not match, a range that is not
        finite or repeats a bin, an invalid bin width, dead time or uncertainty.

    References
    ----------
    licel2023, cox1962
    """
    grid = _grid(range)
    summed = _counts(counts, grid, shots)
    leading = summed.shape[:-1]
    fired = _per_profile(shots, "shots", leading)
    _require(0.0 < bin_width < np.inf, bin_width, "bin_width", "a positive width in m")
    dead = 0.0 if dead_time is None else dead_time
    _require(0.0 <= dead < np.inf, dead, "dead_time", "a time in s")
    relative = _relative_error(dead_time, dead_time_uncertainty)
    power, variance = np.empty(summed.shape), np.empty(summed.shape)
    quality = np.empty(summed.shape, np.int32)
    kernels.photon_profiles(
        frozen(_rows(summed)),
        frozen(fired),
        frozen(fired * (bin_width / LICEL_RANGE_PER_MICROSECOND)),
        kernels.Counter(
            dead_time=dead * 1e6,
            assumed_dead_time=(DEFAULT_DEAD_TIME if dead_time is None else dead) * 1e6,
            paralysis=THRESHOLDS.paralysis,
            pile_up=THRESHOLDS.uncorrected_pile_up if dead_time is None else THRESHOLDS.pile_up,
            # The error relative to the rate is the relative one of the dead time times x / (1 - x).
            largest_load=THRESHOLDS.largest_dead_time_error
            / (THRESHOLDS.largest_dead_time_error + relative),
            undecided=COMMON.single_bin,
        ),
        _overlap_bits(grid, full_overlap_range),
        _windows(grid, THRESHOLDS.noise_window),
        kernels.scratch(grid.size),
        _rows(power),
        _rows(variance),
        _rows(quality),
    )
    return Signal(power, variance, quality, np.ones(leading))


def dead_time_standard_error(
    dead_time: float | None, uncertainty: float = DEAD_TIME_UNCERTAINTY
) -> float:
    r"""Return the standard error of the dead time of a photon counter, s.

    It changes a corrected rate by :math:`\delta r = r^2 \delta\tau`, in all bins and profiles
    together. Without a dead time, by which nothing is corrected, it is the assumed one of 4 ns.

    Parameters
    ----------
    dead_time : float, optional
        s.
    uncertainty : float
        Relative standard error of the dead time.
    """
    assumed = DEFAULT_DEAD_TIME if dead_time is None else dead_time
    return assumed * _relative_error(dead_time, uncertainty)


def _relative_error(dead_time: float | None, uncertainty: float) -> float:
    _require(0.0 <= uncertainty <= 1.0, uncertainty, "dead_time_uncertainty", "a share from 0 to 1")
    return 1.0 if dead_time is None else uncertainty


def _require(valid: bool, value: float, name: str, expected: str) -> None:  # noqa: FBT001
    if not valid:
        raise RetrievalInputError(f"is {value}", field=name, remedy=f"give {expected}")


def _grid(range: npt.ArrayLike) -> Array:  # noqa: A002 - the field's word
    grid = inputs.real_array(range, "range").astype(np.float64)
    if grid.ndim != 1 or grid.size == 0:
        raise RetrievalInputError(
            f"has the shape {grid.shape}", field="range", remedy="give one value in m per bin"
        )
    if not np.isfinite(grid).all() or not np.diff(grid).all():
        raise RetrievalInputError(
            "is not finite, or repeats a bin", field="range", remedy="give bin centres in m"
        )
    return grid


def _counts(counts: npt.ArrayLike, grid: Array, shots: npt.ArrayLike) -> npt.NDArray[np.int32]:
    """Return counts as int32, the type of the kernels; masked ones as the lowest integer."""
    if isinstance(counts, np.ma.MaskedArray):
        masked = np.ma.getmaskarray(counts)
        counts = np.where(masked, _COUNT_LIMITS.min, counts.data.astype(np.int64))
    array = np.asarray(counts)
    if array.shape[-1:] != grid.shape or array.shape[:-1] != np.shape(shots):
        raise RetrievalInputError(
            f"counts {array.shape}, shots {np.shape(shots)} and range {grid.shape} do not match",
            field="counts",
            remedy="counts are (..., time, range), shots (..., time), range (range,)",
        )
    # Other integer types are accepted if no count exceeds 32 bits.
    if array.dtype.kind not in "iu" or not (
        np.can_cast(array.dtype, np.int32) or np.array_equal(array, array.astype(np.int32))
    ):
        raise RetrievalInputError(
            f"holds {array.dtype}, not 32-bit counts",
            field="counts",
            remedy="open the archive with mask_and_scale=False",
        )
    return np.require(array, np.int32, "A")


def _per_profile(values: npt.ArrayLike, name: str, leading: tuple[int, ...]) -> Array:
    """Return one value for each profile, (profile,)."""
    array = np.require(inputs.real_array(values, name), np.float64, "A")
    return inputs.broadcast(array, leading, name).reshape(-1)


def _per_bin(values: npt.ArrayLike | None, name: str, shape: tuple[int, ...]) -> Array:
    """Return one value for each bin, (profile or 1, bin); zeros for None."""
    if values is None:
        return np.zeros((1, shape[-1]))
    array = np.require(inputs.real_array(values, name), np.float64, "A")
    if array.shape not in (shape, shape[-1:]):
        raise RetrievalInputError(
            f"has the shape {array.shape}, the counts {shape}",
            field=name,
            remedy="give it over range, or over all axes of the counts",
        )
    return _rows(array)


def _rows(array: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
    """Return an array as (profile, bin)."""
    return array.reshape(int(np.prod(array.shape[:-1], dtype=np.int64)), array.shape[-1])


def _overlap_bits(grid: Array, full_overlap_range: float) -> Flags:
    _require(full_overlap_range < np.inf, full_overlap_range, "full_overlap_range", "a range in m")
    near = grid < full_overlap_range
    return frozen(np.where(near, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0)))


def _windows(grid: Array, window: float) -> kernels.Windows:
    """Return the smoothing window of each bin."""
    size = grid.size
    index = np.arange(size)
    steps = np.abs(np.diff(grid))
    spacing = float(np.min(steps)) if size > 1 else 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        reach = np.nan_to_num(np.abs(grid) * (window / spacing))
    half = np.clip(reach, MIN_NOISE_BINS, max(size, MIN_NOISE_BINS)).astype(np.intp)
    # A gap is where bins were not read. No window may extend across it.
    gaps = np.flatnonzero(steps > MIN_NOISE_BINS * spacing) + 1
    edges = np.concatenate([[0], gaps, [size]])
    begin, end = (np.repeat(part, np.diff(edges)) for part in (edges[:-1], edges[1:]))
    # Windows stay symmetric near the ends; a one-sided one would bias a steep signal.
    half = np.minimum(half, np.maximum(np.minimum(index - begin, end - 1 - index), MIN_NOISE_BINS))
    first, past = np.maximum(index - half, begin), np.minimum(index + half + 1, end)
    bins = (past - first).astype(np.float64)
    past[past == size] = -(-size // kernels.BLOCK) * kernels.BLOCK
    return kernels.Windows(
        frozen(first.astype(np.uint32)),
        frozen(past.astype(np.uint32)),
        frozen(bins),
    )


def _noise_model(grid: Array) -> noise_kernels.NoiseModel:
    nearest = noise_kernels.BLOCK * np.arange(noise_kernels.block_count(grid.size))
    steps = np.abs(np.diff(grid))[nearest] if nearest.size else np.ones(0)
    with np.errstate(divide="ignore"):
        # The third difference of R^-2 is 24 (h / R)^3 of the light.
        fall = 24.0 * (noise_kernels.DISTANCE * steps / grid[nearest]) ** 3
    return noise_kernels.NoiseModel(
        narrow=_windows(grid, THRESHOLDS.noise_window),
        leak=frozen(fall / np.sqrt(20.0 * THRESHOLDS.leak)),
    )


def difference_variance(power: Array, range: Array) -> Array:  # noqa: A002 - the field's word
    r"""Return the noise variance of an analog signal, estimated from third differences along range.

    Electronic noise is constant and shot noise is proportional to the light, so

    .. math:: v(R) = a + b \, (\overline{P}(R) - \overline{P}_{far}), \qquad
              \left\langle \frac{(P_i - 3 P_{i+4} + 3 P_{i+8} - P_{i+12})^2}{20} \right\rangle
              = v(R_i)

    with the smoothed signal :math:`\overline{P}` and its median :math:`\overline{P}_{far}` in the
    far half. The squares are averaged in blocks of 16. The slope :math:`b` is fitted to the blocks
    that are brighter than the drift of the baseline in the far half, and is 0 within its standard
    error; :math:`a` is fitted to all. Blocks far noisier than the line are left out. Two
    well-determined numbers give weights that do not follow the noise of the single bin. A baseline
    that drifts by as much as the light makes no noise: where the mean of a band of 32 blocks
    contradicts the line, the line is multiplied by the ratio of the two, interpolated
    logarithmically between the centres of bands.

    The estimate is exact for noise that is independent 4 bins apart and farther. Blocks in which
    the fall of the signal would count as noise are left out; where no others are bright, as before
    an opaque cloud, they give an upper bound of :math:`b`. A profile of fewer than 4 blocks in
    its far half has the mean square of third differences of neighbours in all bins.

    Parameters
    ----------
    power : (..., range) float
        NaN where unusable; blocks that include NaN are ignored.
    range : (range,) float
        m.

    Returns
    -------
    (..., range) float
        In the square of the unit of `power`; NaN for a profile without a finite difference.

    Raises
    ------
    RetrievalInputError
        For shapes that do not match, a range that is not finite or repeats a bin.
    """
    grid = _grid(range)
    profiles = np.require(inputs.real_array(power, "power"), np.float64, "A")
    if profiles.shape[-1:] != grid.shape:
        raise RetrievalInputError(
            f"has the shape {profiles.shape}, but range has {grid.size} bins",
            field="power",
            remedy="the last axis is range",
        )
    variance = np.empty(profiles.shape)
    noise_kernels.noise_profiles(
        frozen(_rows(profiles)), _noise_model(grid), kernels.scratch(grid.size), _rows(variance)
    )
    return variance

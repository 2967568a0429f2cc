r"""Reference windows: clean air by the ratio of the elastic to the Raman counts.

With the elastic signal of air :math:`\phi` for the smooth transmission and the Raman signal
:math:`y_R` over the smooth one :math:`m`, clean air has :math:`P_0 = a \phi\, y_R / m`. Compared
is

.. math:: P_0 - a \phi \left(\frac{y_R}{m} - 1\right) \quad\text{with}\quad a \phi ,

so that the noise of the fit, which tilts and lifts :math:`\phi`, is left out to the first order.
What is left is that of the counts of both signals, independent from cell to cell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.air.reference_window import THRESHOLDS as WINDOW_THRESHOLDS
from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.raman.errors import Profile
from lidarops.retrieve.raman.settings import RamanReference
from lidarops.retrieve.raman.signals import AirColumn, Cells, ChannelSignal


def choose_window(
    elastic: ChannelSignal,
    profiles: Sequence[Profile | None],
    air: AirColumn,
    cells: Cells,
    limits: RamanReference,
    ratio: float,
) -> reference_window.ReferenceWindow:
    """Return the reference windows of all profiles: of clean air, by the ratio of both signals.

    Parameters
    ----------
    elastic : ChannelSignal
    profiles : sequence of Profile or None
        None where there is no Raman signal, and no window then.
    air : AirColumn
    cells : Cells
    limits : RamanReference
        Along the beam.
    ratio : float
        Particle extinction at the Raman wavelength over that at the laser's.

    Raises
    ------
    RetrievalInputError
        Where all cells lie below the least range of the window.
    """
    candidates = _candidates(cells, limits)
    # Of cells: the tests take noise as normal, which it is not in bins of few counts.
    of_air = cells.mean(air.backscatter * air.elastic_shape)
    power, bins = cells.mean(elastic.power), np.maximum(cells.known(elastic.power), 1.0)
    variance = cells.mean(elastic.variance) / bins
    shape = np.tile(of_air, (len(profiles), 1))
    background = np.nan_to_num(elastic.background_standard_error)
    baseline = cells.mean(np.broadcast_to(elastic.baseline_error, elastic.power.shape))
    baseline = np.nan_to_num(baseline)
    inside = (cells.range >= candidates[:, :1]) & (cells.range <= candidates[:, 1:])
    for number, profile in enumerate(profiles):
        if profile is None:
            power[number] = np.nan
            continue
        raman, fit = profile.raman, profile.fit
        power[number, ~fit.certain] = np.nan
        # Of the fit, only the small difference of both transmissions is used.
        mean = np.exp(-fit.depth)
        per_raman = of_air * np.exp((1.0 - 2.0 / (1.0 + ratio)) * fit.depth)
        # For the smooth signal: by the observed one, low counts would weigh more.
        noise = raman.noise.of(mean)
        level = _level(
            inside,
            power[number],
            variance[number],
            per_raman * raman.value,
            per_raman**2 * noise,
        )
        away = level * per_raman * (raman.value - mean)
        shape[number] = per_raman * mean
        power[number] -= away
        # Where there are no data, noise is infinite: neither it nor its product with 0 is used.
        with np.errstate(invalid="ignore"):
            variance[number] += (level * per_raman) ** 2 * noise
        # Over air, both signals have nearly the same shape, so that backgrounds are alike too.
        shift = level * (per_raman * raman.background)[inside.any(axis=0)].mean()
        background[number] = np.hypot(background[number], shift)
        shift = np.nan_to_num(level * per_raman * raman.baseline)
        baseline[number] = np.hypot(baseline[number], shift)
    return reference_window.choose_reference(
        power,
        cells.range,
        variance,
        molecular_attenuated=shape,
        candidates=candidates,
        background_standard_error=background,
        baseline_standard_error=baseline,
    )


def _candidates(cells: Cells, limits: RamanReference) -> Array:
    highest = min(limits.highest, float(cells.range[-1]))
    if not highest > limits.lowest:
        raise RetrievalInputError(
            f"the last cell at {highest:g} m is nearer than the reference window, which begins at"
            f" {limits.lowest:g} m or beyond",
            field="highest",
            remedy="give a farther range, smaller cells or a nearer window",
        )
    width = min(limits.width, highest - limits.lowest)
    step = limits.width / WINDOW_THRESHOLDS.steps_per_window
    return reference_window.candidate_windows(limits.lowest, highest, width, step)


def _level(
    windows: Booleans,
    power: Array,
    variance: Array,
    expected: Array,
    expected_variance: Array,
) -> float:
    """Return the ratio of the elastic signal over that of air, of the window with the lowest bound.

    The bound is the upper one, as in the choice of the window. 0 where there is no signal.

    Parameters
    ----------
    windows : (window, cell) bool
    power, variance, expected, expected_variance : (cell,) float
        Of the elastic signal, and of that of air by the Raman signal of the cell.
    """
    known = np.isfinite(power) & np.isfinite(expected)
    sums = [
        windows[:, known] @ values[known]
        for values in (power, expected, variance, expected_variance)
    ]
    lit = sums[1] > 0.0
    if not lit.any():
        return 0.0
    of_power, of_air, noise, noise_of_air = (values[lit] for values in sums)
    ratio = of_power / of_air
    error = np.sqrt(noise + ratio**2 * noise_of_air) / of_air
    return float(ratio[np.argmin(ratio + COMMON.significant * error)])

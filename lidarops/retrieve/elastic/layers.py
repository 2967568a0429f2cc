"""Detection of clouds and other layers with a steep base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen
from lidarops.retrieve.elastic import _layer_search

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

DEFAULT_SCALES: Final = (60.0, 120.0, 240.0, 480.0)
"""m; lengths of the windows in which signals are averaged below and above a base."""

CLOUD_CONTRAST: Final = 3.0
"""Factor of the rise. At visible wavelengths the scattering ratio of aerosol rarely rises by this
factor within 500 m; that of thin cirrus does. In the near infrared, where air scatters little,
choose a larger one."""


@dataclass(frozen=True, slots=True)
class Layers:
    """Layers of each profile, with the leading axes of the power."""

    cloud_base_range: Array
    """m, of the first bin of the lowest layer; NaN where there is none."""
    cloud_top_range: Array
    """m, apparent top: its last bin before the signal is back at its level below the base. In a
    layer that attenuates strongly this is below the true top."""
    contrast: Array
    """Ratio of the power to the molecular shape above the base over that below, lowest layer."""
    significance: Array
    """Standard errors by which the rise exceeds the requested factor, of the lowest layer."""
    mask: Mask
    """(..., range): bins from base to apparent top, of all layers."""
    cloudy: Mask
    opaque: Mask
    """No signal of air above the highest layer: it is below 3 standard errors, or below 1 percent
    of the level below the lowest layer, in the farthest window where noise would let a tenth of
    that level be seen, or there is no such window."""


def find_layers(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    molecular_attenuated: npt.ArrayLike,
    contrast: float = CLOUD_CONTRAST,
    scales: npt.ArrayLike = DEFAULT_SCALES,
    false_alarm: float = 0.01,
) -> Layers:
    r"""Return layers at whose base the scattering ratio rises by more than a factor.

    Let :math:`\rho = \sum P / \sum \phi` be the ratio of the power to the molecular shape in two
    adjoining windows, below and above a bin. The bin is a base where

    .. math:: \frac{\rho_+ - c \rho_-}{\sqrt{\sigma_+^2 + c^2 \sigma_-^2}} > t

    for at least one length of the windows. This tests the hypothesis that the ratio rises by no
    more than the factor :math:`c`. If that holds everywhere, whatever the aerosol, a profile is
    flagged with a probability below `false_alarm`, because :math:`t` is the quantile of the
    normal distribution for `false_alarm` over the number of bins and lengths (Bonferroni bound).
    The base is where the statistic peaks. The top is where the mean of the next window is again
    within 2 standard errors of the level below the base.

    A layer that begins within one window of the first bin is not detected. With a `contrast` of
    1 all layers are detected that rise significantly.

    Parameters
    ----------
    power : (..., range) float
        Any unit, background subtracted, not range-corrected; NaN where missing or where the
        overlap is incomplete.
    range : (range,) float
        m, uniform or nearly so.
    variance : (..., range) float
        Noise variance in the square of the power's unit, broadcast against `power`.
    molecular_attenuated : (..., range) float
        The shape :math:`\phi = \beta_m T_m^2 / R^2` times any constant, broadcast against
        `power`.
    contrast : float
        The factor :math:`c`, at least 1.
    scales : (scale,) float
        m, lengths of the windows; a window has at least two bins.
    false_alarm : float
        Probability of a false detection in a whole profile.

    Returns
    -------
    Layers

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    pal1992, wang2001.
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    noise = inputs.variance_rows(variance, grid, leading)
    shape = inputs.noise_rows(molecular_attenuated, "molecular_attenuated", grid, leading)
    if not np.all(shape >= 0.0) or np.any(np.isinf(shape)):
        raise RetrievalInputError(
            "is negative or not finite",
            field="molecular_attenuated",
            remedy="give a value for each bin",
        )
    if not 1.0 <= contrast < np.inf:
        raise RetrievalInputError(f"is {contrast}", field="contrast", remedy="give 1 or more")
    if not 0.0 < false_alarm < 1.0:
        raise RetrievalInputError(
            f"is {false_alarm}", field="false_alarm", remedy="give a probability"
        )
    lengths = _lengths(scales, grid)
    mask = np.zeros(rows.shape, dtype=np.bool_)
    opaque = np.zeros(rows.shape[0], dtype=np.bool_)
    lowest_layer = np.full((rows.shape[0], _layer_search.FIELDS), np.nan)
    threshold = -float(ndtri(false_alarm / (grid.size * lengths.size)))
    _layer_search.detect_rises(
        frozen(rows),
        frozen(noise),
        frozen(shape),
        lengths,
        float(contrast),
        threshold,
        mask,
        lowest_layer,
        opaque,
    )
    cloudy = np.isfinite(lowest_layer[:, _layer_search.BASE])
    first = np.where(cloudy, lowest_layer[:, _layer_search.BASE], 0.0).astype(np.int64)
    stop = np.where(cloudy, lowest_layer[:, _layer_search.TOP], 1.0).astype(np.int64)
    return Layers(
        cloud_base_range=np.where(cloudy, grid.values[first], np.nan).reshape(leading),
        cloud_top_range=np.where(cloudy, grid.values[stop - 1], np.nan).reshape(leading),
        contrast=lowest_layer[:, _layer_search.CONTRAST].reshape(leading),
        significance=lowest_layer[:, _layer_search.SIGNAL].reshape(leading),
        mask=grid.turn(mask.reshape(*leading, grid.size)),
        cloudy=cloudy.reshape(leading),
        opaque=opaque.reshape(leading),
    )


def _lengths(scales: npt.ArrayLike, grid: inputs.RangeGrid) -> npt.NDArray[np.int64]:
    lengths = np.atleast_1d(inputs.real_array(scales, "scales").astype(np.float64))
    if lengths.ndim != 1 or lengths.size == 0 or not np.all((lengths > 0.0) & (lengths < np.inf)):
        raise RetrievalInputError("holds no lengths", field="scales", remedy="give m")
    step = float(np.median(np.diff(grid.values))) if grid.size > 1 else 1.0
    return np.unique(np.maximum(np.rint(lengths / step), 2.0)).astype(np.int64)

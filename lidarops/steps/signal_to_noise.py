"""Mark values below their noise, so that they can be told from significant ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidarops.flags import Quality


def with_low_signal_to_noise(rows: xr.Dataset, names: Sequence[str], least: float) -> xr.Dataset:
    """Return rows with the bit LOW_SIGNAL_TO_NOISE where a value is small against its error.

    Parameters
    ----------
    rows : xr.Dataset
        With the variables, their standard errors and ``quality_flag``, of the same dimensions.
    names : sequence of str
        Variables, one of which is enough.
    least : float
        Least ratio of a value to its standard error without the bit; 0 for no bit.
    """
    low = xr.zeros_like(rows["quality_flag"], dtype=np.bool_)
    for name in names:
        low = low | (abs(rows[name]) < least * rows[f"{name}_standard_error"])
    bit = low.astype(np.int32) * np.int32(Quality.LOW_SIGNAL_TO_NOISE)
    return rows.assign(quality_flag=rows["quality_flag"] | bit)

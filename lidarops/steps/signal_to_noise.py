"""Mark values below their noise, so that they can be told from significant ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.netcdf.variables import whole_error


def with_low_signal_to_noise(rows: xr.Dataset, names: Sequence[str], least: float) -> xr.Dataset:
    """Return rows with the bit LOW_SIGNAL_TO_NOISE where a value is small against its error.

    Parameters
    ----------
    rows : xr.Dataset
        With the variables, their standard errors, the errors by dead time and baseline beside these
        where there are some, and ``quality_flag``, of the same dimensions.
    names : sequence of str
        Variables, one of which is enough.
    least : float
        Least ratio of a value to its error without the bit; 0 for no bit.
    """
    dims, flags = rows["quality_flag"].dims, rows["quality_flag"].to_numpy()
    low = np.zeros(flags.shape, dtype=np.bool_)
    for name in names:
        value = rows[name].transpose(*dims).to_numpy()
        low |= np.abs(value) < least * whole_error(rows, name).transpose(*dims).to_numpy()
    bit = low * np.int32(Quality.LOW_SIGNAL_TO_NOISE)
    return rows.assign(quality_flag=rows["quality_flag"].copy(data=flags | bit))

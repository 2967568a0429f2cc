"""Masks values by ``usable``, the summary of the quality bits."""

from __future__ import annotations

from typing import Final

import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.netcdf.variables import (
    USABLE,
)

GOOD: Final = 0
CARE: Final = 1
REJECTED: Final = 2


def masked(data: xr.Dataset, worst: int) -> xr.Dataset:
    """Set values to missing whose ``usable`` is worse than `worst`.

    Parameters
    ----------
    data : xr.Dataset
        With ``usable``.
    worst : int
        0 keeps unflagged values, 1 also those to use with care, 2 all values.

    Returns
    -------
    xr.Dataset
        Floating-point variables with the dimensions of ``usable`` are masked; flags are not.

    Raises
    ------
    RetrievalInputError
        If `worst` is not 0, 1 or 2.
    """
    if worst not in (GOOD, CARE, REJECTED):
        raise RetrievalInputError(
            f"is {worst!r}",
            field="usable",
            remedy="0 keeps unflagged values, 1 also those to use with care, 2 all values",
        )
    if worst == REJECTED:
        return data
    quality = data[USABLE]
    kept = quality <= worst
    masked_values = {
        name: variable.where(kept)
        for name, variable in data.data_vars.items()
        if variable.dtype.kind == "f" and variable.dims == quality.dims
    }
    return data.assign(masked_values)

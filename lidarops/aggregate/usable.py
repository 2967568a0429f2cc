"""Which values can be used: the summary of the quality bits, and its use as a mask."""

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
    """Make values missing whose ``usable`` is worse than asked for.

    Parameters
    ----------
    data : xr.Dataset
        With ``usable``.
    worst : int
        0 keeps what no test flagged, 1 also what asks for care, 2 everything.

    Returns
    -------
    xr.Dataset
        The floating-point variables of the dimensions of ``usable`` are masked; flags stay.

    Raises
    ------
    RetrievalInputError
        If `worst` is none of these.
    """
    if worst not in (GOOD, CARE, REJECTED):
        raise RetrievalInputError(
            f"is {worst!r}",
            field="usable",
            remedy="0 keeps what no test flagged, 1 also what asks for care, 2 everything",
        )
    if worst == REJECTED:
        return data
    judged = data[USABLE]
    kept = judged <= worst
    changed = {
        name: variable.where(kept)
        for name, variable in data.data_vars.items()
        if variable.dtype.kind == "f" and variable.dims == judged.dims
    }
    return data.assign(changed)

"""Read-only contiguous arrays, the one array type that compiled functions receive."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from lidarops.retrieve.common.arrays import Block

_Array = TypeVar("_Array", bound=Block)


def frozen(values: _Array) -> _Array:
    """Return a contiguous read-only view; copy only where necessary.

    Numba treats writable and read-only arrays as different types, and would compile a function
    again for every combination of them.
    """
    view: Any = np.ascontiguousarray(values).view()
    view.flags.writeable = False
    return view  # type: ignore[no-any-return]

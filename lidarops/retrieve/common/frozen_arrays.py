"""Arrays as compiled functions get them: one type, whoever made them."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

_Array = TypeVar("_Array", bound=npt.NDArray[Any])


def frozen(values: _Array) -> _Array:
    """Return a contiguous view that cannot be written to, copied only where it must be.

    A compiled function takes what can be written to and what cannot for different types, and
    would be compiled anew for every mixture of them.
    """
    view: Any = np.ascontiguousarray(values).view()
    view.flags.writeable = False
    return view  # type: ignore[no-any-return]

"""Types of arrays that retrievals take and return."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Block = npt.NDArray[Any]
Singles = npt.NDArray[np.float32]
Floats = Singles | Array
Booleans = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.int32]
"""Quality bits."""
Codes = npt.NDArray[np.uint8]

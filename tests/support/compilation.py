"""Compile what tests call of the homogeneous retrieval and products do not need.

``python -m support.compilation``, after ``lidarops compile``: otherwise each process of a test run
that comes to it first compiles for a minute.
"""

from __future__ import annotations

from itertools import product
from typing import Any, Final

import numpy as np

from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

_NEEDED: Final[dict[str, dict[str, Any]]] = {
    "linearized": {"extinction": 1e-4},
    "known_extinction": {"extinction": 1e-4},
    "known_background": {"background": 1.0},
}


def compile_methods() -> None:
    """Fit a path by every method, in both precisions."""
    range_ = np.linspace(2500.0, 10_500.0, 225)
    power = 1.0 + np.exp(-2e-4 * range_) * (2500.0 / range_) ** 2 + np.zeros((2, 1))
    for method, dtype in product(HomogeneousMethod, (np.float32, np.float64)):
        arguments = _NEEDED.get(method.value, {})
        fit_homogeneous_path(power.astype(dtype), range_, method=method.value, **arguments)


if __name__ == "__main__":
    compile_methods()

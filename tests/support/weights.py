"""A homogeneous path that is fitted with weights."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarops.retrieve.homogeneous.path_fit import Noise


def by_weights(weights: Any, correlation_length: Any = 1.0) -> dict[str, Any]:
    """Return the arguments of a fit in which bins have weights, without those of weight 0."""
    with np.errstate(divide="ignore"):
        variance = 1.0 / np.asarray(weights, dtype=np.float64)
    return {"variance": variance, "noise": Noise(True, correlation_length)}

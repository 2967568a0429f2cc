"""Background of a profile: the power that a recorder shows without backscatter.

`estimate` gives background, standard error and flags by one of three methods, and judges how much
signal may have been subtracted with the background. The methods alone:
`tail_mean` averages the far bins, `cubic` solves the cubic of a homogeneous path in closed form,
`fit_known_shape` fits background and amplitude of clear air (`molecular_shape`). Kernels are in the
modules with an underscore.
"""

from lidarops.retrieve.background.cubic_and_tail import BackgroundResult, cubic, tail_mean
from lidarops.retrieve.background.known_shape import (
    KnownShapeResult,
    fit_known_shape,
    molecular_shape,
)

__all__ = [
    "BackgroundResult",
    "KnownShapeResult",
    "cubic",
    "fit_known_shape",
    "molecular_shape",
    "tail_mean",
]

"""Multi-angle retrieval: optical depth and extinction from scans at several zenith angles.

A scan passes through these modules in order:

1. `labeled_altitudes.AltitudeCycles` takes the conditioned profiles of a scene. `scan_cycles`
   groups them into directions and cycles. The background is subtracted, and `_cell_means`
   averages each beam over altitude cells.
2. `optical_depth.retrieve_optical_depth` solves the cycles as one block.
   `_block` takes the logarithms and, with `_kano_hamilton`, fits them against the slant
   path (`slant_paths`) at each altitude.
3. Method "joint": `smooth_profile` combines the optical depths of single altitudes into one profile
   with smooth extinction. Methods "mld" and "mld_prior": `mld` differentiates the logarithm along
   the slant path with regularisation (the historical method), each altitude on its own.
4. `optical_depth` adds extinction, errors and flags. `_horizontal_variation` tests whether the
   air is horizontally stratified.
5. `labeled.retrieve_optical_depth` repeats this with the backgrounds with which the beams agree
   best (`beam_backgrounds`), and turns the result into the ``multiangle`` product.
"""

from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.optical_depth import (
    MultiAngleMethod,
    MultiAngleResult,
    OpticalDepthSettings,
    retrieve_optical_depth,
)

__all__ = [
    "MultiAngleMethod",
    "MultiAngleQuality",
    "MultiAngleResult",
    "OpticalDepthSettings",
    "retrieve_optical_depth",
]

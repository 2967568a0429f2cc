"""Background, amplitude and extinction of a homogeneous path.

`fit_homogeneous_path` (`path_fit`) checks its input and passes a `_problem.PathProblem` to the
solver of the chosen `HomogeneousMethod`. Its kernels are in `_direct`: least squares by Newton
steps over the bins (`_projection`), or with a given background, extinction or prior.

`_fit_quality` sums the residuals, estimates the noise and sets the quality bits.

`labeled.fit_homogeneous_path` does the same on `xarray` data; import it from its module, so that
the numerics stay free of xarray.
"""

from lidarops.retrieve.homogeneous.path_fit import (
    HomogeneousMethod,
    HomogeneousResult,
    Noise,
    fit_homogeneous_path,
)

__all__ = ["HomogeneousMethod", "HomogeneousResult", "Noise", "fit_homogeneous_path"]

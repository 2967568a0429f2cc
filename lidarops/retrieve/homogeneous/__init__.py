"""Background, amplitude and extinction of a homogeneous path.

`fit_homogeneous_path` (`path_fit`) checks its input and passes a `_problem.PathProblem` to the
solver of the chosen `HomogeneousMethod` in `_methods`:

1. `_direct`: least squares by Newton steps over the bins (`_projection`).
2. `_methods`: with a given background, extinction or prior.

`_misfit` sums the residuals, `_fit_quality` estimates the noise and sets the quality bits.

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

"""Background, amplitude and extinction of a homogeneous path.

`fit_homogeneous_path` checks its input (`path_fit`), cuts the sections (`_sections`) and passes a
`_problem.PathProblem` to the solver of the chosen `HomogeneousMethod`:

1. `_routing`: the default. Profiles without gaps are solved from a few linear functionals
   (`_functional_tables`, `_compressed`), all others by Newton steps over their bins (`_masked`).
2. `_methods`: the direct fit (`_direct`), which serves as reference, and the variants with a
   prior, a known background or a known extinction.
3. `_fit_quality` judges the residuals, estimates the noise and sets the quality bits.
4. `_robust` repeats the fit without outlying bins, where requested.

`labeled.fit_homogeneous_path` does the same on `xarray` data; import it from its module, so that
the numerics stay free of xarray.
"""

from lidarops.retrieve.homogeneous.path_fit import (
    HomogeneousMethod,
    HomogeneousResult,
    fit_homogeneous_path,
)

__all__ = ["HomogeneousMethod", "HomogeneousResult", "fit_homogeneous_path"]

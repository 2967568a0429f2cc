"""Visibility over xarray: `lidarops.retrieve.air.visibility` of extinction with two kinds of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.retrieve.air import visibility

Array = npt.NDArray[np.float64]

NAMES: Final = (
    "visibility_in_air",
    "visibility_in_air_standard_error",
    "visibility_in_air_lower",
    "visibility_in_air_upper",
)


@dataclass(frozen=True, slots=True)
class Definition:
    """What visibility is."""

    wavelength: float
    """m, of extinction."""
    contrast: float = visibility.MOR_CONTRAST
    law: str = "none"
    """How extinction is brought to 550 nm."""
    angstrom_exponent: float | None = None
    exponent_standard_error: float = 0.0
    """Of the law's exponent of wavelength."""

    @property
    def words(self) -> str:
        """What visibility is, in words."""
        colour = f"at {self.wavelength * 1e9:g} nm"
        if self.law != visibility.WavelengthLaw.NONE:
            colour = f"brought from {self.wavelength * 1e9:g} to 550 nm by the law {self.law}"
        if self.angstrom_exponent is not None:
            colour += f" with the exponent {self.angstrom_exponent:g}"
        return f"visibility by the contrast {self.contrast:.6g} from extinction {colour}"


def visibility_of_extinction(
    extinction: xr.DataArray,
    standard_error: xr.DataArray,
    systematic_error: xr.DataArray,
    definition: Definition,
) -> xr.Dataset:
    """Return visibility, its random standard error, and its interval by all errors.

    Parameters
    ----------
    extinction, standard_error, systematic_error : xr.DataArray
        m-1, in memory.
    definition : Definition

    Returns
    -------
    xr.Dataset
        ``visibility_in_air``, ``visibility_in_air_standard_error``, ``visibility_in_air_lower``
        and ``visibility_in_air_upper``, m: NaN where extinction is missing or not positive. The
        interval is that of extinction plus and minus the root of the sum of squares of both
        errors, turned over; its upper end is inf where that reaches zero.

    Raises
    ------
    RetrievalInputError
        For a contrast, law or wavelength that cannot be right.
    """
    found = xr.apply_ufunc(
        _seen,
        extinction,
        standard_error,
        systematic_error,
        output_core_dims=[[]] * len(NAMES),
        kwargs={"definition": definition},
    )
    return xr.Dataset(dict(zip(NAMES, found, strict=True)))


def _seen(
    extinction: npt.NDArray[Any],
    standard_error: npt.NDArray[Any],
    systematic_error: npt.NDArray[Any],
    definition: Definition,
) -> tuple[Array, ...]:
    whole = np.hypot(standard_error.astype(np.float64), systematic_error)
    first, last = (
        _from(extinction, error, spread, definition)
        for error, spread in (
            (standard_error, 0.0),
            (whole, definition.exponent_standard_error),
        )
    )
    return (
        first.visibility,
        first.visibility_standard_error,
        last.visibility_lower,
        # Where nothing is seen, no limit of it is.
        np.where(np.isfinite(first.visibility), last.visibility_upper, np.nan),
    )


def _from(
    extinction: npt.NDArray[Any], error: npt.NDArray[Any], spread: float, definition: Definition
) -> visibility.VisibilityResult:
    brought = visibility.at_reference_wavelength(
        extinction,
        error,
        wavelength=definition.wavelength,
        law=definition.law,
        exponent=definition.angstrom_exponent,
        exponent_standard_error=spread,
    )
    return visibility.visibility_from_extinction(
        brought.extinction, brought.extinction_standard_error, contrast=definition.contrast
    )

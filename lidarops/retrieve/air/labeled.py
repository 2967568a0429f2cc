"""Visibility over xarray, from extinction with a random and a systematic error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr

from lidarops.retrieve.air import visibility
from lidarops.retrieve.common.arrays import Array, Block

NAMES: Final = (
    "visibility_in_air",
    "visibility_in_air_standard_error",
    "visibility_in_air_lower",
    "visibility_in_air_upper",
)


@dataclass(frozen=True, slots=True)
class VisibilityDefinition:
    """Definition of visibility: wavelength of extinction, contrast threshold, wavelength law."""

    wavelength: float
    """m, at which extinction is measured."""
    contrast: float = visibility.MOR_CONTRAST
    law: str = "none"
    """Law that converts extinction to 550 nm."""
    angstrom_exponent: float | None = None
    exponent_standard_error: float = 0.0
    """Standard error of the exponent of the law."""

    @property
    def words(self) -> str:
        """The definition in words, for attributes."""
        extinction = f"extinction at {self.wavelength * 1e9:g} nm"
        if self.law != visibility.WavelengthLaw.NONE:
            exponent = self.angstrom_exponent
            detail = "" if exponent is None else f", exponent {exponent:g}"
            extinction += f" converted to 550 nm (law {self.law}{detail})"
        return f"visibility for contrast {self.contrast:.6g}, from {extinction}"


def visibility_of_extinction(
    extinction: xr.DataArray,
    standard_error: xr.DataArray,
    systematic_error: xr.DataArray,
    definition: VisibilityDefinition,
) -> xr.Dataset:
    """Return visibility, its random standard error, and its interval from both errors.

    Parameters
    ----------
    extinction, standard_error, systematic_error : xr.DataArray
        m-1, in memory.
    definition : VisibilityDefinition

    Returns
    -------
    xr.Dataset
        ``visibility_in_air``, ``visibility_in_air_standard_error``, ``visibility_in_air_lower``
        and ``visibility_in_air_upper``, m: NaN where extinction is missing or not positive. The
        interval follows from extinction plus and minus the root of the sum of squares of both
        errors; its upper end is inf where that reaches zero.

    Raises
    ------
    RetrievalInputError
        For an invalid contrast, law or wavelength.
    """
    values = xr.apply_ufunc(
        _visibility,
        extinction,
        standard_error,
        systematic_error,
        output_core_dims=[[]] * len(NAMES),
        kwargs={"definition": definition},
    )
    return xr.Dataset(dict(zip(NAMES, values, strict=True)))


def _visibility(
    extinction: Block,
    standard_error: Block,
    systematic_error: Block,
    definition: VisibilityDefinition,
) -> tuple[Array, ...]:
    total_error = np.hypot(standard_error.astype(np.float64), systematic_error)
    random, total = (
        _at_550_nm(extinction, error, spread, definition)
        for error, spread in (
            (standard_error, 0.0),
            (total_error, definition.exponent_standard_error),
        )
    )
    return (
        random.visibility,
        random.visibility_standard_error,
        total.visibility_lower,
        # No limit without a visibility.
        np.where(np.isfinite(random.visibility), total.visibility_upper, np.nan),
    )


def _at_550_nm(
    extinction: Block,
    error: Block,
    spread: float,
    definition: VisibilityDefinition,
) -> visibility.VisibilityResult:
    at_reference = visibility.at_reference_wavelength(
        extinction,
        error,
        wavelength=definition.wavelength,
        law=definition.law,
        exponent=definition.angstrom_exponent,
        exponent_standard_error=spread,
    )
    return visibility.visibility_from_extinction(*at_reference, contrast=definition.contrast)

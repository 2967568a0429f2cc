"""Meteorological visibility from extinction: conversion to 550 nm and Koschmieder's law.

`visibility_of_extinction` does both, with a random and a systematic error.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Block

MOR_CONTRAST: Final = 0.05
"""Contrast threshold of the meteorological optical range (`wmo8`): V = ln 20 / extinction."""
KOSCHMIEDER_CONTRAST: Final = 0.02
"""Koschmieder's own threshold: V = 3.912 / extinction (`koschmieder1924`)."""
PAPER_CONTRAST: Final = float(np.exp(-3.0))
"""The rounded constant of the multi-position papers: V = 3 / extinction (`drabenko2021`)."""

REFERENCE_WAVELENGTH: Final = 550e-9
"""m, where visibility is defined."""
LARGEST_EXTINCTION: Final = 10.0
"""m-1, ten times that of the densest smoke; larger values must be in km-1."""

_KRUSE_NEAR: Final = 6000.0
_KRUSE_FAR: Final = 50_000.0
"""m of visibility, where the exponent of `kruse1962` changes."""
_KRUSE_SLOPE: Final = 0.585
_KRUSE_MIDDLE: Final = 1.3
_KRUSE_CLEAR: Final = 1.6
"""Exponent below, between and above: the first times the cube root of the visibility in km."""
_SHORTEST: Final = 200e-9
_LONGEST: Final = 2e-6
"""m, wavelengths for which the laws are taken to hold. Assumed."""
_KRUSE_PASSES: Final = 60
"""Passes of a fixed-point iteration that contracts by at least 0.7 per pass from 200 nm to 2 um."""


class WavelengthLaw(StrEnum):
    """Dependence of extinction on wavelength."""

    NONE = "none"
    """Visibility at the wavelength of the lidar."""
    ANGSTROM = "angstrom"
    """A power of wavelength with a given exponent."""
    KRUSE = "kruse"
    """A power of wavelength with an exponent that depends on visibility (`kruse1962`)."""


@dataclass(frozen=True, slots=True)
class VisibilityDefinition:
    """Definition of visibility: wavelength of extinction, contrast threshold, wavelength law."""

    wavelength: float
    """m, at which extinction is measured."""
    contrast: float = MOR_CONTRAST
    law: str = "none"
    """Law that converts extinction to 550 nm."""
    angstrom_exponent: float | None = None
    exponent_standard_error: float = 0.0
    """Standard error of the exponent of the law."""

    @property
    def words(self) -> str:
        """The definition in words, for attributes."""
        extinction = f"extinction at {self.wavelength * 1e9:g} nm"
        if self.law != WavelengthLaw.NONE:
            exponent = self.angstrom_exponent
            detail = "" if exponent is None else f", exponent {exponent:g}"
            extinction += f" converted to 550 nm (law {self.law}{detail})"
        return f"visibility for contrast {self.contrast:.6g}, from {extinction}"


@dataclass(frozen=True, slots=True)
class VisibilityResult:
    """Visibility, with the shape of the extinction."""

    visibility: Array
    """m; NaN where extinction is missing or not positive."""
    visibility_standard_error: Array
    """m, to first order; where extinction is off by a tenth or more, use the interval."""
    visibility_lower: Array
    """m, of extinction plus its standard error."""
    visibility_upper: Array
    """m, of extinction minus its standard error; inf where that is not positive."""


def visibility_of_extinction(
    extinction: Block,
    standard_error: Block,
    systematic_error: Block,
    definition: VisibilityDefinition,
) -> dict[str, Array]:
    """Return visibility, its random standard error, and its interval from both errors, by name.

    Parameters
    ----------
    extinction, standard_error, systematic_error : (...) float
        m-1.
    definition : VisibilityDefinition

    Returns
    -------
    dict of str to (...) float
        ``visibility_in_air``, ``visibility_in_air_standard_error``, ``visibility_in_air_lower``
        and ``visibility_in_air_upper``, m: NaN where extinction is missing or not positive. The
        interval follows from extinction plus and minus the root of the sum of squares of both
        errors; its upper end is inf where that reaches zero.

    Raises
    ------
    RetrievalInputError
        For an invalid contrast, law or wavelength.
    """
    total_error = np.hypot(standard_error.astype(np.float64), systematic_error)
    spread = definition.exponent_standard_error
    random, total = (
        visibility_from_extinction(
            *at_reference_wavelength(
                extinction,
                error,
                wavelength=definition.wavelength,
                law=definition.law,
                exponent=definition.angstrom_exponent,
                exponent_standard_error=of_exponent,
            ),
            contrast=definition.contrast,
        )
        for error, of_exponent in ((standard_error, 0.0), (total_error, spread))
    )
    # No limit without a visibility.
    upper = np.where(np.isfinite(random.visibility), total.visibility_upper, np.nan)
    return {
        "visibility_in_air": random.visibility,
        "visibility_in_air_standard_error": random.visibility_standard_error,
        "visibility_in_air_lower": total.visibility_lower,
        "visibility_in_air_upper": upper,
    }


def koschmieder_constant(contrast: float = MOR_CONTRAST) -> float:
    """Return the product of visibility and extinction, -ln(contrast).

    Raises
    ------
    RetrievalInputError
        Where the contrast is not between 0 and 1.
    """
    if not 0.0 < contrast < 1.0:
        raise RetrievalInputError(
            f"is {contrast}",
            field="contrast",
            remedy="choose 0.05 (meteorological optical range), 0.02 or exp(-3)",
        )
    return -float(np.log(contrast))


def visibility_from_extinction(
    extinction: npt.ArrayLike,
    standard_error: npt.ArrayLike | None = None,
    *,
    contrast: float = MOR_CONTRAST,
) -> VisibilityResult:
    r"""Return the distance at which the contrast of a black object falls to a threshold.

    .. math:: V = -\ln(\epsilon) / \sigma

    The interval of visibility follows from that of extinction. The standard error is its
    half-width to first order only.

    Parameters
    ----------
    extinction : (...) float
        m-1, of a homogeneous path or at a point.
    standard_error : (...) float, optional
        m-1, broadcast against `extinction`; NaN errors where not given.
    contrast : float
        Threshold: 0.05 (meteorological optical range, the default), 0.02, or exp(-3).

    Raises
    ------
    RetrievalInputError
        For a contrast not between 0 and 1, negative errors, shapes that do not fit, or
        extinction above 10 m-1, which must be in km-1.

    References
    ----------
    koschmieder1924, wmo8.
    """
    constant = koschmieder_constant(contrast)
    value, error = _checked(extinction, standard_error)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        positive = np.isfinite(value) & (value > 0)
        visibility = np.where(positive, constant / value, np.nan)
        relative = error / value
        most, least = value + error, value - error
        lower = np.where(most > 0, constant / most, np.nan)
        upper = np.where(least > 0, constant / least, np.where(np.isnan(least), np.nan, np.inf))
    return VisibilityResult(
        visibility=visibility,
        visibility_standard_error=visibility * relative,
        visibility_lower=lower,
        visibility_upper=upper,
    )


def at_reference_wavelength(
    extinction: npt.ArrayLike,
    standard_error: npt.ArrayLike | None = None,
    *,
    wavelength: float,
    law: str,
    exponent: npt.ArrayLike | None = None,
    exponent_standard_error: float = 0.0,
) -> tuple[Array, Array]:
    r"""Return extinction at 550 nm and its standard error, from that at another wavelength.

    .. math:: \sigma_{550} = \sigma_\lambda (\lambda / 550\,\mathrm{nm})^{q}

    Kruse's exponent depends on the visibility V (contrast 0.02) itself: q = 1.6 above 50 km,
    1.3 from 6 km, 0.585 (V / km)^(1/3) below, so that V follows from an implicit equation. The
    law jumps at 6 and 50 km. Where no branch holds (beyond 550 nm), visibility is that of the
    jump; where two hold, the lower visibility is taken.

    Parameters
    ----------
    extinction, standard_error : (...) float
        m-1.
    wavelength : float
        m.
    law : {"none", "angstrom", "kruse"}
    exponent : (...) float, optional
        Angstrom exponent, for "angstrom" only.
    exponent_standard_error : float
        Standard error of the exponent, or spread of the exponent of the law; propagated.

    Returns
    -------
    extinction, standard_error : (...) float
        m-1.

    Raises
    ------
    RetrievalInputError
        For an unknown law, a wavelength outside 200 nm to 2 um, or an exponent that is missing
        or does not apply.

    References
    ----------
    kruse1962, angstrom1929.
    """
    value, error = _checked(extinction, standard_error)
    chosen = inputs.choice(law, WavelengthLaw, "law")
    if not _SHORTEST <= wavelength <= _LONGEST:
        raise RetrievalInputError(
            f"is {wavelength:g} m", field="wavelength", remedy="give metres, 200e-9 to 2e-6"
        )
    if (exponent is None) == (chosen is WavelengthLaw.ANGSTROM):
        raise RetrievalInputError(
            f"belongs to the law 'angstrom' only, which requires it; the law is '{chosen}'",
            field="exponent",
        )
    if not exponent_standard_error >= 0:
        raise RetrievalInputError("is negative or NaN", field="exponent_standard_error")
    logarithm = float(np.log(wavelength / REFERENCE_WAVELENGTH))
    gain = np.ones(value.shape)
    if chosen is WavelengthLaw.NONE:
        power, logarithm = np.zeros(value.shape), 0.0
    elif chosen is WavelengthLaw.ANGSTROM:
        given = inputs.real_array(np.nan if exponent is None else exponent, "exponent")
        power = inputs.broadcast(given, value.shape, "exponent").astype(np.float64)
    else:
        power, gain = _kruse(value, logarithm)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        factor = np.exp(power * logarithm)
        spread = value * factor * logarithm * exponent_standard_error
        total = np.hypot(factor * gain * error, gain * spread)
    return value * factor, total


def _kruse(extinction: Array, logarithm: float) -> tuple[Array, Array]:
    """Return Kruse's exponent and the gain.

    The gain is d ln(extinction at 550 nm) / d ln(extinction). Where no branch holds, visibility
    is constant at the jump and the gain is 0; it is set to 1 there, so that the error is not
    underestimated.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        positive = np.isfinite(extinction) & (extinction > 0)
        plain = np.where(positive, koschmieder_constant(KOSCHMIEDER_CONTRAST) / extinction, np.nan)
        near = plain.copy()
        for _ in range(_KRUSE_PASSES):
            near = plain * np.exp(-_near_exponent(near) * logarithm)
        middle = plain * np.exp(-_KRUSE_MIDDLE * logarithm)
        far = plain * np.exp(-_KRUSE_CLEAR * logarithm)
        holds = np.stack(
            [
                near < _KRUSE_NEAR,
                (middle >= _KRUSE_NEAR) & (middle < _KRUSE_FAR),
                far >= _KRUSE_FAR,
            ]
        )
        exponents = np.stack(
            [
                _near_exponent(near),
                np.full(near.shape, _KRUSE_MIDDLE),
                np.full(near.shape, _KRUSE_CLEAR),
            ]
        )
        first = np.argmax(holds, axis=0)
        power = np.take_along_axis(exponents, first[np.newaxis], axis=0)[0]
        jump = np.where(middle < _KRUSE_NEAR, _KRUSE_NEAR, _KRUSE_FAR)
        bridged = np.log(plain / jump) / logarithm if logarithm != 0.0 else power
        none = ~holds.any(axis=0)
        power = np.where(positive, np.where(none, bridged, power), np.nan)
        slope = np.where(first == 0, _near_exponent(near) / 3.0 * logarithm, 0.0)
        gain = np.where(none | ~positive, 1.0, 1.0 / (1.0 + slope))
    return power, gain


def _near_exponent(visibility: Array) -> Array:
    return _KRUSE_SLOPE * np.cbrt(np.minimum(visibility, _KRUSE_NEAR) / 1000.0)


def _checked(extinction: npt.ArrayLike, error: npt.ArrayLike | None) -> tuple[Array, Array]:
    value = inputs.real_array(extinction, "extinction").astype(np.float64)
    if np.any(value[np.isfinite(value)] > LARGEST_EXTINCTION):
        raise RetrievalInputError(
            "exceeds 10 m-1: extinction must be in m-1, this looks like km-1",
            field="extinction",
            remedy="divide by 1000",
        )
    spread = np.nan if error is None else error
    errors = inputs.real_array(spread, "standard_error").astype(np.float64)
    if np.any(errors < 0):
        raise RetrievalInputError("is negative", field="standard_error")
    try:
        value, errors = np.broadcast_arrays(value, errors)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {errors.shape}, but extinction {value.shape}", field="standard_error"
        ) from None
    return value.copy(), errors.copy()

"""Variables of quantities that several kinds of product hold."""

from __future__ import annotations

from typing import Any, Final

from lidarops.netcdf.variables import ENDS, Coverage, ErrorKind, Row, count, per_profile, shots
from lidarops.retrieve.air.reference_window import Rejection
from lidarops.retrieve.clouds.thresholds import THRESHOLDS as CLOUD_THRESHOLDS
from lidarops.retrieve.signal.thresholds import THRESHOLDS as SIGNAL_THRESHOLDS

VALUE_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""
_OF_MEAN: Final = ("quality_flag", "profiles", "shots")

AEROSOL_LIDAR_RATIO: Final = (
    "ratio_of_volume_extinction_coefficient_to_volume_backwards_scattering_coefficient_by_ranging"
    "_instrument_in_air_due_to_ambient_aerosol_particles"
)
"""Standard name of the lidar ratio."""
SUM_OF_SQUARES: Final = (
    "{quantity}_standard_error is the root of the sum of squares of the error budget."
)
"""Comment on errors that make up a standard error."""


def mean_value(
    name: str,
    units: str,
    long_name: str,
    comment: str | None = None,
    ancillaries: tuple[str, ...] = (),
    **more: Any,
) -> Row:
    """Return the row of a quantity that is retrieved from each bin of a mean profile."""
    return Row(
        name,
        long_name,
        comment,
        units=units,
        ancillaries=(*ancillaries, *_OF_MEAN),
        bits=VALUE_BITS,
        uncertain=True,
        **more,
    )


def aerosol_backscatter(**more: Any) -> Row:
    """Return the row of the backscatter of aerosol."""
    return mean_value(
        "aerosol_backscatter",
        "m-1 sr-1",
        "backscatter coefficient of aerosol particles",
        standard_name="volume_backwards_scattering_coefficient_of_radiative_flux_by_ranging"
        "_instrument_in_air_due_to_ambient_aerosol_particles",
        **more,
    )


def aerosol_extinction(comment: str, ancillaries: tuple[str, ...], **more: Any) -> Row:
    """Return the row of the extinction of aerosol."""
    return mean_value(
        "aerosol_extinction",
        "m-1",
        "extinction coefficient of aerosol particles",
        comment,
        ancillaries,
        standard_name="volume_extinction_coefficient_of_radiative_flux_in_air_due_to_ambient"
        "_aerosol_particles",
        **more,
    )


AVERAGED: Final = (
    count("profiles", "number of raw profiles in the mean", cell_methods="time: sum"),
    count(
        "profiles_left_out",
        "number of raw profiles that are left out of the mean as outlying or without light",
        cell_methods="time: sum",
        comment="Profiles are left out where their signal, in any channel, exceeds that of all"
        " others of the interval at some range by more than the contrast of a cloud and noise"
        " allow, or lies below zero unlike that of all others, if they are at most a fifth of the"
        " interval: a short cloud, a bird, an aircraft, interference. Those without light or shots,"
        " as of a laser that was off, are any number.",
    ),
    shots(of="all profiles in the mean"),
)
"""Of which raw profiles a mean profile is made."""

MOLECULAR_BACKSCATTER: Final = Row(
    "molecular_backscatter",
    "backscatter coefficient of molecules",
    "Rayleigh scattering including rotational Raman lines.",
    dims=("range",),
    units="m-1 sr-1",
    coverage=Coverage.REFERENCE,
)
_REFERENCE_WINDOW: Final = (
    *(
        per_profile(
            f"reference_{end}{ending}",
            f"{where} at which the reference window {verb}",
            "Missing where no window passed the tests.",
            units="m",
        )
        for ending, where in (("", "range"), ("_altitude", "altitude above the geoid"))
        for end, verb in ENDS
    ),
    Row(
        "reference_scattering_ratio",
        "assumed ratio of backscatter of particles and molecules to that of molecules in the"
        " reference window",
        "Set by the campaign, as its standard error is: the value by which profiles are"
        " calibrated.",
        dims=(),
        coverage=Coverage.REFERENCE,
        uncertain=True,
        error_kind=ErrorKind.SYSTEMATIC,
    ),
    per_profile(
        "reference_detection_limit",
        "least ratio of backscatter of particles to that of molecules that is detected in the"
        " reference window with a probability of 0.95",
        "By comparison with other windows. Fewer particles may remain undetected:"
        " aerosol_backscatter_error_reference includes the noise of this comparison, and the ratio"
        " of the window to air in excess of the lowest ratio. Missing where no window passed the"
        " tests, or none beside it is comparable.",
    ),
)


def reference_window(comment: str) -> tuple[Row, ...]:
    """Return the rows of where a profile was compared with clean air, and how clean that is.

    Parameters
    ----------
    comment : str
        On the reasons for which candidates of the window fail.
    """
    rejections = per_profile(
        "reference_rejections",
        "reasons for which candidates of the reference window were rejected",
        "Of all candidates together; where none passed, no_reference is raised in quality_flag."
        f" {comment}",
        dtype="i4",
        standard_name="status_flag",
        reasons=Rejection,
    )
    return (*_REFERENCE_WINDOW, rejections)


CLOUD_MASK: Final = "cloud_mask"
CLOUD_FRACTION: Final = "cloud_fraction"
CLOUDS: Final = (
    Row(
        CLOUD_MASK,
        "clouds and dense layers in the mean profile",
        "partly_cloudy: some of the averaged profiles show a cloud, not all. cloudy: all of them"
        " do, or their mean does. unknown: no usable data, the overlap may be incomplete, or noise"
        f" would hide a cloud: in the noise of the mean, {CLOUD_THRESHOLDS.visible_depth:g} m with"
        f" {CLOUD_THRESHOLDS.visible_excess:g} times the least excess over air that makes a cloud"
        " would not be found. From base to apparent top: beyond a cloud that attenuates strongly"
        " there may be more. Profiles that are left out, or have no data there, do not count.",
        coverage=Coverage.AUXILIARY,
        dtype="i1",
        standard_name="status_flag",
        states=("clear", "partly_cloudy", "cloudy", "unknown"),
    ),
    Row(
        CLOUD_FRACTION,
        "share of the averaged profiles in which a cloud or dense layer is detected",
        f"The profiles of a mean are divided into up to {SIGNAL_THRESHOLDS.most_parts} parts, and"
        f" clouds are sought in each, in cells of about {SIGNAL_THRESHOLDS.cell_length:g} m; only"
        " those with data there count. Missing where no part has any, where cloud_mask is unknown,"
        " or where only the mean shows a cloud, so that cloud_mask is cloudy.",
        coverage=Coverage.AUXILIARY,
        valid_min=0.0,
        valid_max=1.0,
    ),
    per_profile(
        "cloud_base_range",
        "range at which the lowest cloud or dense layer begins",
        "Of all profiles in the mean. Missing where no cloud or dense layer was detected.",
        units="m",
    ),
    per_profile(
        "cloud_base_altitude",
        "altitude above the geoid at which the lowest cloud or dense layer begins",
        "Of all profiles in the mean. Missing where no cloud or dense layer was detected.",
        units="m",
        standard_name="cloud_base_altitude",
    ),
    per_profile(
        "cloud_top_altitude",
        "altitude above the geoid of the apparent top of the highest cloud or dense layer",
        "Of all profiles in the mean: where the ratio to air falls no more, or noise hides that it"
        " does: then this is below the true top. Missing where no cloud or dense layer was"
        " detected.",
        units="m",
        standard_name="cloud_top_altitude",
    ),
)
"""Of `lidarops.retrieve.clouds.labeled.Clouds`."""


def total_extinction(comment: str = "At the wavelength of the channel.", **more: Any) -> Row:
    """Return the row of the extinction of molecules and particles together."""
    words = "extinction coefficient of molecules and particles"
    return Row("total_extinction", words, comment, units="m-1", **more)


def visibility(where: str, ancillaries: tuple[str, ...], **more: Any) -> tuple[Row, ...]:
    """Return the rows of visibility and of the limits of its uncertainty interval.

    Parameters
    ----------
    where : str
        Where the visibility applies, as the end of a phrase.
    ancillaries : tuple of str
        Ancillary variables of the extinction from which visibility follows.
    **more
        Further fields of the row of visibility.
    """
    limits = tuple(
        Row(
            f"visibility_in_air_{end}",
            f"{end} limit of the uncertainty interval of visibility {where}",
            f"Visibility for extinction {sign} its combined random and systematic error (root of"
            " the sum of squares); the interval is not symmetric.",
            units="m",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            optional=bool(more.get("optional")),
        )
        for end, sign in (("lower", "plus"), ("upper", "minus"))
    )
    value = Row(
        "visibility_in_air",
        f"visibility {where}",
        "-ln(contrast) / extinction of the averaging interval, not a mean of visibilities."
        " lidarops_steps states the contrast and, where applied, the conversion of extinction to"
        " 550 nm. Missing where extinction is not positive.",
        units="m",
        standard_name="visibility_in_air",
        cell_methods="time: mean",
        uncertain=True,
        ancillaries=(*(row.name for row in limits), *ancillaries),
        lower_end=limits[0].name,
        **more,
    )
    return value, *limits

"""The variables of the ``homogeneous`` product."""

from __future__ import annotations

from typing import Final, get_args

from lidarops.netcdf.variables import (
    MEASURED_SHARES,
    NO_STANDARD_NAME,
    SECTION,
    SECTION_RANGE,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    retrieval_method,
    shots,
)
from lidarops.netcdf.visibility_rows import visibility_rows
from lidarops.products.homogeneous.flags import FLAGS
from lidarops.products.homogeneous.settings import Method

_SECTIONS = ("time", "section")
_OF_FIT = ("reduced_chi2", "valid_bins", "quality_flag", "shots")
_OF_EXTINCTION = ("total_extinction_model_error", *_OF_FIT)

_CURVED_SIGNAL = (
    "whose logarithmic slope deviates by 5 percent of its value at mean range at one end of the"
    " section, and by the opposite amount at the other"
)
_UNDETECTED = (
    "This is not an upper bound: departures from the model that its parameters absorb leave no"
    " trace in the residuals. With simulated backscatter that changes along the section or is"
    " curved, a plume, an afterpulse, or where the top of the signal is clipped, some values"
    " without a rejecting flag deviate by more than 4 combined standard errors."
    f" {MEASURED_SHARES}"
)

LAYOUT: Final = Layout(
    title="Extinction of homogeneous range sections",
    summary="Background, amplitude and extinction of range sections in which the atmosphere is"
    " assumed homogeneous along the beam, from the signals of one lidar channel, with standard"
    " errors and a test of the assumption.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > ATMOSPHERE > AIR QUALITY > VISIBILITY",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Golub, G. and Pereyra, V. (1973), SIAM J. Numer. Anal. 10, 413-432, doi:10.1137/0710036.",
    ),
    comment="Model of a section: P(r) = background + amplitude r^-2 exp(-2 total_extinction r),"
    " with range r. altitude, geospatial_vertical_min and geospatial_vertical_max refer to the"
    " midpoint of a section; altitude_bnds holds its ends where the beam is fixed.",
    sampled="section",
    coordinates=coordinates((SECTION, SECTION_RANGE), altitude("section", "altitude_bnds")),
    data=(
        Row(
            name="total_extinction",
            dims=_SECTIONS,
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of molecules and particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean section: mean",
            ancillaries=_OF_EXTINCTION,
            uncertain=True,
            comment=f"At the wavelength of the channel. {NO_STANDARD_NAME}",
        ),
        Row(
            name="total_extinction_model_error",
            dims=_SECTIONS,
            dtype="f4",
            units="m-1",
            long_name="model (systematic) uncertainty of extinction",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Separate from the random error in total_extinction_standard_error. Root of the"
            " sum of squares of 5 percent of (extinction + 1 / mean range), and of the extinction"
            f" error caused by a signal {_CURVED_SIGNAL}. {_UNDETECTED} {NO_STANDARD_NAME}",
        ),
        Row(
            name="total_extinction_baseline_error",
            dims=_SECTIONS,
            dtype="f4",
            units="m-1",
            long_name="change of extinction with one standard error of the analog baseline",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            optional=True,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Separate from the other errors. Of analog and glued channels, for a baseline"
            f" that decays with range. {NO_STANDARD_NAME}",
        ),
        *visibility_rows(
            _SECTIONS, place="along the section", ancillaries=_OF_EXTINCTION, optional=True
        ),
        Row(
            name="amplitude",
            dims=_SECTIONS,
            dtype="f4",
            units="{signal} m2",
            long_name="range-corrected signal of the section extrapolated to range 0",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=_OF_FIT,
            uncertain=True,
            comment="System constant times backscatter coefficient, not calibrated."
            f" {NO_STANDARD_NAME}",
        ),
        Row(
            name="background",
            dims=_SECTIONS,
            dtype="f4",
            units="{signal}",
            long_name="background fitted in the section",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("background_model_error", *_OF_FIT),
            uncertain=True,
            comment="Not calibrated. Where extinction plus 1 / mean range is known to 10 to 15"
            " percent only, some simulated backgrounds deviate by more than 4 of their standard"
            f" errors. {NO_STANDARD_NAME}",
        ),
        Row(
            name="background_model_error",
            dims=_SECTIONS,
            dtype="f4",
            units="{signal}",
            long_name="model (systematic) uncertainty of the background",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Separate from the random error in background_standard_error. Background error"
            f" caused by a signal {_CURVED_SIGNAL}, as with backscatter that is curved along the"
            f" path. {_UNDETECTED} {NO_STANDARD_NAME}",
        ),
        Row(
            name="reduced_chi2",
            dims=_SECTIONS,
            dtype="f4",
            units="1",
            long_name="reduced chi-square of the fit",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            comment=f"Close to 1 where the model holds within the noise. {NO_STANDARD_NAME}",
        ),
        Row(
            name="valid_bins",
            dims=_SECTIONS,
            dtype="i4",
            units="1",
            standard_name="number_of_observations",
            long_name="number of fitted range bins of the section",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
        ),
        retrieval_method(
            ("compressed", *(name for name in get_args(Method) if name != "auto")),
            "The method that ran: auto of the settings is direct, least squares over the bins, or"
            " known_background. compressed stands in older files only, which direct made too.",
        ),
        quality(_SECTIONS, FLAGS),
        shots(of="the profile"),
    ),
)
"""Layout of the product."""

"""The variables and quality bits of the ``homogeneous`` product."""

from __future__ import annotations

from typing import Final, get_args

from lidarops.flags import RAW_BITS, Flags, Quality
from lidarops.netcdf.quantities import total_extinction, visibility
from lidarops.netcdf.variables import (
    MEASURED_SHARES,
    Coverage,
    Error,
    Layout,
    Row,
    altitude,
    coordinates,
    count,
    quality,
    retrieval_method,
    shots,
)
from lidarops.products.homogeneous import Method
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

FLAGS: Final = Flags(
    kind="homogeneous",
    version=2,
    bits=(
        *sorted((*RAW_BITS, Quality.TOO_FEW_BINS)),
        Quality.LOW_SIGNAL,
        Quality.NEGATIVE_AMPLITUDE,
        Quality.NOT_HOMOGENEOUS,
        Quality.OUTLIER,
        Quality.NO_REAL_SOLUTION,
        Quality.BACKGROUND_UNCERTAIN,
        *HomogeneousQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

_OF_FIT = ("reduced_chi2", "valid_bins", "quality_flag", "shots")
_ALONG = (
    Row("section", "number of the range section", dims=("section",), dtype="i4"),
    Row(
        "section_range",
        "distance from the lidar along the beam, midpoint of the range section",
        dims=("section",),
        units="m",
        bounds="section_bounds",
    ),
)

_CURVED_SIGNAL = (
    "whose logarithmic slope deviates by the share slope_error of its value at mean range at one"
    " end of the section, and by the opposite amount at the other"
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
    references=(
        "Golub, G. and Pereyra, V. (1973), SIAM J. Numer. Anal. 10, 413-432, doi:10.1137/0710036.",
    ),
    comment="Model of a section: P(r) = background + amplitude r^-2 exp(-2 total_extinction r),"
    " with range r. altitude, geospatial_vertical_min and geospatial_vertical_max refer to the"
    " midpoint of a section; altitude_bnds holds its ends where the beam is fixed.",
    sampled="section",
    coordinates=coordinates(_ALONG, altitude("section", "altitude_bnds")),
    data=(
        total_extinction(
            cell_methods="time: mean section: mean",
            ancillaries=_OF_FIT,
            uncertain=True,
            errors=(
                Error(
                    "model",
                    "model (systematic) uncertainty of extinction",
                    comment="Separate from the random error in {quantity}_standard_error. Root of"
                    " the sum of squares of slope_error times (extinction + 1 / mean range), and of"
                    f" the extinction error caused by a signal {_CURVED_SIGNAL}. {_UNDETECTED}",
                ),
                Error(
                    "baseline",
                    "change of extinction with one standard error of the analog baseline",
                    comment="Separate from the other errors. Of analog and glued channels, for a"
                    " baseline that decays with range.",
                    optional=True,
                ),
            ),
        ),
        *visibility("along the section", ("total_extinction_model_error", *_OF_FIT), optional=True),
        Row(
            "amplitude",
            "range-corrected signal of the section extrapolated to range 0",
            "System constant times backscatter coefficient, not calibrated.",
            units="{signal} m2",
            ancillaries=_OF_FIT,
            uncertain=True,
        ),
        Row(
            "background",
            "background fitted in the section",
            "Not calibrated. Where extinction plus 1 / mean range is known to 10 to 15"
            " percent only, some simulated backgrounds deviate by more than 4 of their standard"
            " errors.",
            units="{signal}",
            ancillaries=_OF_FIT,
            uncertain=True,
            errors=(
                Error(
                    "model",
                    "model (systematic) uncertainty of the background",
                    comment="Separate from the random error in {quantity}_standard_error."
                    f" Background error caused by a signal {_CURVED_SIGNAL}, as with backscatter"
                    f" that is curved along the path. {_UNDETECTED}",
                ),
            ),
        ),
        Row(
            "slope_error",
            "standard error of the logarithmic slope of the signal by air that is not homogeneous,"
            " as a share of 2 (extinction + 1 / mean range)",
            "On which model errors rest. Assumed, unless the campaign states another: the"
            f" default of {THRESHOLDS.model_error:g} is chosen by the violations of simulated"
            " scenes, most of which it covers; the results in the documentation state the rest. In"
            " calm air, with eddies of 1 percent, errors of extinction are 0.1 to 0.6 of it.",
            dims=(),
            coverage=Coverage.REFERENCE,
        ),
        Row(
            "reduced_chi2",
            "reduced chi-square of the fit",
            "Close to 1 where the model holds within the noise.",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
        ),
        count(
            "valid_bins",
            "number of fitted range bins of the section",
            dims=("time", "section"),
            coverage=Coverage.QUALITY,
        ),
        retrieval_method(
            ("compressed", *(name for name in get_args(Method) if name != "auto")),
            "The method that ran: auto of the settings is direct, least squares over the bins, or"
            " known_background. compressed stands in older files only, which direct made too.",
        ),
        quality(FLAGS),
        shots(of="the profile"),
    ),
)

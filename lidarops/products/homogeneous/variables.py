"""The variables of the ``homogeneous`` product."""

from __future__ import annotations

from typing import Final

from lidarops.flags import Quality
from lidarops.netcdf.variables import (
    NO_NAME,
    SECTION,
    SECTION_RANGE,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    shots,
)
from lidarops.products.visibility_variables import visibility

_SECTIONS = ("time", "section")
_OF_FIT = ("reduced_chi2", "valid_bins", "quality_flag", "shots")
_OF_EXTINCTION = ("extinction_model_error", *_OF_FIT)

_BENT = (
    "whose logarithmic slope is off by 5 percent of that at mean range at one end of the section,"
    " and by the opposite at the other"
)
_UNTOLD = (
    "No bound: violations of the model that its own shapes take up leave no trace for any test to"
    " see. In simulated random violations, this share of the values that no flag rejects was off"
    " by more than 4 times both errors together:"
)

_FIT_FLAGS = Quality(sum(bit for bit in Quality if bit <= Quality.NOT_LEVEL))

HOMOGENEOUS: Final = Layout(
    title="Extinction of homogeneous range sections",
    summary="Background, amplitude and extinction of range sections in which the atmosphere is"
    " taken as homogeneous along the beam, from the signals of one lidar channel, with standard"
    " errors and a test of the assumption.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > ATMOSPHERE > AIR QUALITY > VISIBILITY",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Bobrovsky, A. P. et al. (2024): Transparency of a weakly turbid atmosphere with lidars.",
        "Potapova, I. A. et al. (2023): Inverse problem of lidar sounding of weak turbidity.",
        "Golub, G. H. and Pereyra, V. (1973), SIAM J. Numer. Anal. 10, 413-432.",
    ),
    comment="Model of a section: P(r) = background + amplitude r^-2 exp(-2 extinction r), with"
    " range r. altitude, and with it geospatial_vertical_min and _max, is that of the middle of"
    " a section; altitude_bnds holds its ends where the beam stands still.",
    sampled="section",
    unused_steps=frozenset({"average", "background", "molecular", "known_shape", "reference"}),
    coordinates=coordinates((SECTION, SECTION_RANGE), altitude("section", "altitude_bnds")),
    data=(
        Row(
            name="extinction",
            dims=_SECTIONS,
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of air and aerosol together",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean section: mean",
            ancillaries=_OF_EXTINCTION,
            uncertain=True,
            comment="Molecules and particles together, at the wavelength of the channel."
            f" {NO_NAME}",
        ),
        Row(
            name="extinction_model_error",
            dims=_SECTIONS,
            dtype="f4",
            units="m-1",
            long_name="systematic error of the extinction coefficient to allow for",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Apart from the random error in extinction_standard_error: 5 percent of"
            " extinction + 1 / mean range, and in quadrature what the extinction takes up of a"
            f" signal {_BENT}. {_UNTOLD} 7 percent with backscatter that changes along the section"
            " as an exponential of range with a scale of 1 to 100 km, 10 with a plume, 8 where the"
            " top of the signal is cut off, 2.5 where backscatter bends, 0.5 at most otherwise."
            f" {NO_NAME}",
        ),
        *visibility(
            _SECTIONS, called="along the section", ancillaries=_OF_EXTINCTION, optional=True
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
            comment=f"System constant times backscatter coefficient, not calibrated. {NO_NAME}",
        ),
        Row(
            name="background",
            dims=_SECTIONS,
            dtype="f4",
            units="{signal}",
            long_name="background as fitted in the section",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("background_model_error", *_OF_FIT),
            uncertain=True,
            comment=f"Not calibrated. {NO_NAME}",
        ),
        Row(
            name="background_model_error",
            dims=_SECTIONS,
            dtype="f4",
            units="{signal}",
            long_name="systematic error of the background to allow for",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Apart from the random error in background_standard_error: what the"
            f" background takes up of a signal {_BENT}, as where backscatter bends along the path."
            f" {_UNTOLD} 5 percent where it bends more, 2.4 with an afterpulse, 1.1 with a plume,"
            f" 0.5 at most otherwise. {NO_NAME}",
        ),
        Row(
            name="reduced_chi2",
            dims=_SECTIONS,
            dtype="f4",
            units="1",
            long_name="reduced chi-square of the fit",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            comment=f"Near 1 where the model holds within the noise. {NO_NAME}",
        ),
        Row(
            name="valid_bins",
            dims=_SECTIONS,
            dtype="i4",
            units="1",
            standard_name="number_of_observations",
            long_name="number of range bins of the section that were fitted",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
        ),
        quality(_SECTIONS, _FIT_FLAGS),
        shots(of="the profile"),
    ),
)
"""What the product holds."""

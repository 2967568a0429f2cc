"""The variables of the ``elastic`` product."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from lidarops.flags import Quality
from lidarops.netcdf.variables import (
    GLUING,
    NO_NAME,
    RANGE,
    STANDARD_NAME_TABLE,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    altitude,
    coordinates,
    quality,
    shots,
)

_BINS: Final = ("time", "range")
_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""
_BUDGET: Final = {
    "noise": "Random: independent from profile to profile.",
    "background": "Random in time, one error for all ranges of a profile.",
    "reference": "Systematic: of the aerosol assumed in the reference window and of the window's"
    " noise.",
    "lidar_ratio": "Systematic: of the lidar ratio that is assumed.",
    "molecular": "Systematic: of the molecular atmosphere.",
}
"""Causes of error, in the order of `lidarops.retrieve.elastic.inversion.ErrorBudget`."""

FLAGS: Final = (
    Quality.INPUT_MISSING
    | Quality.SATURATED
    | Quality.PILE_UP
    | Quality.INCOMPLETE_OVERLAP
    | Quality.OUTLIER
    | Quality.BACKGROUND_UNCERTAIN
    | Quality.NO_GLUING
    | Quality.CLOUD
    | Quality.NO_REFERENCE
    | Quality.UNSTABLE_INVERSION
)


def _budget(quantity: str, called: str, units: str) -> Iterator[Row]:
    """Give the rows of the error budget of a quantity."""
    for cause, comment in _BUDGET.items():
        yield Row(
            name=f"{quantity}_error_{cause}",
            dims=_BINS,
            dtype="f4",
            units=units,
            long_name=f"error of {called} by one standard error of its {_CALLED[cause]}",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            error_kind=ErrorKind(comment.partition(":")[0].partition(" ")[0].lower()),
            comment=f"{comment} The standard error of {called} is the root of the sum of squares."
            f" {NO_NAME}",
        )


_CALLED: Final = {
    "noise": "signal noise",
    "background": "background",
    "reference": "reference value",
    "lidar_ratio": "lidar ratio",
    "molecular": "molecular backscatter",
}
_TERMS: Final = tuple(f"backscatter_error_{cause}" for cause in _BUDGET)

ELASTIC: Final = Layout(
    title="Aerosol backscatter and extinction of elastic signals",
    summary="Backscatter and extinction of aerosol from elastic lidar signals by the"
    " two-component inversion of Klett, Fernald and Sasano, with an error budget.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL BACKSCATTER",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Fernald, F. G. (1984), Appl. Opt. 23, 652-653.",
        "Sasano, Y. et al. (1985), Appl. Opt. 24, 3929-3932.",
    ),
    comment="extinction is backscatter times the lidar ratio that is assumed, no measurement of"
    " its own. Profiles are means over time; range is along the beam. Particles in the reference"
    " window that fall off with height nearly as air does look like air, and no test of the signal"
    " tells them: only the error of the scattering ratio that the settings declare covers them. In"
    " simulations with that of 0.02, of the values that no flag rejects 0.001 percent were off by"
    " more than 4 standard errors where such haze scattered up to 3.5 percent of what air does at"
    " 7 km, and 12 percent where it scattered 0.35 to 35 percent: declare more where air is hazy at"
    " all heights. No elastic signal tells the lidar ratio either; its declared error has to cover"
    " it. Values flagged outlier come from the ranges next to theirs: the signal there lies off on"
    " its own, by more than noise.",
    sampled="range",
    unused_steps=frozenset({"homogeneous", "signal", "background"}),
    coordinates=coordinates((RANGE,), altitude("range")),
    data=(
        Row(
            name="backscatter",
            dims=_BINS,
            dtype="f4",
            units="m-1 sr-1",
            standard_name="volume_backwards_scattering_coefficient_of_radiative_flux_by_ranging"
            "_instrument_in_air_due_to_ambient_aerosol_particles",
            long_name="backscatter coefficient of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=(*_TERMS, "quality_flag", "profiles", "shots"),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
        ),
        *_budget("backscatter", "backscatter", "m-1 sr-1"),
        Row(
            name="extinction",
            dims=_BINS,
            dtype="f4",
            units="m-1",
            standard_name="volume_extinction_coefficient_of_radiative_flux_in_air_due_to_ambient"
            "_aerosol_particles",
            long_name="extinction coefficient of aerosol particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            # Readers look for the ancillaries of a quantity, not for those of an ancillary.
            ancillaries=(
                "lidar_ratio",
                "lidar_ratio_standard_error",
                "quality_flag",
                "profiles",
                "shots",
            ),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            comment="backscatter x lidar_ratio.",
        ),
        Row(
            name="scattering_ratio",
            dims=_BINS,
            dtype="f4",
            units="1",
            long_name="backscatter of particles and molecules over that of molecules",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=("quality_flag", "profiles", "shots"),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            comment="Without attenuation, unlike backscattering_ratio_in_air of the"
            f" {STANDARD_NAME_TABLE}. {NO_NAME}",
        ),
        Row(
            name="attenuated_backscatter",
            dims=_BINS,
            dtype="f4",
            units="m-1 sr-1",
            standard_name="volume_attenuated_backwards_scattering_coefficient_of_radiative_flux"
            "_in_air",
            long_name="attenuated backscatter coefficient of particles and molecules",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean range: mean",
            ancillaries=("quality_flag", "profiles", "shots"),
            significant_bits=_BITS,
            uncertain=True,
            error_kind=ErrorKind.BOTH,
            comment="Calibrated by the reference window.",
        ),
        Row(
            name="molecular_backscatter",
            dims=("range",),
            dtype="f4",
            units="m-1 sr-1",
            long_name="backscatter coefficient of molecules",
            coverage=Coverage.REFERENCE,
            comment=f"Rayleigh scattering, rotational Raman lines included. {NO_NAME}",
        ),
        Row(
            name="molecular_extinction",
            dims=("range",),
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of molecules",
            coverage=Coverage.REFERENCE,
            comment=NO_NAME,
        ),
        Row(
            name="lidar_ratio",
            dims=(),
            dtype="f4",
            units="sr",
            standard_name="ratio_of_volume_extinction_coefficient_to_volume_backwards_scattering"
            "_coefficient_by_ranging_instrument_in_air_due_to_ambient_aerosol_particles",
            long_name="extinction over backscatter of aerosol particles, as assumed",
            coverage=Coverage.REFERENCE,
            uncertain=True,
            error_kind=ErrorKind.SYSTEMATIC,
            comment="Given by the campaign, not measured.",
        ),
        Row(
            name="reference_bottom",
            dims=("time",),
            dtype="f4",
            units="m",
            long_name="range at which the reference window begins",
            coverage=Coverage.AUXILIARY,
            comment=f"Missing where no window passed its tests. {NO_NAME}",
        ),
        Row(
            name="reference_top",
            dims=("time",),
            dtype="f4",
            units="m",
            long_name="range at which the reference window ends",
            coverage=Coverage.AUXILIARY,
            comment=f"Missing where no window passed its tests. {NO_NAME}",
        ),
        Row(
            name="cloud_base_range",
            dims=("time",),
            dtype="f4",
            units="m",
            long_name="range at which the lowest cloud or dense layer begins",
            coverage=Coverage.AUXILIARY,
            comment=f"Missing where none was found. {NO_NAME}",
        ),
        Row(
            name="background",
            dims=("time",),
            dtype="f4",
            units="{signal}",
            long_name="background that was subtracted: sky light, dark current and offset",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("shots",),
            uncertain=True,
            comment=f"Not calibrated. {NO_NAME}",
        ),
        *GLUING,
        quality(_BINS, FLAGS),
        Row(
            name="profiles",
            dims=("time",),
            dtype="i4",
            units="1",
            standard_name="number_of_observations",
            long_name="number of raw profiles of the mean",
            coverage=Coverage.AUXILIARY,
            cell_methods="time: sum",
            valid_min=0.0,
        ),
        shots(of="all profiles of the mean"),
    ),
)

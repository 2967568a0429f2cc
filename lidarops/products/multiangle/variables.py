"""The variables of the ``multiangle`` product."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final, get_args

from lidarops.netcdf.variables import (
    BACKGROUND_METHOD,
    MEASURED_SHARES,
    NO_STANDARD_NAME,
    PLACE,
    TIME,
    Coverage,
    ErrorKind,
    Layout,
    Row,
    quality,
    retrieval_method,
    shots,
)
from lidarops.products.multiangle.flags import FLAGS
from lidarops.products.multiangle.settings import Method
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_LEVELS: Final = ("time", "altitude")
_BITS: Final = 12
"""Significant bits of a retrieved value: 1.2e-4 of it."""

_ALTITUDE: Final = Row(
    name="altitude",
    dims=("altitude",),
    dtype="f8",
    units="m",
    standard_name="altitude",
    long_name="altitude of the sounded air above the geoid",
    coverage=Coverage.COORDINATE,
    axis="Z",
    positive="up",
    bounds="altitude_bnds",
    comment="Top of the layer given in altitude_bnds. Its bottom is the next lower altitude, or the"
    " station.",
)
_BEAM: Final = Row(
    name="beam",
    dims=("beam",),
    dtype="i4",
    units="1",
    long_name="number of the beam direction",
    coverage=Coverage.COORDINATE,
    comment="Ordered by azimuth of the vertical plane, and in each plane from one horizon over the"
    " zenith to the other.",
)
_LAYER: Final = Row(
    name="layer_altitude",
    dims=("layer",),
    dtype="f8",
    units="m",
    standard_name="altitude",
    long_name="altitude of the midpoint of the layer above the geoid",
    coverage=Coverage.COORDINATE,
    positive="up",
    bounds="layer_bnds",
    optional=True,
    comment="layer_bnds holds bottom and top, moved to the nearest altitude of the profile or to"
    " the station.",
)

_PLANE: Final = Row(
    name="plane",
    dims=("plane",),
    dtype="i4",
    units="1",
    long_name="number of the vertical plane",
    coverage=Coverage.COORDINATE,
    optional=True,
    comment="The beams of a plane are a range-height scan (RHI), of a volume of several planes.",
)

_BASELINE_RANGE: Final = Row(
    name="baseline_range",
    dims=("baseline_range",),
    dtype="f8",
    units="m",
    long_name="range of the analog baseline",
    coverage=Coverage.COORDINATE,
    optional=True,
    comment=f"Middles of the blocks over which it is averaged. {NO_STANDARD_NAME}",
)


def _direction(name: str) -> Row:
    """Return the row of a pointing angle of the beams."""
    angle = next(row for row in PLACE if row.name == name)
    return replace(angle, name=f"beam_{name}", dims=("beam",), follows_beam=False)


def _blocked_direction(name: str) -> Row:
    """Return the row of a pointing angle of the blocked profiles."""
    row = _direction(name)
    words = f"{row.long_name}, of a profile that shows the analog baseline"
    return replace(
        row,
        name=f"blocked_{name}",
        dims=("blocked",),
        long_name=words,
        coverage=Coverage.AUXILIARY,
        optional=True,
    )


def _plane_azimuth() -> Row:
    """Return the row of the azimuth of planes."""
    azimuth = _direction("azimuth")
    words = "azimuth of the lowest beam of the vertical plane"
    return replace(azimuth, name="plane_azimuth", dims=("plane",), long_name=words, optional=True)


def _of_planes(quantity: str, words: str, units: str) -> tuple[Row, ...]:
    """Return the rows of a quantity that is retrieved from the beams of each vertical plane."""
    dims = ("time", "plane", "altitude")
    method = "mean" if quantity == "total_extinction" else "point"
    value = Row(
        name=f"plane_{quantity}",
        dims=dims,
        dtype="f4",
        units=units,
        long_name=f"{words}, from the beams of a vertical plane",
        coverage=Coverage.PHYSICAL,
        cell_methods=f"time: mean altitude: {method}",
        ancillaries=(f"plane_{quantity}_gradient_error",),
        significant_bits=_BITS,
        uncertain=True,
        error_kind=ErrorKind.BOTH,
        optional=True,
        comment=f"As {quantity}, with an inhomogeneity of the plane. Its error by the dead time is"
        f" not stated: see {quantity}_dead_time_error. Missing where a test of the plane alone"
        " rejects the value; no flag grades the others. quality_flag and usable are those of all"
        " beams together: where they reject a value, leave out those of its planes too, unless"
        f" differences between planes are of interest. {NO_STANDARD_NAME}",
    )
    error = _gradient_error(f"plane_{quantity}", f"{words} of a plane", units)
    comment = (
        f"Separate from plane_{quantity}_standard_error. Where planes point to all sides, the error"
        " that explains the scatter between planes, pooled over all scans of the file and"
        f" {THRESHOLDS.pooled} altitudes; else as {quantity}_gradient_error. {NO_STANDARD_NAME}"
    )
    return value, replace(error, dims=dims, optional=True, comment=comment)


_STATION: Final = tuple(row for row in PLACE if row.name not in ("zenith_angle", "azimuth"))


def _gradient_error(quantity: str, words: str, units: str) -> Row:
    return Row(
        name=f"{quantity}_gradient_error",
        dims=_LEVELS,
        dtype="f4",
        units=units,
        long_name=f"model (systematic) uncertainty of {words} from a horizontal gradient",
        coverage=Coverage.QUALITY,
        valid_min=0.0,
        significant_bits=8,
        error_kind=ErrorKind.SYSTEMATIC,
        comment=f"Separate from {quantity}_standard_error, which covers noise and smoothing. Error"
        " that the largest horizontal gradient of ln(backscatter) declared in the settings would"
        f" cause. Close to 0 where beams point to all sides. {NO_STANDARD_NAME}",
    )


def _signal_errors(quantity: str, words: str, units: str) -> Iterator[Row]:
    """Yield the rows of the errors by dead time and analog baseline."""
    for cause, missing in (("dead time", "analog signals"), ("baseline", "photon counting")):
        yield replace(
            _gradient_error(quantity, words, units),
            name=f"{quantity}_{cause.replace(' ', '_')}_error",
            long_name=f"calibration (systematic) uncertainty of {words} from the {cause}",
            optional=True,
            comment=f"Separate from {quantity}_standard_error. Change with one standard error of"
            f" the {cause}, without smoothing. Missing for {missing}. {NO_STANDARD_NAME}",
        )


LAYOUT: Final = Layout(
    title="Optical depth and extinction from scans over zenith angle",
    summary="Optical depth and extinction of molecules and particles together, from signals of one"
    " lidar channel at several zenith angles, without lidar ratio or reference value, with standard"
    " errors.",
    keywords=(
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL OPTICAL DEPTH/THICKNESS",
        "EARTH SCIENCE > ATMOSPHERE > AEROSOLS > AEROSOL EXTINCTION",
        "EARTH SCIENCE > SPECTRAL/ENGINEERING > LIDAR > LIDAR BACKSCATTER",
    ),
    processing_level="L2: retrieved quantities",
    references=(
        "Kano, M. (1968), Pap. Meteorol. Geophys. 19, 121-129.",
        "Hamilton, P. M. (1969), Atmos. Environ. 3, 221-223.",
        "DerSimonian, R. and Laird, N. (1986), Control. Clin. Trials 7, 177-188.",
    ),
    comment="Model: at a given altitude, the logarithm of the range-corrected signal decreases by"
    " twice the optical depth times the ratio of slant to vertical path, in air that is"
    " horizontally stratified over the scan. A profile is one scan cycle. Inhomogeneity and"
    " smoothness are common to all cycles of the file. Smoothing changes all profiles of one sky"
    " alike, so that a mean over time does not reduce the errors of optical depth and extinction."
    " Methods without smoothing state noise alone; for them this rule overstates the error of a"
    " mean.",
    sampled="altitude",
    weighed=("vertical_optical_depth", "total_extinction"),
    coordinates=(
        TIME,
        _ALTITUDE,
        _BEAM,
        _direction("zenith_angle"),
        _direction("azimuth"),
        _LAYER,
        _PLANE,
        _plane_azimuth(),
        _BASELINE_RANGE,
        *_STATION,
    ),
    data=(
        Row(
            name="vertical_optical_depth",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="optical depth of molecules and particles from the station to the altitude",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean altitude: point",
            ancillaries=(
                "vertical_optical_depth_gradient_error",
                "data_share",
                "inhomogeneity",
                "quality_flag",
                "beams",
                "shots",
            ),
            significant_bits=_BITS,
            uncertain=True,
            # Noise, and smoothing error that profiles share, are not stated separately.
            error_kind=ErrorKind.BOTH,
            comment=f"Along the vertical, at the wavelength of the channel. {NO_STANDARD_NAME}",
        ),
        _gradient_error("vertical_optical_depth", "optical depth", "1"),
        *_signal_errors("vertical_optical_depth", "optical depth", "1"),
        Row(
            name="monotone_vertical_optical_depth",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="profile nearest to vertical_optical_depth that nowhere decreases with"
            " altitude",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean altitude: point",
            ancillaries=("quality_flag",),
            significant_bits=_BITS,
            optional=True,
            comment="For figures of single profiles. Where the signal is weak, its means over many"
            " profiles are biased high: average vertical_optical_depth instead."
            f" {NO_STANDARD_NAME}",
        ),
        Row(
            name="total_extinction",
            dims=_LEVELS,
            dtype="f4",
            units="m-1",
            long_name="extinction coefficient of molecules and particles",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean altitude: mean",
            ancillaries=(
                "total_extinction_gradient_error",
                "data_share",
                "inhomogeneity",
                "quality_flag",
                "beams",
                "shots",
            ),
            significant_bits=_BITS,
            uncertain=True,
            # Noise, and smoothing error that profiles share, are not stated separately.
            error_kind=ErrorKind.BOTH,
            comment="Mean over the layer in altitude_bnds, at the wavelength of the channel. The"
            " error by smoothing is a mean over altitudes, too small in thin layers: within"
            " simulated layers of a few altitudes, some values differ by more than 4 standard"
            f" errors. {MEASURED_SHARES} {NO_STANDARD_NAME}",
        ),
        _gradient_error("total_extinction", "extinction", "m-1"),
        *_signal_errors("total_extinction", "extinction", "m-1"),
        Row(
            name="log_intercept",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="natural logarithm of the range-corrected signal at zero optical depth",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean altitude: point",
            ancillaries=("quality_flag", "beams", "shots"),
            uncertain=True,
            comment="Logarithm of the signal in mV m2 (analog) or MHz m2 (photon counting): system"
            f" constant times backscatter coefficient, not calibrated. {NO_STANDARD_NAME}",
        ),
        Row(
            name="data_share",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="share of the optical depth that the data determine",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            comment=f"1 where neither smoothness nor a prior has an effect. {NO_STANDARD_NAME}",
        ),
        Row(
            name="regularisation",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="strength of the penalty on the derivative along the slant path",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
            significant_bits=_BITS,
            optional=True,
            comment="For slant paths scaled to a span of 1, and residuals scaled to their noise."
            " Given by the settings, or the largest one whose residuals are not larger than the"
            f" noise. {NO_STANDARD_NAME}",
        ),
        Row(
            name="prior_vertical_optical_depth",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="optical depth to which the penalty pulls",
            coverage=Coverage.AUXILIARY,
            significant_bits=_BITS,
            optional=True,
            comment="0, or that of the altitude below. The share 1 - data_share of the optical"
            f" depth comes from it. {NO_STANDARD_NAME}",
        ),
        Row(
            name="inhomogeneity",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="standard deviation of ln(signal) between beams in excess of noise",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            significant_bits=8,
            comment="Inhomogeneity of the air between the beams, common to all cycles of the file."
            f" {NO_STANDARD_NAME}",
        ),
        Row(
            name="reduced_chi2",
            dims=_LEVELS,
            dtype="f4",
            units="1",
            long_name="reduced chi-square of the fit over the beams",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            significant_bits=8,
            optional=True,
            comment="Sum of squared residuals divided by their variances, per degree of freedom."
            " About 1, because the inhomogeneity is estimated from the residuals; less where the"
            f" noise is overstated. Missing where no beam is redundant. {NO_STANDARD_NAME}",
        ),
        Row(
            name="layer_vertical_optical_depth",
            dims=("time", "layer"),
            dtype="f4",
            units="1",
            long_name="optical depth of molecules and particles between the bounds of the layer",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=("layer_vertical_optical_depth_gradient_error",),
            significant_bits=_BITS,
            uncertain=True,
            # Noise, and smoothing error that profiles share, are not stated separately.
            error_kind=ErrorKind.BOTH,
            optional=True,
            comment="Along the vertical, at the wavelength of the channel. Its error by the dead"
            " time is not stated: see vertical_optical_depth_dead_time_error at its bounds. Missing"
            f" where quality_flag rejects the value at a bound of the layer. {NO_STANDARD_NAME}",
        ),
        replace(
            _gradient_error("layer_vertical_optical_depth", "the optical depth of the layer", "1"),
            dims=("time", "layer"),
            optional=True,
        ),
        *_of_planes("vertical_optical_depth", "optical depth of molecules and particles", "1"),
        *_of_planes("total_extinction", "extinction coefficient of molecules and particles", "m-1"),
        Row(
            name="beam_signal",
            dims=("time", "beam", "altitude"),
            dtype="f4",
            units="{signal} m2",
            long_name="range-corrected signal of a beam in the altitude cell",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean altitude: mean",
            significant_bits=8,
            optional=True,
            comment="Without background, divided by the overlap where one is given. Its noise is"
            f" not stated; residual is missing where it is too large. {NO_STANDARD_NAME}",
        ),
        Row(
            name="beam_obstruction",
            dims=("time", "beam"),
            dtype="f4",
            units="m",
            long_name="range from which the beam is blocked by an obstruction or a dense cloud",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            optional=True,
            comment=f"Missing for a free beam. Farther bins are not used. {NO_STANDARD_NAME}",
        ),
        Row(
            name="analog_baseline",
            dims=("baseline_range",),
            dtype="f4",
            units="{signal}",
            long_name="analog signal without light, minus its mean in the range of the background",
            coverage=Coverage.AUXILIARY,
            uncertain=True,
            error_kind=ErrorKind.SYSTEMATIC,
            optional=True,
            comment="From profiles that a tree or building blocks, at least"
            f" {THRESHOLDS.baseline_guard:g} m behind it; subtracted from all profiles,"
            " interpolated between ranges. Its standard error is that of noise and of the scatter"
            " between profiles, and part of the error of the backgrounds; it grows before the first"
            " range."
            f" {NO_STANDARD_NAME}",
        ),
        Row(
            name="blocked_range",
            dims=("blocked",),
            dtype="f4",
            units="m",
            long_name="range from which a profile that shows the analog baseline is blocked",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
            optional=True,
            comment=NO_STANDARD_NAME,
        ),
        _blocked_direction("zenith_angle"),
        _blocked_direction("azimuth"),
        Row(
            name="residual",
            dims=("time", "beam", "altitude"),
            dtype="f4",
            units="1",
            long_name="natural logarithm of the signal of a beam minus the fit over the beams",
            coverage=Coverage.QUALITY,
            significant_bits=8,
            comment=f"Missing where the beam has no usable signal. {NO_STANDARD_NAME}",
        ),
        retrieval_method(
            tuple(name for name in get_args(Method) if name != "auto"),
            "The method that ran: auto of the settings chooses two_angle, joint or kano_hamilton"
            " from the data.",
        ),
        BACKGROUND_METHOD,
        quality(_LEVELS, FLAGS),
        Row(
            name="effective_degrees_of_freedom",
            dims=("time",),
            dtype="f4",
            units="1",
            long_name="number of independent values of the profile that the data determine",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            comment=f"Missing where there is no profile. {NO_STANDARD_NAME}",
        ),
        Row(
            name="reach",
            dims=("time",),
            dtype="f4",
            units="m",
            long_name="highest altitude above the geoid with an estimate",
            coverage=Coverage.AUXILIARY,
            comment=f"Missing where there is no estimate. {NO_STANDARD_NAME}",
        ),
        Row(
            name="beams",
            dims=("time",),
            dtype="i4",
            units="1",
            standard_name="number_of_observations",
            long_name="number of beam directions with a signal in the scan cycle",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
        ),
        shots(of="all beams of the scan cycle"),
    ),
)

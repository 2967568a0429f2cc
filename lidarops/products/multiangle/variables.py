"""The variables and quality bits of the ``multiangle`` product."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final, get_args

from lidarops.flags import COMPARED_BITS, SIGNAL_BITS, Flags, Quality
from lidarops.netcdf.quantities import VALUE_BITS, total_extinction
from lidarops.netcdf.variables import (
    BACKGROUND_METHOD,
    MEASURED_SHARES,
    NO_STANDARD_NAME,
    PLACE,
    TIME,
    Coverage,
    Error,
    ErrorKind,
    Layout,
    Row,
    altitude,
    count,
    numbered,
    per_profile,
    place,
    quality,
    retrieval_method,
    shots,
)
from lidarops.products.multiangle import Method
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

FLAGS: Final = Flags(
    kind="multiangle",
    version=4,
    bits=(
        *sorted({*SIGNAL_BITS, *COMPARED_BITS} - {Quality.OUTLIER}),
        *MultiAngleQuality,
    ),
)
"""Published places are in `tests/products/test_flags.py`."""

_OF_PENALTY: Final[dict[str, Any]] = {
    "coverage": Coverage.AUXILIARY,
    "bits": VALUE_BITS,
    "optional": True,
}
_POINT: Final = "time: mean altitude: point"
_MEAN: Final = "time: mean altitude: mean"


def _direction(name: str, whose: str, **changes: Any) -> Row:
    """Return the row of a pointing angle of beams, planes or blocked profiles."""
    return place(name, name=f"{whose}_{name}", dims=(whose,), follows_beam=False, **changes)


_ALONG: Final = (
    replace(
        altitude("altitude", "altitude_bnds"),
        dtype="f8",
        follows_beam=False,
        comment="Top of the layer given in altitude_bnds. Its bottom is the next lower altitude, or"
        " the station.",
    ),
    numbered(
        "beam",
        "number of the beam direction",
        "Ordered by azimuth of the vertical plane, and in each plane from one horizon over the"
        " zenith to the other.",
    ),
    _direction("zenith_angle", "beam"),
    _direction("azimuth", "beam"),
    Row(
        "layer_altitude",
        "altitude of the midpoint of the layer above the geoid",
        "layer_bnds holds bottom and top, moved to the nearest altitude of the profile or to the"
        " station.",
        dims=("layer",),
        units="m",
        standard_name="altitude",
        positive="up",
        bounds="layer_bnds",
        optional=True,
    ),
    numbered(
        "plane",
        "number of the vertical plane",
        "The beams of a plane are a range-height scan (RHI), of a volume of several planes.",
        optional=True,
    ),
    _direction(
        "azimuth",
        "plane",
        long_name="azimuth of the lowest beam of the vertical plane",
        optional=True,
    ),
    Row(
        "baseline_range",
        "range of the analog baseline",
        f"Middles of the blocks over which it is averaged. {NO_STANDARD_NAME}",
        dims=("baseline_range",),
        units="m",
        optional=True,
    ),
)


def _blocked(name: str) -> Row:
    """Return the row of a pointing angle of the blocked profiles."""
    words = f"{place(name).long_name}, of a profile that shows the analog baseline"
    auxiliary = Coverage.AUXILIARY
    return _direction(name, "blocked", long_name=words, coverage=auxiliary, optional=True)


def _gradient(words: str, comment: str = "") -> Error:
    """Return the error by a horizontal gradient."""
    return Error(
        "gradient",
        f"model (systematic) uncertainty of {words} from a horizontal gradient",
        comment=comment
        or "Separate from {quantity}_standard_error, which covers noise and smoothing. Error"
        " that the largest horizontal gradient of ln(backscatter) declared in the settings would"
        " cause. Close to 0 where beams point to all sides.",
    )


def _errors(words: str) -> tuple[Error, ...]:
    """Return the errors of a quantity by a horizontal gradient, dead time and analog baseline."""
    of_signal = (
        Error(
            cause.replace(" ", "_"),
            f"calibration (systematic) uncertainty of {words} from the {cause}",
            comment="Separate from {quantity}_standard_error. Change with one standard error of the"
            f" {cause}, without smoothing. Missing for {missing}.",
            optional=True,
        )
        for cause, missing in (("dead time", "analog signals"), ("baseline", "photon counting"))
    )
    return (_gradient(words), *of_signal)


def _of_planes(row: Row) -> Row:
    """Return the row of a quantity that is retrieved from the beams of each vertical plane."""
    words = row.long_name.removesuffix(" from the station to the altitude")
    gradient = _gradient(
        f"{words} of a plane",
        "Separate from {quantity}_standard_error. Where planes point to all sides, the error that"
        " explains the scatter between planes, pooled over all scans of the file and"
        f" {THRESHOLDS.pooled} altitudes; else as {row.name}_gradient_error.",
    )
    return replace(
        row,
        name=f"plane_{row.name}",
        dims=("time", "plane", "altitude"),
        long_name=f"{words}, from the beams of a vertical plane",
        ancillaries=(),
        errors=(gradient,),
        optional=True,
        comment=f"As {row.name}, with an inhomogeneity of the plane. Its error by the dead time is"
        f" not stated: see {row.name}_dead_time_error. Missing where a test of the plane alone"
        " rejects the value; no flag grades the others. quality_flag and usable are those of all"
        " beams together: where they reject a value, leave out those of its planes too, unless"
        " differences between planes are of interest.",
    )


def _diagnostic(name: str, long_name: str, comment: str, **changes: Any) -> Row:
    """Return the row of what tells how a value comes about and how well it is determined."""
    row = Row(name, long_name, comment, coverage=Coverage.QUALITY, bits=8)
    return replace(row, **changes)


# Noise, and smoothing error that profiles share, are not stated separately.
_RETRIEVED: Final[dict[str, Any]] = {
    "ancillaries": ("data_share", "inhomogeneity", "quality_flag", "beams", "shots"),
    "bits": VALUE_BITS,
    "uncertain": True,
    "error_kind": ErrorKind.BOTH,
}
_OPTICAL_DEPTH: Final = Row(
    "vertical_optical_depth",
    "optical depth of molecules and particles from the station to the altitude",
    "Along the vertical, at the wavelength of the channel.",
    cell_methods=_POINT,
    errors=(
        Error(
            "air",
            "part of the standard error of optical depth from inhomogeneity of the air",
            ErrorKind.BOTH,
            "All channels of the beams have it in common. Missing for mld and mld_prior.",
            part=True,
            optional=True,
        ),
        *_errors("optical depth"),
    ),
    **_RETRIEVED,
)
_EXTINCTION: Final = total_extinction(
    "Mean over the layer in altitude_bnds, at the wavelength of the channel. The error by smoothing"
    " is a mean over altitudes, too small in thin layers: within simulated layers of a few"
    f" altitudes, some values differ by more than 4 standard errors. {MEASURED_SHARES}",
    cell_methods=_MEAN,
    errors=_errors("extinction"),
    **_RETRIEVED,
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
        *_ALONG,
        *(row for row in PLACE if row.name not in ("zenith_angle", "azimuth")),
    ),
    data=(
        _OPTICAL_DEPTH,
        Row(
            "monotone_vertical_optical_depth",
            "profile nearest to vertical_optical_depth that nowhere decreases with altitude",
            "For figures of single profiles. Where the signal is weak, its means over many"
            " profiles are biased high: average vertical_optical_depth instead.",
            cell_methods=_POINT,
            ancillaries=("quality_flag",),
            bits=VALUE_BITS,
            optional=True,
        ),
        _EXTINCTION,
        Row(
            "log_intercept",
            "natural logarithm of the range-corrected signal at zero optical depth",
            "Logarithm of the signal in mV m2 (analog) or MHz m2 (photon counting): system"
            " constant times backscatter coefficient, not calibrated.",
            cell_methods=_POINT,
            ancillaries=("quality_flag", "beams", "shots"),
            uncertain=True,
        ),
        _diagnostic(
            "data_share",
            "share of the optical depth that the data determine",
            "1 where neither smoothness nor a prior has an effect.",
        ),
        _diagnostic(
            "regularisation",
            "strength of the penalty on the derivative along the slant path",
            "For slant paths scaled to a span of 1, and residuals scaled to their noise. Given by"
            " the settings, or the largest one whose residuals are not larger than the noise.",
            valid_min=0.0,
            **_OF_PENALTY,
        ),
        _diagnostic(
            "prior_vertical_optical_depth",
            "optical depth to which the penalty pulls",
            "0, or that of the altitude below. The share 1 - data_share of the optical depth comes"
            " from it.",
            **_OF_PENALTY,
        ),
        _diagnostic(
            "inhomogeneity",
            "standard deviation of ln(signal) between beams in excess of noise",
            "Inhomogeneity of the air between the beams, common to all cycles of the file.",
            valid_min=0.0,
        ),
        _diagnostic(
            "reduced_chi2",
            "reduced chi-square of the fit over the beams",
            "Sum of squared residuals divided by their variances, per degree of freedom. About 1,"
            " because the inhomogeneity is estimated from the residuals; less where the noise is"
            " overstated. Missing where no beam is redundant.",
            valid_min=0.0,
            optional=True,
        ),
        replace(
            _OPTICAL_DEPTH,
            name="layer_vertical_optical_depth",
            dims=("time", "layer"),
            long_name="optical depth of molecules and particles between the bounds of the layer",
            cell_methods="time: mean",
            ancillaries=(),
            errors=(_gradient("the optical depth of the layer"),),
            optional=True,
            comment="Along the vertical, at the wavelength of the channel. Its error by the dead"
            " time is not stated: see vertical_optical_depth_dead_time_error at its bounds. Missing"
            " where quality_flag rejects the value at a bound of the layer.",
        ),
        _of_planes(_OPTICAL_DEPTH),
        _of_planes(_EXTINCTION),
        Row(
            "beam_signal",
            "range-corrected signal of a beam in the altitude cell",
            "Without background, divided by the overlap where one is given. Its noise is"
            " not stated; residual is missing where it is too large.",
            dims=("time", "beam", "altitude"),
            units="{signal} m2",
            cell_methods=_MEAN,
            bits=8,
            optional=True,
        ),
        Row(
            "beam_obstruction",
            "range from which the beam is blocked by an obstruction or a dense cloud",
            "Missing for a free beam. Farther bins are not used.",
            dims=("time", "beam"),
            units="m",
            coverage=Coverage.QUALITY,
            valid_min=0.0,
            optional=True,
        ),
        Row(
            "analog_baseline",
            "analog signal without light, minus its mean in the range of the background",
            "From profiles that a tree or building blocks, at least"
            f" {THRESHOLDS.baseline_guard:g} m behind it; subtracted from all profiles,"
            " interpolated between ranges. Its standard error is that of noise and of the scatter"
            " between profiles, and part of the error of the backgrounds; it grows before the first"
            " range.",
            dims=("baseline_range",),
            units="{signal}",
            coverage=Coverage.AUXILIARY,
            uncertain=True,
            error_kind=ErrorKind.SYSTEMATIC,
            optional=True,
        ),
        Row(
            "blocked_range",
            "range from which a profile that shows the analog baseline is blocked",
            dims=("blocked",),
            units="m",
            coverage=Coverage.AUXILIARY,
            valid_min=0.0,
            optional=True,
        ),
        _blocked("zenith_angle"),
        _blocked("azimuth"),
        _diagnostic(
            "residual",
            "natural logarithm of the signal of a beam minus the fit over the beams",
            "Missing where the beam has no usable signal.",
            dims=("time", "beam", "altitude"),
        ),
        retrieval_method(
            tuple(name for name in get_args(Method) if name != "auto"),
            "The method that ran: auto of the settings chooses two_angle or joint from the data.",
        ),
        BACKGROUND_METHOD,
        quality(FLAGS),
        _diagnostic(
            "effective_degrees_of_freedom",
            "number of independent values of the profile that the data determine",
            "Missing where there is no profile.",
            dims=("time",),
            valid_min=0.0,
            bits=None,
        ),
        per_profile(
            "reach",
            "highest altitude above the geoid with an estimate",
            "Missing where there is no estimate.",
            units="m",
        ),
        count("beams", "number of beam directions with a signal in the scan cycle"),
        shots(of="all beams of the scan cycle"),
    ),
)

"""Multi-angle products as plain arrays: profiles with the truth, and residuals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.raster import bin_edges
from lidarops.figures.series_data import quality_bits, require
from lidarops.figures.time_axis import usual_step
from lidarops.kinds import flags_of
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

QUANTITIES: Final = ("vertical_optical_depth", "total_extinction")
"""Retrieved quantities of a profile, as the names of their variables."""

_ERRORS: Final = ("", "_standard_error", "_gradient_error")
_ALONG_BOTH: Final = (
    *(f"{name}{error}" for name in QUANTITIES for error in _ERRORS),
    "quality_flag",
)
_CAUSES: Final = ("dead_time", "baseline")
"""Of errors that products of some channels have."""
_PROFILES: Final = ("time", "altitude", "reach", *_ALONG_BOTH)
CYCLE_VARIABLES: Final = (
    *_PROFILES,
    *(f"{name}_{cause}_error" for name in QUANTITIES for cause in _CAUSES),
    "time_bnds",
    "station_altitude",
    "wavelength",
)
"""Variables that `clearest_cycle` reads."""
_OF_RESIDUALS: Final = {
    "time": ("time",),
    "altitude": ("altitude",),
    "beam_zenith_angle": ("beam",),
    "quality_flag": ("time", "altitude"),
    "residual": ("time", "beam", "altitude"),
}
RESIDUAL_VARIABLES: Final = (*_OF_RESIDUALS, "beam_azimuth")
"""Variables that `read_residuals` needs."""
_REJECTED: Final = flags_of("multiangle").rejecting
_WITH_CARE: Final = flags_of("multiangle").caring
_UNITS: Final = {"vertical_optical_depth": "1", "total_extinction": "m-1"}
_BEYOND: Final = 1.15
"""A profile is shown to this many times the height of its reach above the lowest altitude."""
_LOWEST_BEAM: Final = 80.0
"""degree from the zenith; a truth along a lower beam is not used as a vertical profile."""
_SAME_WAVELENGTH: Final = 1e-9
"""m, largest difference between the wavelengths of product and truth."""
_PLANE: Final = 5.0
"""degree, largest difference between azimuths of one plane."""
_UPRIGHT: Final = 0.5
"""degree from the zenith, below which an azimuth is meaningless."""
_MAP_ROWS: Final = 100
"""Most rows of a map of residuals."""
_READ_BYTES: Final = 48_000_000
"""Most bytes of residuals in memory."""


@dataclass(frozen=True, slots=True)
class ProfileEstimate:
    """One retrieved quantity against altitude, (altitude,)."""

    value: Floats
    """NaN where rejected."""
    rejected: Floats
    """Rejected values; NaN elsewhere."""
    standard_error: Floats
    """Of noise and smoothing."""
    gradient_error: Floats
    """Largest systematic error from a horizontal gradient."""
    of_channel: dict[str, Floats]
    """Standard errors by what the product states of its channel: dead time or baseline."""


@dataclass(frozen=True, slots=True)
class TrueProfile:
    """True profile along a simulated beam, for level layers."""

    time: np.datetime64
    """UTC, of the raw file."""
    zenith_angle: float
    """degree, of the beam that the truth is given along."""
    edges: Floats
    """(cell + 1,) m, altitude."""
    extinction: Floats
    """(cell,) m-1."""
    optical_depth: Floats
    """(cell + 1,) Vertical optical depth from the lidar to each edge."""


@dataclass(frozen=True, slots=True)
class ScanProfile:
    """The profile of one scan cycle, to just beyond its reach."""

    time: np.datetime64
    """UTC."""
    altitude: Floats
    """(altitude,) m."""
    estimates: dict[str, ProfileEstimate]
    """Estimate of each of `QUANTITIES`."""
    flag: NDArray[np.int64]
    """(altitude,) Bits of the kind."""
    reach: float
    """m, highest altitude with an estimate; NaN without one."""
    truth: TrueProfile | None

    @property
    def with_care(self) -> Mask:
        """(altitude,) Whether the value is usable, but only with care."""
        return np.asarray(((self.flag & _WITH_CARE) != 0) & ((self.flag & _REJECTED) == 0))


@dataclass(frozen=True, slots=True)
class ScanResiduals:
    """Residuals of the fit over zenith angles, by beam.

    Beams are sorted by plane, and within a plane from one horizon over the zenith to the other.
    """

    zenith_angle: Floats
    """(beam,) degree, negative on the side away from the azimuth of the plane."""
    plane: NDArray[np.intp]
    """(beam,) Index of its plane."""
    azimuths: tuple[float, ...]
    """(plane,) degree, of the positive side; NaN for beams of unknown azimuth."""
    edges: Floats
    """(row + 1,) m, altitude."""
    mean: Floats
    """(row, beam) Mean residual over cycles and the altitudes of a row, percent of the signal."""
    count: Floats
    """(row, beam) Number of residuals in the mean."""
    rms: Floats
    """(beam,) Root mean square over cycles and altitudes, percent."""
    rms_of_mean: Floats
    """(beam,) Root mean square of the means over cycles, weighted by their number of residuals,
    percent: the part that does not average out."""
    cycles: int
    """Number of cycles with a residual."""


def clearest_cycle(
    product: xr.Dataset, truth: xr.Dataset | None = None, *, instrument: str = ""
) -> ScanProfile | None:
    """Return the cycle with the most unflagged optical depths.

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``.
    truth : Dataset, optional
        Truth of a simulated campaign; its profiles are used, see `true_profile`.
    instrument : str, optional
        Instrument, to select its truth.

    Returns
    -------
    ScanProfile or None
        Among equals, the cycle with the most usable values (a one-sided scan is flagged at all
        altitudes), then with the most values, then the first. None without any value.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions or units.
    """
    _check_profiles(product)
    flag = quality_bits(product["quality_flag"])
    known = np.isfinite(product["vertical_optical_depth"].values.astype(np.float64))
    clear = (known & (flag == 0)).sum(axis=1)
    usable = (known & ((flag & _REJECTED) == 0)).sum(axis=1)
    if not known.any():
        return None
    earlier = -np.arange(clear.size)
    index = int(np.lexsort((earlier, known.sum(axis=1), usable, clear))[-1])
    altitude = product["altitude"].values.astype(np.float64)
    reach = float(product["reach"].values[index])
    drawn = _to_reach(altitude, reach)
    chosen = product.isel(time=index, altitude=drawn)
    bits = flag[index, drawn]
    return ScanProfile(
        time=product["time"].values.astype("datetime64[ns]")[index],
        altitude=altitude[drawn],
        estimates={name: _estimate(chosen, name, bits) for name in QUANTITIES},
        flag=bits,
        reach=reach,
        truth=None if truth is None else true_profile(product, index, truth, instrument=instrument),
    )


def _to_reach(altitude: Floats, reach: float) -> Mask:
    if not np.isfinite(reach):
        return np.ones(altitude.size, dtype=np.bool_)
    return np.asarray(altitude <= altitude[0] + _BEYOND * max(reach - altitude[0], 0.0))


def _estimate(cycle: xr.Dataset, name: str, bits: NDArray[np.int64]) -> ProfileEstimate:
    rejected = (bits & _REJECTED) != 0

    def kept(variable: str) -> Floats:
        return np.where(rejected, np.nan, cycle[variable].values.astype(np.float64))

    return ProfileEstimate(
        value=kept(name),
        rejected=np.where(rejected, cycle[name].values.astype(np.float64), np.nan),
        standard_error=kept(f"{name}_standard_error"),
        gradient_error=kept(f"{name}_gradient_error"),
        of_channel={
            cause.replace("_", " "): kept(f"{name}_{cause}_error")
            for cause in _CAUSES
            if f"{name}_{cause}_error" in cycle.variables
        },
    )


def _check_profiles(product: xr.Dataset) -> None:
    require(
        product,
        {"time": ("time",), "altitude": ("altitude",), "reach": ("time",)}
        | dict.fromkeys(_ALONG_BOTH, ("time", "altitude")),
    )
    for name, expected in _UNITS.items():
        units = product[name].attrs.get("units")
        if units != expected:
            raise ProductError(f"has the units {units!r}, not {expected!r}", field=name)


# The truth of a simulation -------------------------------------------------------------------


def true_profile(
    product: xr.Dataset, index: int, truth: xr.Dataset, *, instrument: str
) -> TrueProfile | None:
    """Return the true profile for one cycle.

    Of the raw files with a true profile, within a cycle or up to its length before or after it,
    the one nearest to the zenith is used, and among equals the nearest in time. Layers are level:
    a cell at the range R lies R cos(zenith angle) above the station, and the vertical optical
    depth is the optical depth along the beam times cos(zenith angle).

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``.
    index : int
        Index of the cycle.
    truth : Dataset
        See `lidarops.simulate.truth`.
    instrument : str
        Instrument, to select its truth.

    Returns
    -------
    TrueProfile or None
        None if the truth has no such profile within 80 degrees of the zenith at the wavelength of
        the product, or the altitude of the station is unknown.
    """
    suffix = instrument.replace("-", "_")
    names = ("granule", "total_extinction", "path_optical_depth")
    variables = {name: f"profile_{name}_{suffix}" for name in names}
    needed = [*variables.values(), f"range_{suffix}", f"range_end_{suffix}", "zenith_angle", "time"]
    column = _wavelength_index(product, truth, suffix)
    if "station_altitude" not in product.variables or column is None:
        return None
    if not all(name in truth.variables for name in needed):
        return None
    granule = truth[variables["granule"]].values.astype(np.intp)
    zenith = np.abs(truth["zenith_angle"].values.astype(np.float64)[granule])
    time = truth["time"].values.astype("datetime64[ns]")[granule]
    row = _nearest_upright(zenith, time, *_cycle(product, index))
    if row is None:
        return None
    cosine = float(np.cos(np.radians(zenith[row])))
    end = truth[f"range_end_{suffix}"].values.astype(np.float64)
    start = 2.0 * truth[f"range_{suffix}"].values.astype(np.float64)[:1] - end[:1]
    extinction, depth = (
        truth[variables[name]].values[row, column].astype(np.float64) for name in names[1:]
    )
    at_start = 0.0 if abs(float(start[0])) <= 1e-6 * float(end[0]) else np.nan
    return TrueProfile(
        time=time[row],
        zenith_angle=float(zenith[row]),
        edges=float(product["station_altitude"]) + np.concatenate([start, end]) * cosine,
        extinction=extinction,
        optical_depth=np.append(at_start, depth) * cosine,
    )


def _wavelength_index(product: xr.Dataset, truth: xr.Dataset, suffix: str) -> int | None:
    name = f"wavelength_{suffix}"
    if name not in truth.variables or "wavelength" not in product.variables:
        return None
    wavelength = product["wavelength"]
    metres = float(wavelength) * (1e-9 if wavelength.attrs.get("units", "nm") == "nm" else 1.0)
    difference = np.abs(truth[name].values.astype(np.float64) - metres)
    nearest = int(np.argmin(difference))
    return nearest if difference[nearest] <= _SAME_WAVELENGTH else None


def _cycle(product: xr.Dataset, index: int) -> tuple[np.datetime64, np.timedelta64]:
    """Return middle and length of a cycle."""
    time = product["time"].values.astype("datetime64[ns]")
    if "time_bnds" in product.variables:
        start, stop = product["time_bnds"].values.astype("datetime64[ns]")[index]
        return time[index], stop - start
    return time[index], usual_step(np.sort(time))


def _nearest_upright(
    zenith: Floats, time: NDArray[np.datetime64], middle: np.datetime64, length: np.timedelta64
) -> int | None:
    distance = np.abs(time - middle)
    rows = np.flatnonzero((2 * distance <= 3 * length) & (zenith <= _LOWEST_BEAM))
    if rows.size == 0:
        return None
    return int(rows[np.lexsort((distance[rows], zenith[rows]))[0]])


# Residuals -----------------------------------------------------------------------------------


def read_residuals(product: xr.Dataset) -> ScanResiduals | None:
    """Average the residuals of a product over its cycles.

    Residuals are 100 ln(signal / fit) in percent. Those with
    `MultiAngleQuality.NO_RESIDUAL` are left out, because they are always zero. Other flagged
    values are kept, because residuals show the reason of the flag.

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``; may be lazy, because it is read in blocks.

    Returns
    -------
    ScanResiduals or None
        Up to the highest altitude with a residual; None without any residual.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions; ``beam_azimuth`` may be missing.
    """
    known = {"beam_azimuth": ("beam",)} if "beam_azimuth" in product.variables else {}
    require(product, known | _OF_RESIDUALS)
    total, squares, count, cycles = _sums(product)
    if not count.any():
        return None
    zenith = product["beam_zenith_angle"].values.astype(np.float64)
    azimuth = product["beam_azimuth"].values if known else np.full(zenith.size, np.nan)
    zenith, plane, azimuths, order = _in_the_sky(zenith, azimuth.astype(np.float64))
    top = int(np.flatnonzero(count.any(axis=0))[-1]) + 1
    size = -(-top // _MAP_ROWS)
    starts = np.arange(0, top, size)
    count, total = count[order, :top], total[order, :top]
    in_row = np.add.reduceat(count, starts, axis=1)
    by_row = _ratio(np.add.reduceat(total, starts, axis=1), in_row)
    squares_of_means = (total**2 / np.maximum(count, 1.0)).sum(axis=1)
    beam_count = count.sum(axis=1)
    return ScanResiduals(
        zenith_angle=zenith,
        plane=plane,
        azimuths=azimuths,
        edges=_edges(product["altitude"].values.astype(np.float64))[[*starts, top]],
        mean=100.0 * by_row.T,
        count=in_row.T,
        rms=100.0 * np.sqrt(_ratio(squares[order].sum(axis=1), beam_count)),
        rms_of_mean=100.0 * np.sqrt(_ratio(squares_of_means, beam_count)),
        cycles=cycles,
    )


def _sums(product: xr.Dataset) -> tuple[Floats, Floats, Floats, int]:
    """Return sums of residuals, of their squares and of their number, and the number of cycles.

    The sums are those over cycles, (beam, altitude).
    """
    total, squares, count = np.zeros((3, *product["residual"].shape[1:]))
    cycles = 0
    for part in _parts(product):
        no_residual = (quality_bits(part["quality_flag"]) & int(MultiAngleQuality.NO_RESIDUAL)) != 0
        residual = part["residual"].values.astype(np.float64)
        known = np.isfinite(residual) & ~no_residual[:, np.newaxis, :]
        residual = np.where(known, residual, 0.0)
        total += residual.sum(axis=0)
        squares += (residual**2).sum(axis=0)
        count += known.sum(axis=0)
        cycles += int(known.any(axis=(1, 2)).sum())
    return total, squares, count, cycles


def _parts(product: xr.Dataset) -> Iterator[xr.Dataset]:
    cycle_bytes = 8 * product.sizes["beam"] * product.sizes["altitude"]
    cycles = max(1, _READ_BYTES // max(cycle_bytes, 1))
    for first in range(0, product.sizes["time"], cycles):
        yield product[["residual", "quality_flag"]].isel(time=slice(first, first + cycles))


def _ratio(total: Floats, count: Floats) -> Floats:
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _edges(middles: Floats) -> Floats:
    if middles.size == 1:
        return np.array([middles[0] - 0.5, middles[0] + 0.5])
    return bin_edges(middles)


def _in_the_sky(
    zenith: Floats, azimuth: Floats
) -> tuple[Floats, NDArray[np.intp], tuple[float, ...], NDArray[np.intp]]:
    """Return signed zenith angles, planes and their azimuths, and the order of the beams."""
    # A negative zenith angle points opposite to the azimuth, even if that is unknown.
    azimuth = np.where(zenith < 0, azimuth + 180.0, azimuth) % 360.0
    signed = np.where(np.isnan(azimuth), zenith, np.abs(zenith))
    plane = np.zeros(zenith.size, dtype=np.intp)
    azimuths: list[float] = []
    tilted = [int(k) for k in np.argsort(azimuth, kind="stable") if abs(zenith[k]) > _UPRIGHT]
    for k in tilted:
        plane[k], side = _side(float(azimuth[k]), azimuths)
        signed[k] *= side
    order = np.lexsort((signed, plane))
    return signed[order], plane[order], tuple(azimuths), order


def _side(azimuth: float, azimuths: list[float]) -> tuple[int, float]:
    """Return plane and side of an azimuth; append a new plane if it lies in none."""
    for index, known in enumerate(azimuths):
        turn = abs((azimuth - known + 180.0) % 360.0 - 180.0)
        if turn <= _PLANE or (np.isnan(azimuth) and np.isnan(known)):
            return index, 1.0
        if turn >= 180.0 - _PLANE:
            return index, -1.0
    azimuths.append(azimuth)
    return len(azimuths) - 1, 1.0

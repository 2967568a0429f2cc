"""Multi-angle products as plain arrays: what is drawn of one, and the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.raster import Raster, read_raster
from lidarops.figures.series_data import require
from lidarops.figures.time_axis import usual_step
from lidarops.flags import Quality, Severity

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

QUANTITIES: Final = ("optical_depth", "extinction")
"""Retrieved quantities of a profile, by the name of their variable."""

_ERRORS: Final = ("", "_standard_error", "_gradient_error")
_ALONG_BOTH: Final = (
    *(f"{name}{error}" for name in QUANTITIES for error in _ERRORS),
    "quality_flag",
)
_PROFILES: Final = ("time", "altitude", "reach", *_ALONG_BOTH)
CYCLE_VARIABLES: Final = (*_PROFILES, "time_bnds", "station_altitude", "wavelength")
"""What `clearest_cycle` reads of a product."""
EXTINCTION_VARIABLES: Final = _PROFILES
"""What `read_extinction` reads of a product."""
RESIDUAL_VARIABLES: Final = (
    "time",
    "altitude",
    "beam_zenith_angle",
    "beam_azimuth",
    "quality_flag",
    "residual",
)
"""What `read_residuals` reads of a product."""
_REJECTED: Final = int(Quality.rejecting())
_WITH_CARE: Final = int(sum(bit for bit in Quality if bit.severity is Severity.CARE))
_UNITS: Final = {"optical_depth": "1", "extinction": "m-1"}
_BEYOND: Final = 1.15
"""Times the height of the reach above the lowest altitude, to which a profile is shown."""
_LOWEST_BEAM: Final = 80.0
"""degree from the zenith: a truth seen closer to the horizon is not taken for a profile."""
_SAME_COLOUR: Final = 1e-9
"""m, to which wavelengths of product and truth agree."""
_PLANE: Final = 5.0
"""degree between azimuths of one plane."""
_UPRIGHT: Final = 0.5
"""degree from the zenith, below which an azimuth says nothing."""
_MAP_ROWS: Final = 100
"""Most rows of a map of residuals."""
_READ_BYTES: Final = 48_000_000
"""Bound on what is held in memory of the residuals."""


@dataclass(frozen=True, slots=True)
class ProfileEstimate:
    """One retrieved quantity against altitude, (altitude,)."""

    value: Floats
    """NaN where rejected."""
    rejected: Floats
    """Values that are not to be used; NaN elsewhere."""
    standard_error: Floats
    gradient_error: Floats
    """Largest systematic error that a horizontal gradient makes."""


@dataclass(frozen=True, slots=True)
class TrueProfile:
    """The air on a simulated beam, over level layers."""

    time: np.datetime64
    """UTC, of the raw file."""
    zenith_angle: float
    """degree, of the beam that it was told along."""
    edges: Floats
    """(cell + 1,) m, altitude."""
    extinction: Floats
    """(cell,) m-1."""
    optical_depth: Floats
    """(cell + 1,) From the lidar straight up to each edge."""


@dataclass(frozen=True, slots=True)
class ScanProfile:
    """The profile of one cycle of a scan, to just beyond its reach."""

    time: np.datetime64
    """UTC."""
    altitude: Floats
    """(altitude,) m."""
    estimates: dict[str, ProfileEstimate]
    """By each of `QUANTITIES`."""
    flag: NDArray[np.int64]
    """(altitude,) Bits of `Quality`."""
    reach: float
    """m, highest altitude with an estimate; NaN where there is none."""
    truth: TrueProfile | None

    @property
    def with_care(self) -> Mask:
        """(altitude,) Whether the value stands, but a bit asks for care."""
        return np.asarray(((self.flag & _WITH_CARE) != 0) & ((self.flag & _REJECTED) == 0))


@dataclass(frozen=True, slots=True)
class ScanResiduals:
    """What a fit over angles leaves of the signal, by beam.

    Beams stand in the order of the sky: plane by plane, and in a plane from one horizon over the
    zenith to the other.
    """

    zenith_angle: Floats
    """(beam,) degree, negative on the side away from the azimuth of the plane."""
    plane: NDArray[np.intp]
    """(beam,) Index of its plane."""
    azimuths: tuple[float, ...]
    """(plane,) degree, of the positive side; NaN for beams whose azimuth is not known."""
    edges: Floats
    """(row + 1,) m, altitude."""
    mean: Floats
    """(row, beam) Mean residual over cycles and the altitudes of a row, per cent of the signal."""
    count: Floats
    """(row, beam) Number of residuals in that mean."""
    rms: Floats
    """(beam,) Root mean square over cycles and altitudes, per cent."""
    rms_of_mean: Floats
    """(beam,) The same of the means over cycles, weighted by their residuals: what does not average
    out."""
    cycles: int
    """Cycles with a residual."""
    altitudes: int
    """In a row."""


def clearest_cycle(
    product: xr.Dataset, truth: xr.Dataset | None = None, *, instrument: str = ""
) -> ScanProfile | None:
    """Return the cycle with most optical depths that no bit speaks against.

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``.
    truth : Dataset, optional
        Of a simulated campaign; its profiles are used, see `true_profile`.
    instrument : str, optional
        Whose truth to take.

    Returns
    -------
    ScanProfile or None
        Of equals the one with most that no bit rejects (a scan to one side has a bit at all
        altitudes), then with most values, then the first. None where there is no value.

    Raises
    ------
    ProductError
        Where a variable is missing or has other dims or units.
    """
    _check_profiles(product)
    flag = _bits(product)
    known = np.isfinite(product["optical_depth"].values.astype(np.float64))
    clear = (known & (flag == 0)).sum(axis=1)
    usable = (known & ((flag & _REJECTED) == 0)).sum(axis=1)
    if not known.any():
        return None
    earlier = -np.arange(clear.size)
    index = int(np.lexsort((earlier, known.sum(axis=1), usable, clear))[-1])
    altitude = product["altitude"].values.astype(np.float64)
    reach = float(product["reach"].values[index])
    shown = _shown(altitude, reach)
    chosen = product.isel(time=index, altitude=shown)
    bits = flag[index, shown]
    return ScanProfile(
        time=product["time"].values.astype("datetime64[ns]")[index],
        altitude=altitude[shown],
        estimates={name: _estimate(chosen, name, bits) for name in QUANTITIES},
        flag=bits,
        reach=reach,
        truth=None if truth is None else true_profile(product, index, truth, instrument=instrument),
    )


def _shown(altitude: Floats, reach: float) -> Mask:
    if not np.isfinite(reach):
        return np.ones(altitude.size, dtype=np.bool_)
    return np.asarray(altitude <= altitude[0] + _BEYOND * max(reach - altitude[0], 0.0))


def _estimate(chosen: xr.Dataset, name: str, bits: NDArray[np.int64]) -> ProfileEstimate:
    value = chosen[name].values.astype(np.float64)
    rejected = (bits & _REJECTED) != 0

    def kept(suffix: str) -> Floats:
        return np.where(rejected, np.nan, chosen[f"{name}_{suffix}"].values.astype(np.float64))

    return ProfileEstimate(
        value=np.where(rejected, np.nan, value),
        rejected=np.where(rejected, value, np.nan),
        standard_error=kept("standard_error"),
        gradient_error=kept("gradient_error"),
    )


def _check_profiles(product: xr.Dataset) -> None:
    require(
        product,
        {"time": ("time",), "altitude": ("altitude",), "reach": ("time",)}
        | dict.fromkeys(_ALONG_BOTH, ("time", "altitude")),
    )
    for name, wanted in _UNITS.items():
        units = product[name].attrs.get("units")
        if units != wanted:
            raise ProductError(f"has the units {units!r}, not {wanted!r}", field=name)


def _bits(product: xr.Dataset) -> NDArray[np.int64]:
    values = product["quality_flag"].values
    if values.dtype.kind == "f":
        # A fill value makes xarray turn integers into floats with NaN in its place.
        values = np.where(np.isfinite(values), values, float(Quality.INPUT_MISSING))
    return np.asarray(values, dtype=np.int64)


# The truth of a simulation -------------------------------------------------------------------


def true_profile(
    product: xr.Dataset, index: int, truth: xr.Dataset, *, instrument: str
) -> TrueProfile | None:
    """Return what a perfect retrieval of one cycle would find.

    Of the raw files within a cycle, or up to its length before or after it, whose air is told,
    the one nearest to the zenith is taken, and of equals the nearest in time. Layers are level:
    a cell at the range R lies R cos(zenith angle) above the station, and the optical depth
    straight up is that along the beam times the cosine.

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``.
    index : int
        Of the cycle.
    truth : Dataset
        See `lidarops.simulate.truth`.
    instrument : str
        Whose truth to take.

    Returns
    -------
    TrueProfile or None
        None where the truth tells no such profile within 80 degrees of the zenith, not at the
        wavelength of the product, or the altitude of the station is not known.
    """
    suffix = instrument.replace("-", "_")
    of = {name: f"profile_{name}_{suffix}" for name in ("granule", *QUANTITIES)}
    needed = [*of.values(), f"range_{suffix}", f"range_end_{suffix}", "zenith_angle", "time"]
    colour = _colour(product, truth, suffix)
    if "station_altitude" not in product.variables or colour is None:
        return None
    if not all(name in truth.variables for name in needed):
        return None
    granule = truth[of["granule"]].values.astype(np.intp)
    zenith = np.abs(truth["zenith_angle"].values.astype(np.float64)[granule])
    time = truth["time"].values.astype("datetime64[ns]")[granule]
    row = _nearest_upright(zenith, time, *_cycle(product, index))
    if row is None:
        return None
    upright = float(np.cos(np.radians(zenith[row])))
    end = truth[f"range_end_{suffix}"].values.astype(np.float64)
    start = 2.0 * truth[f"range_{suffix}"].values.astype(np.float64)[:1] - end[:1]
    told = {name: truth[of[name]].values[row, colour].astype(np.float64) for name in QUANTITIES}
    at_start = 0.0 if abs(float(start[0])) <= 1e-6 * float(end[0]) else np.nan
    return TrueProfile(
        time=time[row],
        zenith_angle=float(zenith[row]),
        edges=float(product["station_altitude"]) + np.concatenate([start, end]) * upright,
        extinction=told["extinction"],
        optical_depth=np.append(at_start, told["optical_depth"]) * upright,
    )


def _colour(product: xr.Dataset, truth: xr.Dataset, suffix: str) -> int | None:
    name = f"wavelength_{suffix}"
    if name not in truth.variables or "wavelength" not in product.variables:
        return None
    told = product["wavelength"]
    metres = float(told) * (1e-9 if told.attrs.get("units", "nm") == "nm" else 1.0)
    apart = np.abs(truth[name].values.astype(np.float64) - metres)
    nearest = int(np.argmin(apart))
    return nearest if apart[nearest] <= _SAME_COLOUR else None


def _cycle(product: xr.Dataset, index: int) -> tuple[np.datetime64, np.timedelta64]:
    """Return the middle of a cycle and its length."""
    time = product["time"].values.astype("datetime64[ns]")
    if "time_bnds" in product.variables:
        start, stop = product["time_bnds"].values.astype("datetime64[ns]")[index]
        return time[index], stop - start
    return time[index], usual_step(np.sort(time))


def _nearest_upright(
    zenith: Floats, time: NDArray[np.datetime64], middle: np.datetime64, length: np.timedelta64
) -> int | None:
    apart = np.abs(time - middle)
    found = np.flatnonzero((2 * apart <= 3 * length) & (zenith <= _LOWEST_BEAM))
    if found.size == 0:
        return None
    return int(found[np.lexsort((apart[found], zenith[found]))[0]])


# Residuals -----------------------------------------------------------------------------------


def read_residuals(product: xr.Dataset) -> ScanResiduals | None:
    """Average the residuals of a product over its cycles.

    Residuals are differences of logarithms, 100 ln(signal / fit) in per cent. Those of values
    that carry `Quality.NO_RESIDUAL` are left out: they are zero whatever the air is like. Flagged
    values are kept, as what speaks against them shows here.

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``; may be lazy: it is read block by block.

    Returns
    -------
    ScanResiduals or None
        To the highest altitude with a residual; None where there is no residual.

    Raises
    ------
    ProductError
        Where a variable is missing or has other dims; but `beam_azimuth`, where it is not known.
    """
    known = {"beam_azimuth": ("beam",)} if "beam_azimuth" in product.variables else {}
    require(
        product,
        known
        | {
            "time": ("time",),
            "altitude": ("altitude",),
            "beam_zenith_angle": ("beam",),
            "quality_flag": ("time", "altitude"),
            "residual": ("time", "beam", "altitude"),
        },
    )
    sums = _sums(product)
    if not sums.count.any():
        return None
    zenith = product["beam_zenith_angle"].values.astype(np.float64)
    azimuth = product["beam_azimuth"].values if known else np.full(zenith.size, np.nan)
    zenith, plane, azimuths, order = _in_the_sky(zenith, azimuth.astype(np.float64))
    top = int(np.flatnonzero(sums.count.any(axis=0))[-1]) + 1
    size = -(-top // _MAP_ROWS)
    starts = np.arange(0, top, size)
    count, total = sums.count[order, :top], sums.total[order, :top]
    in_row = np.add.reduceat(count, starts, axis=1)
    by_row = _ratio(np.add.reduceat(total, starts, axis=1), in_row)
    squares_of_means = (total**2 / np.maximum(count, 1.0)).sum(axis=1)
    of_beam = count.sum(axis=1)
    return ScanResiduals(
        zenith_angle=zenith,
        plane=plane,
        azimuths=azimuths,
        edges=_edges(product["altitude"].values.astype(np.float64))[[*starts, top]],
        mean=100.0 * by_row.T,
        count=in_row.T,
        rms=100.0 * np.sqrt(_ratio(sums.squares[order].sum(axis=1), of_beam)),
        rms_of_mean=100.0 * np.sqrt(_ratio(squares_of_means, of_beam)),
        cycles=sums.cycles,
        altitudes=size,
    )


@dataclass(slots=True)
class _Sums:
    """Of residuals over cycles, (beam, altitude)."""

    total: Floats
    squares: Floats
    count: Floats
    cycles: int = 0


def _sums(product: xr.Dataset) -> _Sums:
    shape = product["residual"].shape[1:]
    sums = _Sums(np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for part in _parts(product):
        untold = (_bits(part) & int(Quality.NO_RESIDUAL)) != 0
        residual = part["residual"].values.astype(np.float64)
        known = np.isfinite(residual) & ~untold[:, np.newaxis, :]
        residual = np.where(known, residual, 0.0)
        sums.total += residual.sum(axis=0)
        sums.squares += (residual**2).sum(axis=0)
        sums.count += known.sum(axis=0)
        sums.cycles += int(known.any(axis=(1, 2)).sum())
    return sums


def _parts(product: xr.Dataset) -> Iterator[xr.Dataset]:
    one = 8 * product.sizes["beam"] * product.sizes["altitude"]
    few = max(1, _READ_BYTES // max(one, 1))
    for first in range(0, product.sizes["time"], few):
        yield product[["residual", "quality_flag"]].isel(time=slice(first, first + few))


def _ratio(total: Floats, count: Floats) -> Floats:
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _edges(middles: Floats) -> Floats:
    if middles.size == 1:
        return np.array([middles[0] - 0.5, middles[0] + 0.5])
    between = 0.5 * (middles[1:] + middles[:-1])
    ends = 1.5 * middles[[0, -1]] - 0.5 * middles[[1, -2]]
    return np.concatenate([ends[:1], between, ends[1:]])


def _in_the_sky(
    zenith: Floats, azimuth: Floats
) -> tuple[Floats, NDArray[np.intp], tuple[float, ...], NDArray[np.intp]]:
    """Return signed zenith angles, planes and their azimuths, and the order of the beams."""
    # A negative zenith angle leads opposite to the azimuth, also to one that is not known.
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
    """Return the plane and the side of an azimuth, in a new plane where it lies in none."""
    for index, known in enumerate(azimuths):
        turn = abs((azimuth - known + 180.0) % 360.0 - 180.0)
        if turn <= _PLANE or (np.isnan(azimuth) and np.isnan(known)):
            return index, 1.0
        if turn >= 180.0 - _PLANE:
            return index, -1.0
    azimuths.append(azimuth)
    return len(azimuths) - 1, 1.0


# Extinction over time ------------------------------------------------------------------------


def read_extinction(product: xr.Dataset, *, profiles: int = 0) -> Raster:
    """Reduce the extinction of a product to block means over time and altitude.

    Parameters
    ----------
    product : Dataset
        Kind ``multiangle``; may be lazy.
    profiles : int, optional
        Cycles to a column; as many as fit an image where 0.

    Returns
    -------
    Raster
        In km-1, with edges in altitude instead of range and no background.

    Raises
    ------
    ProductError
        Where a variable is missing or has other dims or units, or nothing was retrieved.
    """
    _check_profiles(product)
    nothing = ("time", np.full(product.sizes["time"], np.nan))
    extinction = product[["extinction", "extinction_standard_error"]] * 1e3
    drawn = (
        extinction.assign(quality_flag=product["quality_flag"])
        .drop_vars([name for name in extinction.coords if name not in ("time", "altitude")])
        .rename(altitude="range")
        .assign(background=nothing, background_standard_error=nothing)
    )
    drawn["extinction"].attrs["units"] = "km$^{-1}$"
    return read_raster(drawn, quantity="extinction", profiles=profiles)

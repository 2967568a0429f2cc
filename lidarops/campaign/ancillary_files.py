"""Read ancillary files: soundings, overlap functions and lidar ratios, as CSV or NetCDF.

All hold named columns. The unit is given in brackets after the name of a CSV column
(``pressure [hPa]``) or in the attribute ``units`` of a NetCDF variable; SI where none is given.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import AncillaryError, RetrievalInputError
from lidarops.records import InputRecord, Role
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.errors import BACKSCATTER_CAUSES, EXTINCTION_CAUSES, RANDOM
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.system.files import opened_regular

Array = npt.NDArray[np.float64]

Table = Mapping[str, tuple[str, Array]]
"""Name of a column -> its unit, its values."""


@dataclass(frozen=True, slots=True)
class _Column:
    """A quantity of ancillary files, and the values that it may have."""

    units: Mapping[str, float]
    """Unit -> factor to the SI unit, which comes first."""
    least: float = -np.inf
    most: float = np.inf
    remedy: str = ""


_METRES: Final = _Column({"m": 1.0, "km": 1000.0})
_COLUMNS: Final[Mapping[str, _Column]] = {
    "altitude": _METRES,
    "range": _METRES,
    "pressure": _Column({"Pa": 1.0, "hPa": 100.0, "mbar": 100.0}),
    "temperature": _Column({"K": 1.0, "degC": 1.0}),
    "overlap": _Column(
        {"1": 1.0},
        float(np.nextafter(0.0, 1.0)),
        1.0,
        "give values above 0 and at most 1; leave out ranges without overlap",
    ),
    # As for the facts of these names.
    "lidar_ratio": _Column({"sr": 1.0}, 1.0, 200.0, "give values from 1 to 200 sr"),
    "lidar_ratio_standard_error": _Column({"sr": 1.0}, 0.0, 200.0, "give values from 0 to 200 sr"),
}
_FULL: Final = 0.95
"""Smallest final overlap of a profile that counts as full."""
_SHORTEST: Final = 30.0
"""m; a profile that ends nearer is probably in km."""
_MEASURED: Final = frozenset({"lidar_ratio_error_random", "lidar_ratio_error_systematic", "usable"})
"""Variables of a product with measured lidar ratios and overlap."""
_LIDAR_RATIO_NEEDS: Final = frozenset(
    {"altitude", "quality_flag", "aerosol_extinction", "aerosol_backscatter", "vertical_resolution"}
    | {"molecular_backscatter", "reference_scattering_ratio"}
    | {"reference_scattering_ratio_standard_error"}
    | {f"aerosol_extinction_error_{cause}" for cause in EXTINCTION_CAUSES if cause != "baseline"}
    | {f"aerosol_backscatter_error_{cause}" for cause in BACKSCATTER_CAUSES if cause != "baseline"}
)
"""What else a product with measured lidar ratios holds. Former products state no baseline error."""
_SEVERAL: Final = 0.5
"""Share of the profiles of the most frequent height that a height with a lidar ratio exceeds."""
_LEAST_NOISE: Final = 1e-3
"""Relative noise of a profile, below which its weight does not grow."""
_CERTAIN: Final = 3.0
"""Standard errors by which mean backscatter exceeds zero; that of a lidar ratio is symmetrical."""
_REJECTED: Final = 2
"""``usable`` of a value that is not to be used."""
_CLOUDS: Final = int(RamanQuality.CLOUD | RamanQuality.PARTLY_CLOUDY)
"""Multiple scattering makes lidar ratios of clouds too small by more than their errors."""
_POINTS: Final = 4
"""Points of half a cell of a measured overlap; with lines between them it is off by less than 1e-3.
"""
_WIDEST: Final = 5000.0
"""m, largest distance of sounding levels below 20 km: beyond, temperature is not linear."""
_ZERO_CELSIUS: Final = 273.15
LARGEST: Final = 100_000_000
"""Bytes; largest file that is read, and most that its variables may take in memory."""
# Not annotated by xarray. Unlike a dataset, it reads nothing of coordinates when it opens a file.
_STORE: Final[Any] = xr.backends.NetCDF4DataStore


@dataclass(frozen=True, slots=True)
class Overlap:
    """The overlap function of a lidar."""

    range: Array
    """m, rising."""
    overlap: Array
    """Share of the beam in the telescope's field of view, above 0 and at most 1."""

    def at(self, range: Array) -> Array:  # noqa: A002 - the field's word
        """Return the overlap at ranges in m: linear interpolation, NaN before and 1 beyond."""
        overlap = np.interp(range, self.range, self.overlap, left=np.nan)
        return np.where(range > self.range[-1], 1.0, overlap)


@dataclass(frozen=True, slots=True)
class LidarRatio:
    """Lidar ratio of particles over altitude."""

    altitude: Array
    """m above mean sea level, rising."""
    ratio: Array
    """sr."""
    standard_error: Array
    """sr; one error of this shape, common to all altitudes."""
    top: float = np.inf
    """m above mean sea level, up to which it holds."""

    def at(self, altitude: Array, beyond: tuple[float, float]) -> tuple[Array, Array]:
        """Return ratio and standard error at altitudes in m: linear, constant beyond the ends.

        Above `top` they are those of `beyond`.
        """
        known = altitude <= self.top
        parts = zip((self.ratio, self.standard_error), beyond, strict=True)
        ratio, error = (
            np.where(known, np.interp(altitude, self.altitude, values), other)
            for values, other in parts
        )
        return ratio, error


@dataclass(frozen=True, slots=True)
class Ancillaries:
    """The ancillary files of one scene, read once."""

    profiles: Mapping[str, MolecularProfile]
    overlaps: Mapping[str, Overlap]
    lidar_ratios: Mapping[str, LidarRatio]
    inputs: tuple[InputRecord, ...]
    """In order of file names."""
    folder: Path = field(default=Path(), compare=False)
    """That of the campaign file."""

    @classmethod
    def read(cls, folder: Path, files: Mapping[str, Role]) -> Self:
        """Read ancillary files.

        Parameters
        ----------
        folder : Path
            Folder of the campaign file.
        files : mapping of str to Role
            Paths below `folder`, with their roles.

        Raises
        ------
        AncillaryError
            If a file cannot be used.
        """
        profiles, overlaps, lidar_ratios, inputs = {}, {}, {}, []
        for name, role in sorted(files.items()):
            if role is Role.MOLECULAR:
                profiles[name], digest = molecular_profile(folder, name)
            elif role is Role.ATMOSPHERE:
                # The air of the plan reads the profile that it chose.
                digest = hashlib.sha256(read_file(folder, name)).hexdigest()
            elif role is Role.LIDAR_RATIO:
                lidar_ratios[name], digest = lidar_ratio_profile(folder, name)
            else:
                overlaps[name], digest = overlap_profile(folder, name)
            inputs.append(InputRecord(name, role, digest))
        return cls(profiles, overlaps, lidar_ratios, tuple(inputs), folder)


def molecular_profile(folder: Path, name: str) -> tuple[MolecularProfile, str]:
    """Return pressure and temperature of the air from a sounding or model profile.

    Parameters
    ----------
    folder : Path
        Folder of the campaign file.
    name : str
        Path of the file below `folder`. Columns: ``altitude`` (m above mean sea level, rising),
        ``pressure`` (Pa; hPa according to its unit or size) and ``temperature`` (K). A name that
        ends in ``.nc`` means NetCDF.

    Returns
    -------
    MolecularProfile
    str
        sha256 of the file.

    Raises
    ------
    AncillaryError
        If columns are missing, are not numbers or have wrong units; the message names the file.
    """
    table, digest = _table(folder, name)
    columns = _columns(table, name, ("altitude", "pressure", "temperature"))
    try:
        profile = MolecularProfile.from_profile(
            *columns, pressure_unit="Pa" if table["pressure"][0] else None
        )
    except RetrievalInputError as error:
        problem, field, remedy = error.problem, error.field, error.remedy
        raise AncillaryError(problem, file=name, field=field, remedy=remedy) from error
    refuse_wide_levels(profile, name)
    return profile, digest


def refuse_wide_levels(profile: MolecularProfile, name: str) -> None:
    """Raise AncillaryError where levels below 20 km are so far apart that they are no lines."""
    low = profile.altitude[:-1] < 20_000.0
    widest = float(np.max(np.diff(profile.altitude)[low], initial=0.0))
    if widest > _WIDEST:
        raise AncillaryError(
            f"has levels {widest:g} m apart",
            file=name,
            field="altitude",
            remedy=f"give levels at most {_WIDEST:g} m apart",
        )


def overlap_profile(folder: Path, name: str) -> tuple[Overlap, str]:
    """Return the overlap function of a file, and the sha256 of the file.

    Parameters
    ----------
    folder : Path
        Folder of the campaign file.
    name : str
        Path of the file below `folder`. Columns: ``range`` (m, rising) and ``overlap`` (above 0,
        at most 1). A name that ends in ``.nc`` means NetCDF; in a product with measured overlap,
        its weighted mean over time is used.

    Raises
    ------
    AncillaryError
        If the file holds no overlap function; the message names the file.
    """
    table, digest = _table(folder, name)
    if table.keys() >= _MEASURED:
        return _measured_overlap(table, name), digest
    ranges, overlap = _profile(table, name, ("range", "overlap"), fewest=2)
    if overlap[-1] < _FULL:
        raise AncillaryError(
            f"ends at {overlap[-1]:g}, although overlap beyond the last range is taken as 1",
            file=name,
            field="overlap",
            remedy="continue the profile to full overlap",
        )
    return Overlap(ranges, overlap), digest


def lidar_ratio_profile(folder: Path, name: str) -> tuple[LidarRatio, str]:
    """Return the lidar ratio of a file over altitude, and the sha256 of the file.

    Parameters
    ----------
    folder : Path
        Folder of the campaign file.
    name : str
        Path of the file below `folder`. Columns: ``altitude`` (m above mean sea level, rising),
        ``lidar_ratio`` and ``lidar_ratio_standard_error`` (sr). A name that ends in ``.nc`` means
        NetCDF; in a product with measured lidar ratios, their means over time are used.

    Raises
    ------
    AncillaryError
        If the file holds no lidar ratios; the message names the file.
    """
    table, digest = _table(folder, name)
    if table.keys() >= _MEASURED:
        return _measured_lidar_ratio(table, name), digest
    names = ("altitude", "lidar_ratio", "lidar_ratio_standard_error")
    altitude, ratio, error = _profile(table, name, names)
    return LidarRatio(altitude, ratio, error), digest


def _measured_overlap(raw: Table, name: str) -> Overlap:
    """Return the mean over time of the overlap of a product, up to where it is full."""
    overlap, error = raw["overlap"][1], raw["overlap_standard_error"][1]
    known = (overlap > 0.0) & (error > 0.0)
    weight = np.where(known, 1.0 / np.where(known, error, 1.0) ** 2, 0.0)
    total = weight.sum(axis=0)
    measured = np.flatnonzero(total > 0.0)
    if not measured.size:
        raise AncillaryError(
            "holds no measured value", file=name, field="overlap", remedy="choose another night"
        )
    mean = (weight * np.where(known, overlap, 0.0)).sum(axis=0)[measured] / total[measured]
    return _within_cells(raw["range"][1], measured, np.minimum(mean, 1.0))


def _within_cells(ranges: Array, measured: npt.NDArray[np.intp], means: Array) -> Overlap:
    """Return the overlap with these means over the measured cells, 1 from the end of the last one.

    A quadratic spline, sampled finely. Lines between the means have another slope, which looks like
    extinction: a fourth of it in a boundary layer (`tests/end_to_end/test_raman.py`).
    """
    step = float(np.median(np.diff(ranges)))
    cells = np.arange(measured[0], measured[-1] + 1)
    centres = ranges[cells]
    edges = np.append(centres - 0.5 * step, centres[-1] + 0.5 * step)
    integral = np.append(0.0, np.cumsum(step * np.interp(cells, measured, means)))
    # A run with nothing to do needs no splines.
    from scipy.interpolate import CubicSpline  # noqa: PLC0415

    spline = CubicSpline(edges, integral, bc_type=("not-a-knot", (1, 1.0))).derivative()
    fine = np.linspace(centres[0], edges[-1], (2 * cells.size - 1) * _POINTS + 1)
    overlap = np.minimum(spline(fine), 1.0)
    # Noise where overlap is small bends the spline below zero.
    first = int(np.max(np.flatnonzero(overlap <= 0.0) + 1, initial=0))
    return Overlap(fine[first:], overlap[first:])


def _measured_lidar_ratio(raw: Table, name: str) -> LidarRatio:
    """Return the mean extinction of a product outside of clouds over its mean backscatter.

    Means over time are of all values that are usable, weighted by the noise of whole profiles
    relative to total backscatter, which no single value changes. Lidar ratios of single profiles
    exist where noise makes backscatter high or the ratio uncertain, and their errors follow that
    noise (`tests/campaign/test_ancillary_files.py`). Heights with values of few profiles, or an
    uncertain mean backscatter, have none. Random errors, with that of each calibration, decrease
    with the number of profiles; systematic ones are those of all times.
    """
    missing = sorted(_LIDAR_RATIO_NEEDS - raw.keys())
    if missing:
        raise AncillaryError(
            f"has measured lidar ratios without {' and '.join(missing)}",
            file=name,
            remedy="give the product with all its variables",
        )
    altitude = raw["altitude"][1]
    extinction, backscatter = raw["aerosol_extinction"][1], _as_resolved(raw)
    cloudy = (raw["quality_flag"][1].astype(np.int32) & np.int32(_CLOUDS)) != 0
    known = np.isfinite(extinction * backscatter) & (raw["usable"][1] < _REJECTED) & ~cloudy
    # Former products have flags of all quantities together.
    known &= raw.get("aerosol_backscatter_usable", raw["usable"])[1] < _REJECTED
    total = raw["aerosol_backscatter"][1] + raw["molecular_backscatter"][1]
    weight = _profile_weights(raw, np.where(known, total, np.nan))[:, np.newaxis] * known
    weight /= np.where(known.any(axis=0), weight.sum(axis=0), 1.0)

    def mean(values: Array) -> Array:
        return np.asarray((weight * np.where(known, values, 0.0)).sum(axis=0))

    def square_error(quantity: str, causes: Sequence[str]) -> Array:
        square = np.zeros(altitude.size)
        for cause in causes:
            error = np.where(known, raw.get(f"{quantity}_error_{cause}", ("", total * 0.0))[1], 0.0)
            # What a reference window may hide beside the stated error follows its noise.
            stated = mean(stated_ratio * total) if cause == "reference" else mean(error)
            if cause in RANDOM or cause == "reference":
                square += ((weight * error) ** 2).sum(axis=0)
            if cause not in RANDOM:
                square += stated**2
        return square

    stated_ratio = raw["reference_scattering_ratio_standard_error"][1]
    stated_ratio = stated_ratio / raw["reference_scattering_ratio"][1]
    of_extinction = square_error("aerosol_extinction", EXTINCTION_CAUSES)
    # Particles that windows may hide do not make the denominator fluctuate.
    fluctuating = [cause for cause in BACKSCATTER_CAUSES if cause != "reference"]
    of_backscatter = square_error("aerosol_backscatter", fluctuating)
    scattered = mean(backscatter)
    certain = scattered > _CERTAIN * np.sqrt(of_backscatter)
    count = known.sum(axis=0)
    certain &= count > _SEVERAL * count.max()
    ratio = mean(extinction) / np.where(certain, scattered, np.nan)
    of_backscatter += square_error("aerosol_backscatter", ["reference"])
    error = np.sqrt(of_extinction + ratio**2 * of_backscatter) / scattered
    possible = _COLUMNS["lidar_ratio"]
    measured = (ratio >= possible.least) & (ratio <= possible.most) & (ratio >= error)
    if not measured.any():
        raise AncillaryError(
            "holds no usable value outside of clouds that exceeds its error",
            file=name,
            field="lidar_ratio",
            remedy="choose another night",
        )
    altitude, ratio, error = altitude[measured], ratio[measured], error[measured]
    return LidarRatio(altitude, ratio, error, altitude[-1])


def _profile_weights(raw: Table, total: Array) -> Array:
    """Return the inverse square of the noise of each profile relative to total backscatter."""
    names = [f"aerosol_backscatter_error_{cause}" for cause in ("noise", "background")]
    noise = np.hypot(*(raw[name][1] for name in names)) / np.abs(total)
    weights = np.zeros(len(noise))
    for number, row in enumerate(noise):
        if np.any(finite := np.isfinite(row)):
            weights[number] = max(float(np.median(row[finite])), _LEAST_NOISE) ** -2
    return weights


def _as_resolved(raw: Table) -> Array:
    """Return backscatter over the air of extinction, m-1 sr-1, NaN where it has none.

    The mean over the resolution begins at the first value with extinction where it would reach
    before it.
    """
    ranges = raw["range"][1]
    step = float(np.median(np.diff(ranges)))
    edges = np.append(ranges - 0.5 * step, ranges[-1] + 0.5 * step)
    resolved = np.full(raw["aerosol_backscatter"][1].shape, np.nan)
    for row, (values, length) in enumerate(
        zip(raw["aerosol_backscatter"][1], raw["vertical_resolution"][1], strict=True)
    ):
        there = np.isfinite(values)
        sums = np.append(0.0, np.cumsum(np.where(there, values, 0.0)))
        counts = np.append(0.0, np.cumsum(there))
        low = np.maximum(ranges - 0.5 * length, edges[int(np.isfinite(length).argmax())])
        high = low + length
        total, bins = (np.interp(high, edges, c) - np.interp(low, edges, c) for c in (sums, counts))
        resolved[row] = np.where(there & (bins > 0.0), total, np.nan) / np.where(bins > 0, bins, 1)
    return resolved


def read_file(folder: Path, name: str) -> bytes:
    """Return the content of a file; raise AncillaryError where it is none of the campaign."""
    path = folder / name
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
        if inside:
            with opened_regular(path) as stream:
                if os.fstat(stream.fileno()).st_size <= LARGEST:
                    return stream.read()
    # RuntimeError: a loop of links; ValueError: an invalid file name.
    except (OSError, RuntimeError, ValueError) as error:
        raise AncillaryError(
            f"cannot be read: {getattr(error, 'strerror', None) or error}",
            file=name,
            remedy="put it beside the campaign file, or correct its name there",
        ) from error
    outside = "lies outside the folder of the campaign file"
    problem = "is larger than any profile" if inside else outside
    raise AncillaryError(problem, file=name)


def _profile(
    table: Table, file: str, names: tuple[str, ...], *, fewest: int = 1
) -> tuple[Array, ...]:
    """Return columns over the first one, range or altitude in m, which rises."""
    columns = _columns(table, file, names)
    grid, *others = columns
    if any(values.size != grid.size for values in others):
        raise AncillaryError(
            f"has columns of different length: {', '.join(names)}",
            file=file,
            remedy=f"give all of them over the same {names[0]}s",
        )
    if grid.size < fewest or not np.all(np.diff(grid) > 0):
        raise AncillaryError(
            f"does not rise strictly over at least {fewest} values",
            file=file,
            field=names[0],
            remedy=f"sort the rows by {names[0]}",
        )
    for name, values in zip(names, columns, strict=True):
        column = _COLUMNS[name]
        if not np.all((values >= column.least) & (values <= column.most)):
            extremes = f"has values from {values.min():g} to {values.max():g}"
            raise AncillaryError(extremes, file=file, field=name, remedy=column.remedy)
    # Altitudes may end below the sea.
    if grid[-1] < _SHORTEST and (names[0] == "range" or grid[-1] > 0.0):
        raise AncillaryError(
            f"ends at {grid[-1]:g} m",
            file=file,
            field=names[0],
            remedy=f"give values in m, not in km, or name the unit: {names[0]} [km]",
        )
    return columns


def _columns(table: Table, file: str, names: tuple[str, ...]) -> tuple[Array, ...]:
    """Return columns in SI units."""
    columns = []
    for name in names:
        if name not in table:
            raise AncillaryError(
                f"has no column {name!r}; its columns are {', '.join(table) or 'none'}",
                file=file,
                remedy=f"give {', '.join(names)} in its first line, with units in brackets",
            )
        unit, values = table[name]
        units = _COLUMNS[name].units
        scale = units.get(unit or next(iter(units)))
        if scale is None:
            raise AncillaryError(
                f"has the unknown unit {unit!r}",
                file=file,
                field=name,
                remedy=f"use {', '.join(units)}",
            )
        if values.ndim != 1 or not values.size or not np.all(np.isfinite(values)):
            raise AncillaryError("is not a column of finite numbers", file=file, field=name)
        columns.append(values * scale + (_ZERO_CELSIUS if unit == "degC" else 0.0))
    return tuple(columns)


def _table(folder: Path, file: str) -> tuple[Table, str]:
    """Return the columns of a file, and its sha256."""
    content = read_file(folder, file)
    is_netcdf = file.lower().endswith(".nc")
    table = netcdf_table(folder / file, file) if is_netcdf else _csv(content, file)
    return table, hashlib.sha256(content).hexdigest()


def _csv(content: bytes, file: str) -> dict[str, tuple[str, Array]]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise AncillaryError("is not text", file=file) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    try:
        rows = list(csv.reader(lines, skipinitialspace=True))
    except csv.Error as error:
        raise AncillaryError(f"is not a CSV table: {error}", file=file) from error
    if len(rows) < 2:
        raise AncillaryError("holds no rows", file=file)
    head, *body = rows
    titles = [title.partition("[") for title in head]
    names = [name.strip().lower() for name, *_ in titles]
    for name in names:
        if names.count(name) > 1:
            raise AncillaryError(f"has more than one column {name!r}", file=file)
    for number, row in enumerate(body, start=2):
        if len(row) != len(head):
            raise AncillaryError(
                f"row {number} has {len(row)} values for {len(head)} columns", file=file
            )
    return {
        name: (unit.rstrip("] ").strip(), np.array([_number(row[place]) for row in body]))
        for place, (name, (_, _, unit)) in enumerate(zip(names, titles, strict=True))
    }


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        # Columns that are not used may hold anything.
        return math.nan


def _refuse_large(variables: Mapping[str, xr.Variable], file: str) -> None:
    # HDF5 reads whole chunks.
    sizes = {
        name: one.dtype.itemsize * max(one.size, math.prod(one.encoding.get("chunksizes") or ()))
        for name, one in variables.items()
    }
    if sum(sizes.values()) > LARGEST:
        largest = max(sizes, key=lambda name: sizes[name])
        raise AncillaryError("is larger than any profile", file=file, field=largest)


def netcdf_table(path: Path, file: str) -> dict[str, tuple[str, Array]]:
    """Return the units and values of the numbers of a NetCDF file, in any shape."""
    try:
        with closing(_STORE.open(path)) as store:
            stored, attributes = store.load()
            variables, *_ = xr.conventions.decode_cf_variables(
                stored, attributes, decode_times=False
            )
            numbers = {str(n): one for n, one in variables.items() if one.dtype.kind in "iuf"}
            _refuse_large(numbers, file)
            return {
                name: (str(one.attrs.get("units", "")), one.values.astype(float))
                for name, one in numbers.items()
            }
    except AncillaryError:
        raise
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        raise AncillaryError("cannot be read as NetCDF", file=file) from error

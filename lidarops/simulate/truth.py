"""Truth of a simulated campaign: the values that a perfect retrieval would return."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.campaign.simulated_instrument import DamageKind, Handling
from lidarops.constants import LIDAR_EQUATION_PAPER
from lidarops.records import DetectionMode

Array = NDArray[np.float64]

_SAME = 1e-9
"""Relative difference below which two extinctions count as equal."""
_FINE = 30.0
"""m, longest cell near the lidar. Linear interpolation of the optical depth within a cell errs by
less than an eighth of the cell times the change of extinction across it."""
_FINE_UP_TO = 12_000.0
"""m from the lidar. Beyond, an elastic signal seldom resolves less than some 100 m."""
_COARSE = 64
"""Largest number of cells beyond."""


@dataclass(frozen=True, slots=True)
class ChannelTruth:
    """True values of one channel of one file."""

    total_extinction: float
    """m-1; NaN if the path is not homogeneous."""
    background: float
    """Sky light: MHz before dead time, or mV without the dark offset."""
    amplitude: float
    """B of P = P* + B R^-2 exp(-2 sigma R), MHz m2 or mV m2; NaN if not homogeneous."""
    dark_offset: float
    """mV; NaN for photon counting."""


@dataclass(frozen=True, slots=True)
class ProfileTruth:
    """The air along the beam of one file, in coarse range cells."""

    total_extinction: NDArray[np.float32]
    """m-1, mean over each cell, shape (wavelengths, cells)."""
    total_backscatter: NDArray[np.float32]
    """m-1 sr-1, mean over each cell."""
    path_optical_depth: NDArray[np.float32]
    """1, from the lidar to the far end of each cell."""


@dataclass(frozen=True, slots=True)
class FileTruth:
    """True values of one simulated file."""

    path: str
    """In the archive, with forward slashes."""
    instrument: str
    time: datetime
    """Middle of the file, by the true time."""
    zenith_angle: float
    """degree."""
    azimuth: float
    """degree; NaN if unknown."""
    clock_error: float
    """s, clock of the computer minus true time."""
    energy: float
    """Laser energy relative to its energy at the start."""
    channels: Mapping[str, ChannelTruth]
    damage: DamageKind | None
    profile: ProfileTruth | None = None

    @property
    def total_extinction(self) -> float:
        """Extinction that all channels share, m-1; NaN if they do not share one."""
        values = [channel.total_extinction for channel in self.channels.values()]
        first = values[0]
        alike = all(abs(value - first) <= _SAME * first for value in values)
        return first if alike else math.nan


@dataclass(frozen=True, slots=True)
class TruthGrid:
    """Range cells and files of the true profiles of an instrument."""

    instrument: str
    wavelengths: tuple[float, ...]
    """m."""
    bin_width: float
    """m, of the bins within the cells."""
    stops: NDArray[np.intp]
    """Edges of the cells, in bins from 0, shape (cells + 1,)."""
    stride: int
    """A profile is stored for every `stride`-th file."""

    @property
    def suffix(self) -> str:
        """The instrument in variable names, without hyphens."""
        return self.instrument.replace("-", "_")

    @property
    def edges(self) -> Array:
        """Edges of the cells, m."""
        return self.stops.astype(np.float64) * self.bin_width

    def mean(self, values: Array) -> NDArray[np.float32]:
        """Return the mean over each cell of values in bins, shape (wavelengths, bins)."""
        sums = np.add.reduceat(values, self.stops[:-1], axis=-1)
        return (sums / np.diff(self.stops)).astype(np.float32)

    def depth(self, extinction: Array) -> NDArray[np.float32]:
        """Return the optical depth from the lidar to the far end of each cell."""
        depth = np.cumsum(extinction * self.bin_width, axis=-1)
        return depth[:, self.stops[1:] - 1].astype(np.float32)


def cell_stops(bins: int, bin_width: float, cells: int | None) -> NDArray[np.intp]:
    """Return the edges of the range cells of the truth.

    Parameters
    ----------
    bins : int
    bin_width : float, m
    cells : int or None
        Number of cells of equal length (to a bin), at most one per bin. None: cells of 30 m,
        rounded down to whole bins but at least one bin, up to 12 km, and at most 64 longer cells
        beyond.

    Returns
    -------
    ndarray of int, shape (cells + 1,)
        Bins from 0.
    """
    if cells is not None:
        return _evenly(0, bins, min(cells, bins))
    step = max(int(_FINE / bin_width), 1)
    fine = min(round(_FINE_UP_TO / bin_width), bins) // step * step
    near = np.arange(0, fine + 1, step, dtype=np.intp)
    beyond = _evenly(fine, bins, min(_COARSE, -(-(bins - fine) // step)))
    return np.concatenate([near, beyond[1:]])


def _evenly(start: int, stop: int, cells: int) -> NDArray[np.intp]:
    return np.rint(np.linspace(start, stop, cells + 1)).astype(np.intp)


class TruthTable:
    """Truth of a campaign: one row per granule, filled in any order.

    Parameters
    ----------
    rows : int
        Number of granules.
    grids : mapping of str to TruthGrid
        By instrument.
    """

    def __init__(self, rows: int, grids: Mapping[str, TruthGrid]) -> None:
        self._grids = grids
        self._paths = np.full(rows, "", dtype=object)
        self._instruments = np.full(rows, "", dtype=object)
        self._damage = np.full(rows, "", dtype=object)
        self._times = np.full(rows, np.datetime64("NaT"), dtype="datetime64[ns]")
        self._facts = {name: np.full(rows, np.nan) for name in _FACTS}
        self._channels: dict[tuple[str, str], Array] = {}
        self._profiles: dict[str, dict[int, ProfileTruth]] = {key: {} for key in grids}

    def add(self, row: int, truth: FileTruth) -> None:
        """Fill one row."""
        self._paths[row] = truth.path
        self._instruments[row] = truth.instrument
        self._damage[row] = "" if truth.damage is None else truth.damage.value
        self._times[row] = np.datetime64(truth.time.replace(tzinfo=None), "ns")
        for name, column in self._facts.items():
            column[row] = getattr(truth, name)
        for channel, values in truth.channels.items():
            for quantity in _quantities(channel):
                self._column(channel, quantity)[row] = getattr(values, quantity)
        if truth.profile is not None:
            self._profiles[truth.instrument][row] = truth.profile

    def _column(self, channel: str, quantity: str) -> Array:
        key = channel, quantity
        if key not in self._channels:
            self._channels[key] = np.full(self._paths.size, np.nan)
        return self._channels[key]

    def dataset(self, campaign: str) -> xr.Dataset:
        """Return the truth as a dataset; see `lidarops.simulate.campaign.simulate_campaign`."""
        handling = {"": ""} | {kind.value: kind.handling.value for kind in DamageKind}
        extinction = self._facts["total_extinction"]
        handled = [handling[str(kind)] for kind in self._damage]
        truth = xr.Dataset(
            {
                "path": _row(self._paths.astype(str), "path of the raw file in the archive"),
                "instrument": _row(self._instruments.astype(str), "instrument"),
                "time": _row(self._times, "middle of the file, UTC"),
                **{
                    name: _row(self._facts[name], *about)
                    for name, about in _FACTS.items()
                    if name == "total_extinction" or np.isfinite(self._facts[name]).any()
                },
                "homogeneous": _row(
                    np.isfinite(extinction).astype(np.int8), "1 if the path is homogeneous", "1"
                ),
                "damage": _row(
                    self._damage.astype(str),
                    "kind of damage of the raw file; empty for good files",
                ),
                "handling": _row(
                    np.array(handled, dtype=str),
                    "correct handling of the damaged raw file: "
                    + ", ".join(handling.value for handling in Handling),
                ),
                "refused": _row(
                    np.array([action == Handling.REFUSE for action in handled], dtype=np.int8),
                    "1 if a correct reader must refuse the raw file",
                    "1",
                ),
            },
            attrs={
                "title": f"Truth of the simulated campaign {campaign}",
                "comment": "P = P* + B R^-2 exp(-2 sigma R) beyond full overlap, with sigma in"
                " total_extinction and B in amplitude. P* is the background (sky light) if dark"
                " files were subtracted, else background plus dark_offset. Photon counting: rates"
                " before dead time.",
                "references": LIDAR_EQUATION_PAPER,
            },
        )
        for (channel, quantity), column in sorted(self._channels.items()):
            truth[f"{quantity}_{channel}"] = _row(column, *_quantities(channel)[quantity])
        for key, profiles in self._profiles.items():
            if profiles:
                truth = truth.merge(_profiles(self._grids[key], profiles))
        return truth


_FACTS = {
    "total_extinction": ("extinction coefficient of the air on a homogeneous path", "m-1"),
    "zenith_angle": ("zenith angle of the beam, 0 = up", "degree"),
    "azimuth": ("azimuth of the beam, clockwise from north", "degree"),
    "clock_error": ("clock of the instrument minus true time", "s"),
    "energy": ("energy of the laser, relative to its energy at the start", "1"),
}


def _quantities(channel: str) -> dict[str, tuple[str, str]]:
    mode, _, label = channel.partition("_")
    analog = mode == DetectionMode.ANALOG
    units = "mV" if analog else "MHz"
    quantities = {
        "total_extinction": (
            f"extinction coefficient of the homogeneous path, {label}",
            "m-1",
        ),
        "background": (f"sky light, {mode} {label}", units),
        "amplitude": (f"amplitude B of the backscattered signal, {mode} {label}", f"{units} m2"),
    }
    dark = {"dark_offset": (f"signal without light, {mode} {label}", units)}
    return quantities | dark if analog else quantities


def _profiles(grid: TruthGrid, profiles: Mapping[int, ProfileTruth]) -> xr.Dataset:
    rows = sorted(profiles)
    suffix = grid.suffix
    dims = (f"profile_{suffix}", f"wavelength_{suffix}", f"range_{suffix}")
    coordinates = {
        f"wavelength_{suffix}": (
            dims[1],
            np.array(grid.wavelengths),
            _attributes("wavelength", "m"),
        ),
        f"range_{suffix}": (
            dims[2],
            0.5 * (grid.edges[1:] + grid.edges[:-1]),
            _attributes("middle of a range cell, from the lidar", "m"),
        ),
    }
    far = "far end of a range cell, from the lidar"
    return xr.Dataset(
        {
            f"profile_granule_{suffix}": (
                dims[0],
                np.array(rows, dtype=np.int32),
                _attributes("index of the granule of the profile, from 0", "1"),
            ),
            f"range_end_{suffix}": (dims[2], grid.edges[1:], _attributes(far, "m")),
            **{
                f"profile_{name}_{suffix}": (
                    dims,
                    np.stack([getattr(profiles[row], name) for row in rows]),
                    _attributes(long_name, units),
                )
                for name, (long_name, units) in _PROFILES.items()
            },
        },
        coordinates,
    )


_PROFILES = {
    "total_extinction": ("extinction coefficient of air, mean over a range cell", "m-1"),
    "total_backscatter": ("backscatter coefficient of air, mean over a range cell", "m-1 sr-1"),
    "path_optical_depth": ("optical depth of air from the lidar to the end of a range cell", "1"),
}


def _attributes(long_name: str, units: str) -> dict[str, str]:
    return {"long_name": long_name, "units": units}


def _row(values: object, long_name: str, units: str = "") -> tuple[str, object, dict[str, str]]:
    attrs = {"long_name": long_name} | ({"units": units} if units else {})
    return "granule", values, attrs

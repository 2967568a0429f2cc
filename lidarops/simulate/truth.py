"""Truth of a simulated campaign: the values that a perfect retrieval would return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.campaign.simulated_instrument import DamageKind, Handling
from lidarops.constants import LIDAR_EQUATION_PAPER

Array = NDArray[np.float64]

_FINE = 30.0
"""m, longest cell near the lidar. Linear interpolation of the optical depth within a cell errs by
less than an eighth of the cell times the change of extinction across it."""
_FINE_UP_TO = 12_000.0
"""m from the lidar. Beyond, an elastic signal seldom resolves less than some 100 m."""
_COARSE = 64
"""Largest number of cells beyond."""

_VARIABLES = {
    "path": ("path of the raw file in the archive", ""),
    "instrument": ("instrument", ""),
    "time": ("middle of the file, UTC", ""),
    "total_extinction": ("extinction coefficient of the air on a homogeneous path", "m-1"),
    "zenith_angle": ("zenith angle of the beam, 0 = up", "degree"),
    "azimuth": ("azimuth of the beam, clockwise from north", "degree"),
    "clock_error": ("clock of the instrument minus true time", "s"),
    "energy": ("energy of the laser, relative to its energy at the start", "1"),
    "homogeneous": ("1 if the path is homogeneous", "1"),
    "damage": ("kind of damage of the raw file; empty for good files", ""),
    "handling": (f"correct handling of the damaged raw file: {', '.join(Handling)}", ""),
    "refused": ("1 if a correct reader must refuse the raw file", "1"),
}
"""Variable of a file -> what it is, and its unit."""
_OF_CHANNEL = {
    "total_extinction": ("extinction coefficient of the homogeneous path, {label}", "m-1"),
    "background": ("sky light, {mode} {label}", "{unit}"),
    "amplitude": ("amplitude B of the backscattered signal, {mode} {label}", "{unit} m2"),
    "dark_offset": ("signal without light, {mode} {label}", "{unit}"),
}
"""Begin of the name of a variable of a channel -> the same."""
_PROFILES = {
    "total_extinction": ("extinction coefficient of air, mean over a range cell", "m-1"),
    "total_backscatter": ("backscatter coefficient of air, mean over a range cell", "m-1 sr-1"),
    "path_optical_depth": ("optical depth of air from the lidar to the end of a range cell", "1"),
}


class FileTruth(NamedTuple):
    """True values of one simulated file."""

    values: Mapping[str, Any]
    """By the variables of `lidarops.simulate.campaign.simulate_campaign`."""
    profile: Mapping[str, NDArray[np.float32]] | None
    """The air along the beam by `_PROFILES`, each of shape (wavelengths, cells)."""


@dataclass(frozen=True, slots=True)
class TruthGrid:
    """Range cells and files of the true profiles of an instrument."""

    wavelengths: tuple[float, ...]
    """m."""
    bin_width: float
    """m, of the bins within the cells."""
    stops: NDArray[np.intp]
    """Edges of the cells, in bins from 0, shape (cells + 1,)."""
    stride: int
    """A profile is stored for every `stride`-th file."""

    def profile(self, extinction: Array, backscatter: Array) -> dict[str, NDArray[np.float32]]:
        """Return the profiles of a file, of values in bins, shape (wavelengths, bins)."""
        depth = np.cumsum(extinction * self.bin_width, axis=-1)
        means = [
            np.add.reduceat(values, self.stops[:-1], axis=-1) / np.diff(self.stops)
            for values in (extinction, backscatter)
        ]
        columns = (*means, depth[:, self.stops[1:] - 1])
        return {
            name: values.astype(np.float32) for name, values in zip(_PROFILES, columns, strict=True)
        }


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
    """Truth of a campaign: one row per granule.

    Parameters
    ----------
    rows : int
        Number of granules.
    grids : mapping of str to TruthGrid
        By instrument.
    """

    def __init__(self, rows: int, grids: Mapping[str, TruthGrid]) -> None:
        self._rows = rows
        self._filled = 0
        self._grids = grids
        texts = ("path", "instrument", "damage")
        numbers = ("total_extinction", "zenith_angle", "azimuth", "clock_error", "energy")
        self._columns: dict[str, NDArray[Any]] = {
            **{name: np.full(rows, "", dtype=object) for name in texts},
            "time": np.full(rows, np.datetime64("NaT"), dtype="datetime64[ns]"),
            **{name: np.full(rows, np.nan) for name in numbers},
        }
        self._profiles: dict[str, dict[int, Mapping[str, NDArray[np.float32]]]] = {
            key: {} for key in grids
        }

    def add(self, truth: FileTruth) -> None:
        """Fill the next row."""
        row, self._filled = self._filled, self._filled + 1
        for name, value in truth.values.items():
            if name not in self._columns:
                self._columns[name] = np.full(self._rows, np.nan)
            self._columns[name][row] = value
        if truth.profile is not None:
            self._profiles[truth.values["instrument"]][row] = truth.profile

    def dataset(self, campaign: str) -> xr.Dataset:
        """Return the truth as a dataset; see `lidarops.simulate.campaign.simulate_campaign`."""
        columns = self._columns
        extinction, damage = columns["total_extinction"], columns["damage"]
        handled = [DamageKind(kind).handling if kind else "" for kind in damage]
        values = columns | {
            "homogeneous": np.isfinite(extinction).astype(np.int8),
            "handling": np.array(handled, dtype=str),
            "refused": np.array([act == Handling.REFUSE for act in handled], dtype=np.int8),
        }
        of_channels = {name: name.rsplit("_", 2) for name in columns.keys() - _VARIABLES.keys()}
        truth = xr.Dataset(
            {name: _row(values[name], *about) for name, about in _VARIABLES.items()},
            attrs={
                "title": f"Truth of the simulated campaign {campaign}",
                "comment": "P = P* + B R^-2 exp(-2 sigma R) beyond full overlap, with sigma in"
                " total_extinction and B in amplitude. P* is the background (sky light) if dark"
                " files were subtracted, else background plus dark_offset. Photon counting: rates"
                " before dead time.",
                "references": LIDAR_EQUATION_PAPER,
            },
        )
        for name in sorted(of_channels, key=lambda name: (of_channels[name][1:], name)):
            quantity, mode, label = of_channels[name]
            words = {"mode": mode, "label": label, "unit": "mV" if mode == "analog" else "MHz"}
            about = (text.format_map(words) for text in _OF_CHANNEL[quantity])
            truth[name] = _row(columns[name], *about)
        for key, profiles in self._profiles.items():
            if profiles:
                # Names of variables hold no hyphens.
                suffix = key.replace("-", "_")
                truth = truth.merge(_profiles(self._grids[key], profiles, suffix))
        return truth


def _row(values: NDArray[Any], long_name: str, units: str = "") -> tuple[str, Any, dict[str, str]]:
    texts = values.dtype == object
    return "granule", values.astype(str) if texts else values, _about(long_name, units)


def _about(long_name: str, units: str) -> dict[str, str]:
    return {"long_name": long_name} | ({"units": units} if units else {})


def _profiles(
    grid: TruthGrid, profiles: Mapping[int, Mapping[str, NDArray[np.float32]]], suffix: str
) -> xr.Dataset:
    rows = sorted(profiles)
    dims = (f"profile_{suffix}", f"wavelength_{suffix}", f"range_{suffix}")
    edges = grid.stops.astype(np.float64) * grid.bin_width
    granule = _about("index of the granule of the profile, from 0", "1")
    far = _about("far end of a range cell, from the lidar", "m")
    middle = _about("middle of a range cell, from the lidar", "m")
    return xr.Dataset(
        {
            f"profile_granule_{suffix}": (dims[0], np.array(rows, dtype=np.int32), granule),
            f"range_end_{suffix}": (dims[2], edges[1:], far),
            **{
                f"profile_{name}_{suffix}": (
                    dims,
                    np.stack([profiles[row][name] for row in rows]),
                    _about(*about),
                )
                for name, about in _PROFILES.items()
            },
        },
        {
            dims[1]: (dims[1], np.array(grid.wavelengths), _about("wavelength", "m")),
            dims[2]: (dims[2], 0.5 * (edges[1:] + edges[:-1]), middle),
        },
    )

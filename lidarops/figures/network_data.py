"""Products of networks as plain arrays: series by crossing beside the truth, and beams in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.series_data import Section, SeriesEstimate, require
from lidarops.figures.time_axis import Times
from lidarops.flags import Quality
from lidarops.records import SceneOutcome
from lidarops.retrieve.network.geometry import Beam, local_axes, locate, to_earth_centred

Floats = NDArray[np.float64]

QUANTITIES: Final = ("extinction", "visibility")
"""Of a series."""

_EXTINCTION: Final = (
    "extinction",
    "extinction_standard_error",
    "extinction_systematic_error",
)
_VISIBILITY: Final = ("visibility_in_air", "visibility_in_air_lower", "visibility_in_air_upper")
_ANGLES: Final = ("latitude", "longitude", "altitude", "zenith_angle", "azimuth")
_SHARED: Final = ("time", "crossing_id", "beam_range", "quality_flag")
CROSSING_VARIABLES: Final = (*_SHARED, *_EXTINCTION, *_VISIBILITY, "time_bnds", "beam_zenith_angle")
"""What `read_crossings` reads of a product."""
MAP_VARIABLES: Final = (
    *_SHARED,
    "visibility_in_air",
    *(f"beam_{name}" for name in _ANGLES),
    *_ANGLES[:3],
)
"""What `read_map` reads of a product."""
_PAIR: Final = ("time", "crossing")
_SAME_BEAM: Final = 0.2
"""degree, within which a file of the truth points as a beam does."""
_FLAT: Final = 0.2
"""Of the larger extent: the least that an axis of a map spans to be drawn."""


@dataclass(frozen=True, slots=True)
class CrossingSeries(Section):
    """What was retrieved where beams meet, over time; `near` and `far` are its nearest range."""

    crossing: int

    @property
    def label(self) -> str:
        """The crossing in words."""
        return f"crossing {self.crossing}"


@dataclass(frozen=True, slots=True)
class NetworkMap:
    """Beams and crossings on two axes."""

    stations: Floats
    """(beam, 2) km."""
    ends: Floats
    """(beam, 2) km, of the part of the beam that is used."""
    crossings: Floats
    """(crossing, 2) km."""
    numbers: tuple[int, ...]
    visibility: Floats
    """(crossing,) km, median over time of what is to be used; NaN where there is none."""
    used: NDArray[np.intp]
    """(crossing,) Values that are to be used."""
    values: int
    """Values of a crossing."""
    axes: tuple[str, str]
    instruments: tuple[str, ...]
    """Of each beam."""


def instruments_of(scene: SceneOutcome) -> tuple[str, ...]:
    """Return the instrument of each beam of a scene, as its plan says; none where it does not."""
    steps = scene.plan.steps if scene.plan else ()
    for step in steps:
        if step.name == "visibility" and "beams" in step.settings:
            return tuple(str(beam["instrument"]) for beam in step.settings["beams"])
    return ()


def read_crossings(
    product: xr.Dataset, truth: xr.Dataset | None = None, *, instruments: Sequence[str] = ()
) -> list[CrossingSeries]:
    """Take the series of the crossings out of one product.

    Parameters
    ----------
    product : Dataset
        Kind ``visibility``.
    truth : Dataset, optional
        Of a simulated campaign.
    instruments : sequence of str, optional
        Of each beam, whose truth to take; none is taken where empty.

    Returns
    -------
    list of CrossingSeries
        Standard errors hold the systematic part. Truth is that of the beams, at the time.

    Raises
    ------
    ProductError
        Where a variable is missing, or does not have the dims of its kind.
    """
    require(
        product,
        {"time": ("time",), "crossing_id": ("crossing",), "beam_range": ("beam", "crossing")}
        | dict.fromkeys((*_EXTINCTION, *_VISIBILITY, "quality_flag"), _PAIR),
    )
    value, random, systematic = (_floats(product, name) for name in _EXTINCTION)
    seen, low, high = (_floats(product, name) for name in _VISIBILITY)
    flags = product["quality_flag"].values.astype(np.int64)
    known = _truth(product, truth, instruments)
    time = product["time"].values.astype("datetime64[ns]")
    nearest = np.nanmin(_floats(product, "beam_range"), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        true_sight = np.where(known > 0, _constant(value, seen) / known, np.nan)
    return [
        CrossingSeries(
            near=float(nearest[v]),
            far=float(nearest[v]),
            time=time,
            flag=flags[:, v],
            estimates={
                "extinction": SeriesEstimate(
                    value[:, v], np.hypot(random, systematic)[:, v], known[:, v], "m-1"
                ),
                "visibility": SeriesEstimate(
                    seen[:, v] / 1e3,
                    np.abs(high - low)[:, v] / 2e3,
                    true_sight[:, v] / 1e3,
                    "km",
                ),
            },
            crossing=int(product["crossing_id"].values[v]),
        )
        for v in range(product.sizes["crossing"])
    ]


def join_crossings(series: Sequence[CrossingSeries]) -> list[CrossingSeries]:
    """Join the series of several scenes by crossing, each over all times."""
    found = []
    for number in sorted({one.crossing for one in series}):
        mine = [one for one in series if one.crossing == number]
        order = np.argsort(np.concatenate([one.time for one in mine]), kind="stable")
        found.append(
            CrossingSeries(
                near=mine[0].near,
                far=mine[0].far,
                time=np.concatenate([one.time for one in mine])[order],
                flag=np.concatenate([one.flag for one in mine])[order],
                estimates={name: _joined(mine, name, order) for name in QUANTITIES},
                crossing=number,
            )
        )
    return found


def _joined(
    series: Sequence[CrossingSeries], quantity: str, order: NDArray[np.intp]
) -> SeriesEstimate:
    parts = [one.estimates[quantity] for one in series]
    return SeriesEstimate(
        value=np.concatenate([part.value for part in parts])[order],
        standard_error=np.concatenate([part.standard_error for part in parts])[order],
        truth=np.concatenate([part.truth for part in parts])[order],
        units=parts[0].units,
    )


def read_map(product: xr.Dataset, instruments: Sequence[str] = ()) -> NetworkMap:
    """Take beams and crossings out of one product.

    Parameters
    ----------
    product : Dataset
        Kind ``visibility``.
    instruments : sequence of str, optional
        Of each beam.

    Raises
    ------
    ProductError
        Where a variable is missing, or does not have the dims of its kind.
    """
    require(
        product,
        {"time": ("time",), "beam_range": ("beam", "crossing"), "visibility_in_air": _PAIR}
        | {"quality_flag": _PAIR, "crossing_id": ("crossing",)}
        | {f"beam_{name}": ("beam",) for name in _ANGLES},
    )
    columns = [_floats(product, f"beam_{name}") for name in _ANGLES]
    beams = [
        Beam(lat, lon, alt, azimuth, 90.0 - zenith)
        for lat, lon, alt, zenith, azimuth in zip(*columns, strict=True)
    ]
    origin, direction = locate(beams)
    reach = np.nanmax(_floats(product, "beam_range"), axis=1, initial=0.0)
    place = [_floats(product, name) for name in _ANGLES[:3]]
    first = to_earth_centred(beams[0].latitude, beams[0].longitude, beams[0].altitude)
    turn = local_axes(beams[0].latitude, beams[0].longitude)
    crossings = (to_earth_centred(*place) - first) @ turn.T
    ends = origin + 1.08 * reach[:, np.newaxis] * direction
    pair, names = _axes(np.concatenate([origin, crossings]))
    rejected = (product["quality_flag"].values.astype(np.int64) & int(Quality.rejecting())) != 0
    seen = np.where(rejected, np.nan, _floats(product, "visibility_in_air")) / 1e3
    used = np.isfinite(seen).sum(axis=0)
    return NetworkMap(
        stations=origin[:, pair] / 1e3,
        ends=ends[:, pair] / 1e3,
        crossings=crossings[:, pair] / 1e3,
        numbers=tuple(int(number) for number in product["crossing_id"].values),
        visibility=np.array(
            [np.nanmedian(column) if n else np.nan for column, n in zip(seen.T, used, strict=True)]
        ),
        used=used,
        values=product.sizes["time"],
        axes=names,
        instruments=tuple(instruments) or tuple(f"beam {beam}" for beam in range(len(beams))),
    )


def _axes(points: Floats) -> tuple[list[int], tuple[str, str]]:
    """Return the two axes that a network spans most of: of the ground where that is wide."""
    east, north, up = np.ptp(points, axis=0)
    called = ("east of the first lidar (km)", "north of the first lidar (km)")
    level = 0 if east >= north else 1
    if up > 0 and min(east, north) < _FLAT * min(max(east, north), up):
        return [level, 2], (called[level], "above the first lidar (km)")
    return [0, 1], called


def _constant(extinction: Floats, visibility: Floats) -> float:
    """Return the product of visibility and extinction, where both have one law."""
    known = np.isfinite(extinction) & np.isfinite(visibility)
    if not known.any():
        return float("nan")
    products = extinction[known] * visibility[known]
    # Brought to another wavelength by a law that depends on visibility, it is no constant.
    return float(np.median(products)) if np.ptp(products) < 0.01 * products.mean() else np.nan


def _truth(product: xr.Dataset, truth: xr.Dataset | None, instruments: Sequence[str]) -> Floats:
    shape = product["extinction"].shape
    if truth is None or len(instruments) != product.sizes["beam"]:
        return np.full(shape, np.nan)
    bounds = product["time_bnds"].values.astype("datetime64[ns]")
    zenith, ranges = _floats(product, "beam_zenith_angle"), _floats(product, "beam_range")
    total, count = np.zeros(shape), np.zeros(shape)
    for beam, name in enumerate(instruments):
        for crossing in np.flatnonzero(np.isfinite(ranges[beam])):
            when, known = _along(truth, name, zenith[beam], ranges[beam, crossing])
            for n, (start, stop) in enumerate(bounds):
                inside = known[(when >= start) & (when <= stop)]
                if inside.size:
                    total[n, crossing] += inside.mean()
                    count[n, crossing] += 1
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(count > 0, count, np.nan))


def _along(
    truth: xr.Dataset, instrument: str, zenith: float, distance: float
) -> tuple[Times, Floats]:
    """Return times and true extinction at a distance on a beam."""
    suffix = instrument.replace("-", "_")
    names = np.asarray(truth["instrument"].values, dtype=np.str_)
    if f"profile_granule_{suffix}" not in truth:
        mine = np.flatnonzero(names == instrument)
        known = _floats(truth, "extinction")[mine]
    else:
        mine = truth[f"profile_granule_{suffix}"].values.astype(np.intp)
        middle = _floats(truth, f"range_{suffix}")
        field = np.asarray(truth[f"profile_extinction_{suffix}"].values[:, 0], dtype=np.float64)
        known = np.array([np.interp(distance, middle, row) for row in field])
    when = truth["time"].values.astype("datetime64[ns]")[mine]
    if "zenith_angle" in truth:
        here = np.abs(_floats(truth, "zenith_angle")[mine] - zenith) < _SAME_BEAM
        when, known = when[here], known[here]
    fine = np.isfinite(known)
    return when[fine], known[fine]


def _floats(product: xr.Dataset, name: str) -> Floats:
    return np.asarray(product[name].values, dtype=np.float64)

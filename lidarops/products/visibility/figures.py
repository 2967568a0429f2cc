"""The figures of the ``visibility`` product: series at crossings with the truth, a map of beams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.kind_figures import KindFigures, ProductSource, View
from lidarops.figures.panels import (
    SERIES_MARKS,
    Axis,
    Curve,
    Figure,
    Layer,
    Mark,
    Panel,
    Words,
    number,
)
from lidarops.figures.series_data import (
    Comparison,
    SeriesEstimate,
    TimeSeries,
    compare,
    float_values,
    join,
    require,
)
from lidarops.figures.series_panels import Quantity, series_figures
from lidarops.figures.time_axis import Times
from lidarops.figures.wording import counted
from lidarops.kinds import flags_of
from lidarops.products.visibility import NAME
from lidarops.records import SceneOutcome
from lidarops.retrieve.network.geometry import Beam, local_axes, locate, to_earth_centred

Floats = NDArray[np.float64]

_EXTINCTION: Final = (
    "total_extinction",
    "total_extinction_standard_error",
    "total_extinction_systematic_error",
)
_VISIBILITY: Final = ("visibility_in_air", "visibility_in_air_lower", "visibility_in_air_upper")
_ANGLES: Final = ("latitude", "longitude", "altitude", "zenith_angle", "azimuth")
_SHARED: Final = ("time", "crossing_id", "beam_range", "quality_flag")
CROSSING_VARIABLES: Final = (*_SHARED, *_EXTINCTION, *_VISIBILITY, "time_bnds", "beam_zenith_angle")
"""Variables that `read_crossings` needs."""
MAP_VARIABLES: Final = (
    *_SHARED,
    "visibility_in_air",
    *(f"beam_{name}" for name in _ANGLES),
    *_ANGLES[:3],
)
"""Variables that `read_map` needs."""
_PAIR: Final = ("time", "crossing")
_SAME_BEAM: Final = 0.2
"""degree; files of the truth within this zenith angle of a beam belong to it."""
_FLAT: Final = 0.2
"""Smallest horizontal extent of a map that shows the ground, relative to the larger extent."""
_HEIGHT: Final = 464.0
_ROOM: Final = 0.08
"""Margin on each side, relative to the extent."""
_NARROW: Final = 0.3
"""Smallest extent of an axis of a map, relative to the other one."""
_QUANTITIES: Final = (Quantity("visibility", 1.0, "km"), Quantity("total_extinction", 1e3, "km⁻¹"))


@dataclass(frozen=True, slots=True)
class NetworkMap:
    """Beams and crossings projected on two axes."""

    stations: Floats
    """(beam, 2) km."""
    ends: Floats
    """(beam, 2) km, far ends of the beams, just beyond the last crossing."""
    crossings: Floats
    """(crossing, 2) km."""
    numbers: tuple[int, ...]
    visibility: Floats
    """(crossing,) km, median over time of usable values; NaN without any."""
    axes: tuple[str, str]
    """Labels of the two axes."""
    instruments: tuple[str, ...]
    """Instrument of each beam."""


def instruments_of(scene: SceneOutcome) -> tuple[str, ...]:
    """Return the instrument of each beam of a scene from its plan; empty if it lists none."""
    steps = scene.plan.steps if scene.plan else ()
    for step in steps:
        if step.name == step.product == NAME:
            return tuple(beam["instrument"] for beam in step.settings["beams"])
    return ()


def read_crossings(
    product: xr.Dataset, truth: xr.Dataset | None = None, *, instruments: Sequence[str] = ()
) -> list[TimeSeries]:
    """Return the series at each crossing of a product.

    Parameters
    ----------
    product : Dataset
        Kind ``visibility``.
    truth : Dataset, optional
        Truth of a simulated campaign.
    instruments : sequence of str, optional
        Instrument of each beam, to select its truth; empty for no truth.

    Returns
    -------
    list of TimeSeries
        Standard errors include the systematic error. The truth is the mean over the beams at the
        crossing.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(
        product,
        {"time": ("time",), "crossing_id": ("crossing",), "beam_range": ("beam", "crossing")}
        | dict.fromkeys((*_EXTINCTION, *_VISIBILITY, "quality_flag"), _PAIR),
    )
    value, random, systematic = (float_values(product, name) for name in _EXTINCTION)
    visibility, lower, upper = (float_values(product, name) for name in _VISIBILITY)
    flags = product["quality_flag"].values.astype(np.int64)
    true_extinction = _truth(product, truth, instruments)
    time = product["time"].values.astype("datetime64[ns]")
    with np.errstate(divide="ignore", invalid="ignore"):
        true_visibility = np.where(
            true_extinction > 0, _contrast_constant(value, visibility) / true_extinction, np.nan
        )
    return [
        TimeSeries(
            time=time,
            flag=flags[:, v],
            rejecting=flags_of("visibility").rejecting,
            estimates={
                "total_extinction": SeriesEstimate(
                    value[:, v], np.hypot(random, systematic)[:, v], true_extinction[:, v], "m-1"
                ),
                "visibility": SeriesEstimate(
                    visibility[:, v] / 1e3,
                    np.abs(upper - lower)[:, v] / 2e3,
                    true_visibility[:, v] / 1e3,
                    "km",
                ),
            },
            label=f"crossing {number}",
            key=(number,),
        )
        for v, number in enumerate(product["crossing_id"].values.tolist())
    ]


def read_map(product: xr.Dataset, instruments: Sequence[str] = ()) -> NetworkMap:
    """Return beams and crossings of a product, projected on two axes.

    Parameters
    ----------
    product : Dataset
        Kind ``visibility``.
    instruments : sequence of str, optional
        Instrument of each beam; beams are numbered without it.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(
        product,
        {"time": ("time",), "beam_range": ("beam", "crossing"), "visibility_in_air": _PAIR}
        | {"quality_flag": _PAIR, "crossing_id": ("crossing",)}
        | {f"beam_{name}": ("beam",) for name in _ANGLES},
    )
    columns = [float_values(product, f"beam_{name}") for name in _ANGLES]
    beams = [
        Beam(lat, lon, alt, azimuth, 90.0 - zenith)
        for lat, lon, alt, zenith, azimuth in zip(*columns, strict=True)
    ]
    origin, direction = locate(beams)
    reach = np.nanmax(float_values(product, "beam_range"), axis=1, initial=0.0)
    position = [float_values(product, name) for name in _ANGLES[:3]]
    first = to_earth_centred(beams[0].latitude, beams[0].longitude, beams[0].altitude)
    turn = local_axes(beams[0].latitude, beams[0].longitude)
    crossings = (to_earth_centred(*position) - first) @ turn.T
    ends = origin + 1.08 * reach[:, np.newaxis] * direction
    pair, names = _plane(np.concatenate([origin, crossings]))
    rejected = (
        product["quality_flag"].values.astype(np.int64) & flags_of("visibility").rejecting
    ) != 0
    visibility = np.where(rejected, np.nan, float_values(product, "visibility_in_air")) / 1e3
    medians = [np.nanmedian(own) if np.isfinite(own).any() else np.nan for own in visibility.T]
    return NetworkMap(
        stations=origin[:, pair] / 1e3,
        ends=ends[:, pair] / 1e3,
        crossings=crossings[:, pair] / 1e3,
        numbers=tuple(int(number) for number in product["crossing_id"].values),
        visibility=np.array(medians),
        axes=names,
        instruments=tuple(instruments) or tuple(f"beam {beam}" for beam in range(len(beams))),
    )


def _plane(points: Floats) -> tuple[list[int], tuple[str, str]]:
    """Return the two axes of a map and their labels: the ground, or a vertical plane if narrow."""
    east, north, up = np.ptp(points, axis=0)
    labels = ("east of the first lidar (km)", "north of the first lidar (km)")
    level = 0 if east >= north else 1
    if up > 0 and min(east, north) < _FLAT * min(max(east, north), up):
        return [level, 2], (labels[level], "above the first lidar (km)")
    return [0, 1], labels


def _contrast_constant(extinction: Floats, visibility: Floats) -> float:
    """Return visibility times extinction, -ln(contrast); NaN if it is not constant."""
    known = np.isfinite(extinction) & np.isfinite(visibility)
    if not known.any():
        return float("nan")
    products = extinction[known] * visibility[known]
    # It varies where the conversion to another wavelength depends on visibility.
    return float(np.median(products)) if np.ptp(products) < 0.01 * products.mean() else np.nan


def _truth(product: xr.Dataset, truth: xr.Dataset | None, instruments: Sequence[str]) -> Floats:
    shape = product["total_extinction"].shape
    if truth is None or len(instruments) != product.sizes["beam"]:
        return np.full(shape, np.nan)
    bounds = product["time_bnds"].values.astype("datetime64[ns]")
    zenith, ranges = float_values(product, "beam_zenith_angle"), float_values(product, "beam_range")
    total, count = np.zeros(shape), np.zeros(shape)
    for beam, name in enumerate(instruments):
        for crossing in np.flatnonzero(np.isfinite(ranges[beam])):
            times, true_values = _along(truth, name, zenith[beam], ranges[beam, crossing])
            for row, (start, stop) in enumerate(bounds):
                inside = true_values[(times >= start) & (times <= stop)]
                if inside.size:
                    total[row, crossing] += inside.mean()
                    count[row, crossing] += 1
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(count > 0, count, np.nan))


def _along(
    truth: xr.Dataset, instrument: str, zenith: float, distance: float
) -> tuple[Times, Floats]:
    """Return times and true extinction at a distance along a beam."""
    suffix = instrument.replace("-", "_")
    names = np.asarray(truth["instrument"].values, dtype=np.str_)
    if f"profile_granule_{suffix}" not in truth:
        rows = np.flatnonzero(names == instrument)
        true_values = float_values(truth, "total_extinction")[rows]
    else:
        rows = truth[f"profile_granule_{suffix}"].values.astype(np.intp)
        middle = float_values(truth, f"range_{suffix}")
        field = np.asarray(
            truth[f"profile_total_extinction_{suffix}"].values[:, 0], dtype=np.float64
        )
        true_values = np.array([np.interp(distance, middle, row) for row in field])
    times = truth["time"].values.astype("datetime64[ns]")[rows]
    if "zenith_angle" in truth:
        same_beam = np.abs(float_values(truth, "zenith_angle")[rows] - zenith) < _SAME_BEAM
        times, true_values = times[same_beam], true_values[same_beam]
    finite = np.isfinite(true_values)
    return times[finite], true_values[finite]


# Figures -----------------------------------------------------------------------------------------


def _read_crossings(product: xr.Dataset, source: ProductSource) -> list[TimeSeries] | None:
    instruments = instruments_of(source.scene) if source.scene else ()
    return read_crossings(product, source.truth, instruments=instruments) or None


def _read_map(product: xr.Dataset, source: ProductSource) -> NetworkMap:
    return read_map(product, instruments_of(source.scene) if source.scene else ())


def _crossings(contents: Sequence[list[TimeSeries]]) -> list[TimeSeries]:
    return join(crossing for crossings in contents for crossing in crossings)


def _draw_crossings(contents: Sequence[list[TimeSeries]]) -> Iterator[Figure]:
    title = "Visibility and extinction at the crossings"
    return series_figures(_crossings(contents), _QUANTITIES, title)


def _compare(contents: Sequence[list[TimeSeries]]) -> Iterator[Comparison | None]:
    return (compare(crossing, "total_extinction") for crossing in _crossings(contents))


def _draw_map(contents: Sequence[NetworkMap]) -> list[Figure]:
    """Return beams and crossings to scale, with the median visibility at each crossing."""
    network = contents[0]
    known = np.isfinite(network.visibility)
    texts = tuple(
        f"{crossing}: {number(float(f'{value:.3g}'))} km" if has else f"{crossing}: no value"
        for crossing, value, has in zip(network.numbers, network.visibility, known, strict=True)
    )
    layers: list[Layer] = []
    gap = np.full(2, np.nan)
    for index, name in enumerate(dict.fromkeys(network.instruments)):
        beams = [beam for beam, other in enumerate(network.instruments) if other == name]
        ends = [
            part for beam in beams for part in (network.stations[beam], network.ends[beam], gap)
        ]
        layers.append(_points(np.array(ends), f"c1 d{index % 5}"))
        mark = SERIES_MARKS[-1 - index % len(SERIES_MARKS)]
        layers.append(_points(network.stations[beams], "c1", mark, name))
    for where, style, label in (
        (known, "c0", "crossing, with median visibility"),
        (~known, "soft hollow", "crossing without a usable value"),
    ):
        if where.any():
            layers.append(_points(network.crossings[where], style, Mark.DISC, label))
    layers.append(Words(network.crossings[:, 0], network.crossings[:, 1], texts))
    points = np.concatenate([network.stations, network.ends, network.crossings])
    span = np.ptp(points, axis=0)
    half = (0.5 + _ROOM) * np.maximum(span, _NARROW * span.max())
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    x, y = (
        Axis(label, float(start), float(stop))
        for label, start, stop in zip(network.axes, middle - half, middle + half, strict=True)
    )
    words = (
        f"{counted(len(network.stations), 'beam')} of"
        f" {counted(len(set(network.instruments)), 'instrument')}; median visibility at each"
        f" crossing: {', '.join(texts)}"
    )
    panel = Panel(x, y, tuple(layers), _HEIGHT, to_scale=True)
    return [Figure("Map of beams and crossings", words, (panel,))]


def _points(points: Floats, style: str, mark: Mark | None = None, label: str = "") -> Curve:
    """Return points of a map, shape (point, 2), as a line or marked."""
    return Curve(points[:, 0], points[:, 1], style, mark, joined=mark is None, label=label)


FIGURES: Final = KindFigures(
    (
        View("visibility", CROSSING_VARIABLES, _read_crossings, _draw_crossings, _compare),
        View("network", MAP_VARIABLES, _read_map, _draw_map, first=True),
    ),
    preferred="visibility_in_air",
    values=(Quantity("visibility_in_air", 1e-3, "km"), Quantity("total_extinction", 1e3, "km⁻¹")),
)

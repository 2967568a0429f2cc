"""The figures of one file, a raw file or a product of any kind, as `lidarops plot` writes them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import LidarOpsError, ProductError
from lidarops.figures.any_kind import views_of
from lidarops.figures.kind_figures import ProductSource
from lidarops.figures.panels import Axis, Curve, Figure, Panel, decade_axis, span_in_words, units
from lidarops.netcdf.read import NETCDF_MAGIC, open_product, opened_product, reading
from lidarops.raw.archive import open_archive
from lidarops.records import DetectionMode

Floats = NDArray[np.float64]

_POINTS: Final = 800
"""Most points of a curve; a figure is 960 units wide."""
_COLOURS: Final = 5
_STYLES: Final = ("", " d1", " d2", " d3", " d4")


def draw_file(path: Path) -> tuple[Figure, ...]:
    """Return the figures of a raw file or product.

    Those of a product are those of its page; those of a raw file, its channels against range.

    Raises
    ------
    LidarOpsError
        If the file cannot be read, or there is nothing to draw.
    """
    try:
        with path.open("rb") as stream:
            magic = stream.read(4)
    except OSError as error:
        raise LidarOpsError(
            f"cannot be read: {error.strerror}", file=path, wrong_use=True
        ) from error
    figures = tuple(_of_product(path) if magic in NETCDF_MAGIC else _of_raw(path))
    if not figures:
        raise LidarOpsError("holds nothing that can be drawn", file=path)
    return figures


def _of_product(path: Path) -> Iterator[Figure]:
    kind = _kind(path)
    if not kind:
        raise ProductError(
            "is no product of lidarops", file=path, remedy="plot draws raw files and products"
        )
    for view in views_of(kind):
        with reading(path), open_product(path, view.variables) as product:
            content = view.read(product, ProductSource())
        if content is not None:
            yield from view.draw([content])


def _kind(path: Path) -> str:
    with opened_product(path, decode_times=False) as opened:
        return str(opened.attrs.get("lidarops_kind", ""))


def _of_raw(path: Path) -> Iterator[Figure]:
    raw = open_archive([path], header_position="ignore")
    for mode, what in (
        (DetectionMode.PHOTON, "photon counting"),
        (DetectionMode.ANALOG, "analog"),
    ):
        channels = [
            variable
            for variable in raw.data_vars.values()
            if variable.attrs.get("detection_mode") == mode.value and variable.ndim == 2
        ]
        if channels:
            yield _raw_figure(f"{what} signals of {path.name}", channels)


def _raw_figure(title: str, channels: list[xr.DataArray]) -> Figure:
    curves = tuple(_curve(number, channel) for number, channel in enumerate(channels))
    unit = units(str(channels[0].attrs["units"]))
    signals = decade_axis(f"signal with background ({unit})", [curve.y for curve in curves])
    farthest = max(float(curve.x[-1]) for curve in curves)
    panel = Panel(Axis("range (km)", 0.0, farthest), signals, curves, height=360.0)
    words = "; ".join(f"{curve.label} {span_in_words(curve.y, unit)}" for curve in curves)
    return Figure(f"{title[:1].upper()}{title[1:]}", words, (panel,))


def _curve(number: int, channel: xr.DataArray) -> Curve:
    """Return the mean profile of a channel, as means over equal stretches of bins."""
    distance = channel[channel.dims[1]].to_numpy() / 1e3
    signal = np.asarray(channel.mean("time").to_numpy(), dtype=np.float64)
    together = max(1, -(-signal.size // _POINTS))
    starts = np.arange(0, signal.size, together)
    sizes = np.diff([*starts, signal.size])
    style = f"c{number % _COLOURS}{_STYLES[number // _COLOURS % len(_STYLES)]}"
    x, y = (np.add.reduceat(values, starts) / sizes for values in (distance, signal))
    return Curve(x, y, style=style, label=str(channel.name))

"""The figures of one file, a raw file or a product of any kind, as `lidarops plot` writes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import LidarOpsError, ProductError
from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import View, image_view, view_of, views_of
from lidarops.figures.panels import Axis, Curve, Figure, Panel, decade_axis, span_in_words, units
from lidarops.figures.raster import COLUMNS
from lidarops.flags import Severity
from lidarops.netcdf.read import is_netcdf, open_product
from lidarops.netcdf.stored import reading
from lidarops.netcdf.variables import judging, summary_of
from lidarops.raw.archive import open_archive
from lidarops.records import DetectionMode
from lidarops.reports.product_contents import utc_moment

Floats = NDArray[np.float64]

_POINTS: Final = 800
"""Most points of a curve; a figure is 960 units wide."""
_COLOURS: Final = 5
_STYLES: Final = ("", " d1", " d2", " d3", " d4")


@dataclass(frozen=True, slots=True)
class Selection:
    """What is drawn of a product; all of it where nothing is chosen."""

    variable: str = ""
    spans: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    """Ends of `time`, UTC, of `range` and of `altitude`, m."""


ALL: Final = Selection()
TYPES: Final = (".png", ".svg", ".pdf")
"""Suffixes of figures as files."""


def selection(variable: str, time: str, range_: str, altitude: str) -> Selection:
    """Return what options choose: START/STOP, UTC, and LOW/HIGH, km.

    Raises
    ------
    LidarOpsError
        If an option cannot be read.
    """
    options = (
        ("time", time, "START/STOP", utc_moment),
        ("range", range_, "LOW/HIGH in km", lambda end: 1e3 * float(end)),
        ("altitude", altitude, "LOW/HIGH in km", lambda end: 1e3 * float(end)),
    )
    return Selection(variable, {option[0]: _ends(*option) for option in options if option[1]})


def _ends(name: str, span: str, form: str, read: Callable[[str], Any]) -> tuple[Any, Any]:
    """Return the ends of a span."""
    try:
        first, last = (read(end) for end in span.split("/"))
    except ValueError:
        raise LidarOpsError(
            f"is no span: {span!r}", field=name, remedy=f"give {form}", wrong_use=True
        ) from None
    return first, last


def draw_file(path: Path, chosen: Selection = ALL) -> tuple[Figure, ...]:
    """Return the figures of a raw file or product.

    Those of a product are those of its page, or that of a variable; those of a raw file, its
    channels against range.

    Raises
    ------
    LidarOpsError
        If the file cannot be read, or there is nothing to draw.
    """
    figures = tuple(_of_product(path, chosen) if is_netcdf(path) else _of_raw(path, chosen))
    if not figures:
        raise LidarOpsError("holds nothing that can be drawn", file=path)
    return figures


def _of_product(path: Path, chosen: Selection) -> Iterator[Figure]:
    with reading(path), open_product(path, decode_coords=True) as opened:
        kind = str(opened.attrs.get("lidarops_kind", ""))
        if not kind:
            raise ProductError(
                "is no product of lidarops", file=path, remedy="plot draws raw files and products"
            )
        views = [_view_of(opened, kind, chosen.variable)] if chosen.variable else views_of(kind)
    for view in views:
        names = {*view.variables, "time", "range", "altitude", "usable"}
        with reading(path), open_product(path, names) as product:
            content = view.read(_part(product, chosen, path), COLUMNS)
        if content is not None:
            yield from view.draw([content])


def _view_of(product: xr.Dataset, kind: str, name: str) -> View[Any]:
    """Return the view of a variable: that of the kind, an image, or a series over time."""
    if name not in product.data_vars or product[name].dims[:1] != ("time",):
        raise ProductError("is no variable over time of the product", field=name, wrong_use=True)
    for view in views_of(kind):
        if view.shows == name:
            return view
    across = product[name].dims[1:]
    if across in (("range",), ("altitude",)) and f"{name}_standard_error" in product:
        label = str(product[name].attrs.get("long_name", name))
        return image_view(kind, name, ImageQuantity(label), str(across[0]))
    return view_of(kind, name)


def _part(product: xr.Dataset, chosen: Selection, path: Path) -> xr.Dataset:
    """Return the part of a product in the chosen spans."""
    for name, (first, last) in chosen.spans.items():
        along = product.variables.get(name)
        if along is None or along.ndim != 1:
            raise ProductError(f"has no {name}", file=path, wrong_use=True)
        inside = (along.values >= first) & (along.values <= last)
        if not inside.any():
            raise ProductError("lies outside the product", field=name, file=path, wrong_use=True)
        product = product.isel({along.dims[0]: inside})
    return product


def _of_raw(path: Path, chosen: Selection) -> Iterator[Figure]:
    if chosen != ALL:
        raise LidarOpsError("is a raw file, of which no part is drawn", file=path, wrong_use=True)
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


def draw_change(old: Path, new: Path) -> tuple[Figure, ...]:
    """Return the mean profiles of the first quantity of two versions of a product.

    Raises
    ------
    ProductError
        If a file cannot be read, or holds no quantity with an error over range or altitude.
    """
    with reading(new), open_product(old) as former, open_product(new) as latter:
        # With indexes, so that values at the same times and places are compared.
        before, after = (xr.Dataset(product.variables) for product in (former, latter))
        profiles = (
            str(name)
            for name, values in before.data_vars.items()
            if values.dims[1:] in (("range",), ("altitude",))
            if f"{name}_standard_error" in before
        )
        quantity = next(profiles, "")
        if quantity not in after:
            raise ProductError("holds no profiles that can be compared", file=new)
        judge = summary_of(judging(quantity, map(str, before.variables)))
        usable = (before[judge] < Severity.REJECT) & (after[judge] < Severity.REJECT)
        pair = (before[quantity].where(usable), after[quantity].where(usable))
        curves = tuple(
            _curve(number, version.rename(word))
            for number, (word, version) in enumerate(zip(("before", "now"), pair, strict=True))
        )
        unit = units(str(pair[0].attrs["units"]))
        across = Axis(f"{pair[0].dims[1]} (km)", 0.0, max(float(curve.x[-1]) for curve in curves))
    ends = [curve.y[np.isfinite(curve.y)] for curve in curves]
    low, high = (float(end(np.concatenate(ends), initial=0.0)) for end in (np.min, np.max))
    values = Axis(f"{quantity.replace('_', ' ')} ({unit})", low, high)
    words = "; ".join(f"{curve.label} {span_in_words(curve.y, unit)}" for curve in curves)
    title = f"Mean {quantity.replace('_', ' ')} of {new.name}, where both are usable"
    return (Figure(title, words, (Panel(across, values, curves, height=360.0),)),)


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

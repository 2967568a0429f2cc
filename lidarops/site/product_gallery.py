"""The figures of a product page, by kind; unknown kinds are drawn by their dimensions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from markupsafe import Markup
from numpy.typing import NDArray

from lidarops.figures.network_data import read_crossings, read_map
from lidarops.figures.profile_data import clearest_profile
from lidarops.figures.raster import Raster, read_raster
from lidarops.figures.scan_data import clearest_cycle, read_extinction
from lidarops.figures.series_data import Section, join, read_sections
from lidarops.figures.time_axis import time_axis
from lidarops.figures.wording import counted
from lidarops.flags import Quality
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.site import image_panels, network_map, profile_panels, series_panels, svg
from lidarops.site.series_panels import Line
from lidarops.site.svg import LEFT, RIGHT, WIDTH, Panel, Scale, Sheet

Floats = NDArray[np.float64]

THUMB: Final = (240, 84)
"""Width and height of a thumbnail."""
_PREFERRED: Final = (
    "visibility_in_air",
    "extinction",
    "optical_depth",
    "backscatter",
    "signal",
)
_BULK: Final = 64_000_000
"""Bytes of a variable of an unknown kind above which only some profiles are read."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure of a page."""

    caption: str
    figure: Markup


@dataclass(frozen=True, slots=True)
class Gallery:
    """The figures of a product."""

    figures: tuple[Drawn, ...]
    thumbnail: bytes
    """SVG file."""
    alt: str
    """Description of the thumbnail."""


_Parts = tuple[list[Drawn], Sheet, str]


def draw_gallery(product: xr.Dataset, kind: str, style: str) -> Gallery:
    """Draw the figures of a product.

    Parameters
    ----------
    product : Dataset
        Open; may be lazy.
    kind : str
        Kind of the product, which may be unknown.
    style : str
        Style sheet of the thumbnail.

    Returns
    -------
    Gallery

    Raises
    ------
    ProductError
        If the product does not fit its kind.
    """
    drawn, thumbnail, alt = _DRAWERS.get(kind, _any)(product)
    return Gallery(tuple(drawn), thumbnail.file(style), alt)


def _finish(sheet: Sheet, caption: str, words: str, key: str) -> Drawn:
    return Drawn(f"{caption}. {words}.", sheet.svg(key, f"{caption}. {words}."))


def _profiles(product: xr.Dataset) -> int:
    return max(1, -(-product.sizes.get("time", 0) // image_panels.COLUMNS))


def _signal(product: xr.Dataset) -> _Parts:
    raster = read_raster(product, profiles=_profiles(product))
    label = f"range-corrected signal ({svg.units(raster.units)})"
    return _image(raster, "Range-corrected signal", label, "range")


def _image(raster: Raster, what: str, label: str, along: str) -> _Parts:
    sheet, words = image_panels.draw_image(raster, along=along, label=label, key="f1")
    below = ", with the background below" if np.isfinite(raster.background).any() else ""
    caption = f"{what} against time and {along}{below}"
    return [_finish(sheet, caption, words, "f1")], image_panels.thumbnail(raster, *THUMB), caption


def _elastic(product: xr.Dataset) -> _Parts:
    raster = read_raster(product, quantity="attenuated_backscatter", profiles=_profiles(product))
    label = f"attenuated backscatter ({svg.units(raster.units)})"
    drawn, thumbnail, alt = _image(raster, "Attenuated backscatter", label, "range")
    profile = clearest_profile(product)
    if profile is not None:
        sheet, words = profile_panels.error_budget_panels(profile, "f2")
        moment = _moment(profile.time)
        caption = f"Profile at {moment} (most unflagged bins) and its error budget"
        drawn.append(_finish(sheet, caption, words, "f2"))
    return drawn, thumbnail, alt


def _multiangle(product: xr.Dataset) -> _Parts:
    raster = read_extinction(product, profiles=_profiles(product))
    drawn, thumbnail, alt = _image(raster, "Extinction", "extinction (km⁻¹)", "altitude")
    profile = clearest_cycle(product)
    if profile is not None:
        sheet, words = profile_panels.scan_panels(profile, "f2")
        caption = f"Scan cycle at {_moment(profile.time)} (most unflagged values)"
        drawn.append(_finish(sheet, caption, words, "f2"))
    return drawn, thumbnail, alt


def _moment(time: np.datetime64) -> str:
    return str(time.astype("datetime64[s]")).replace("T", " ") + " UTC"


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A quantity in one panel of a stack."""

    name: str
    factor: float
    """From the unit of the section to the displayed unit."""
    title: str
    units: str

    @property
    def label(self) -> str:
        return f"{self.title} ({self.units})"


def _homogeneous(product: xr.Dataset) -> _Parts:
    sections = [section for section in join(read_sections(product)) if section.time.size]
    if not sections:
        return _nothing("no profile")
    units = svg.units(sections[0].estimates["background"].units)
    quantities = (
        _Quantity("extinction", 1e3, "extinction", "km⁻¹"),
        _Quantity("background", 1.0, "background", units),
    )
    return _stacks(sections, quantities, "Extinction and background of range sections")


def _visibility(product: xr.Dataset) -> _Parts:
    quantities = (
        _Quantity("visibility", 1.0, "visibility", "km"),
        _Quantity("extinction", 1e3, "extinction", "km⁻¹"),
    )
    title = "Visibility and extinction at the crossings"
    drawn, thumbnail, alt = _stacks(read_crossings(product), quantities, title)
    sheet, words = network_map.draw_network_map(read_map(product))
    plan = _finish(sheet, "Map of beams and crossings", words, "map")
    return [*drawn, plan], thumbnail, alt


def _stacks(
    sections: Sequence[Section], quantities: tuple[_Quantity, _Quantity], title: str
) -> _Parts:
    """Draw two quantities of series against time, a few series per figure."""
    drawn = []
    for first in range(0, len(sections), series_panels.SERIES):
        few, key = (
            sections[first : first + series_panels.SERIES],
            f"f{first // series_panels.SERIES + 1}",
        )
        sheet, words = _stack(few, quantities, key)
        drawn.append(_finish(sheet, f"{title} against time", words, key))
    main = quantities[0]
    lines = [
        series_panels.line_of(s, main.name, main.factor) for s in sections[: series_panels.SERIES]
    ]
    reach = series_panels.in_words(lines, main.units)
    alt = f"{main.title.capitalize()} against time. {reach}"
    return drawn, series_panels.sparkline(lines, *THUMB), alt


def _stack(
    sections: Sequence[Section], quantities: tuple[_Quantity, _Quantity], key: str
) -> tuple[Sheet, str]:
    axis = time_axis(np.unique(np.concatenate([section.time for section in sections])))
    sheet = Sheet(height=516)
    places = ((268, 28), (466, 292))
    panels: list[Panel] = []
    drawn: list[tuple[str, Panel, list[Line]]] = []
    for shown, (foot, top) in zip(quantities, places, strict=True):
        lines = [series_panels.line_of(section, shown.name, shown.factor) for section in sections]
        panel = Panel(
            series_panels.time_scale(axis), Scale(*series_panels.limits(lines), foot, top)
        )
        sheet.frame(panel, shown.label)
        panels.append(panel)
        drawn.append((shown.name, panel, lines))
    series_panels.time_ticks(sheet, axis, panels)
    words = [series_panels.in_words(drawn[0][2], quantities[0].units)]
    for name, panel, lines in drawn:
        beyond = series_panels.values(sheet, panel, axis, lines, f"{key}-{name}")
        if beyond:
            words.append(f"{counted(beyond, 'value')} of {name} beyond the axis")
    series_panels.series_legend(sheet, 14, drawn[0][2])
    return sheet, "; ".join(words)


def nothing(words: str, style: str) -> Gallery:
    """Return a gallery without figures, with the reason as thumbnail."""
    _, thumbnail, alt = _nothing(words)
    return Gallery((), thumbnail.file(style), alt)


def _nothing(words: str) -> _Parts:
    sheet = Sheet(height=THUMB[1], width=THUMB[0])
    sheet.text(THUMB[0] / 2, THUMB[1] / 2 + 5, words, css="t m")
    return [], sheet, f"No figure: {words}"


def _any(product: xr.Dataset) -> _Parts:
    """Draw the main variable of any product against its first dimension."""
    name = _main_variable(product)
    if name is None:
        return _nothing("no variable to draw")
    variable = product[name]
    first = variable.dims[0]
    step = max(1, -(-variable.nbytes // _BULK))
    some = product.isel({first: slice(None, None, step)})
    variable = some[name]
    table = variable.values.reshape(variable.sizes[first], -1).astype(np.float64)
    lines = _lines(some, variable, table)
    words = str(variable.attrs.get("long_name", name))
    unit = svg.units(str(variable.attrs.get("units", "")))
    label = f"{name.replace('_', ' ')} ({unit})" if unit not in ("", "1") else name
    axis = time_axis(np.unique(variable["time"].values.astype("datetime64[ns]")))
    sheet = Sheet(height=390)
    panel = Panel(
        Scale(*axis.limits, LEFT, WIDTH - RIGHT), Scale(*series_panels.limits(lines), 330, 28)
    )
    sheet.frame(panel, label)
    series_panels.time_ticks(sheet, axis, [panel])
    series_panels.values(sheet, panel, axis, lines, "f1")
    series_panels.series_legend(sheet, 14, lines)
    caption = f"{words[:1].upper()}{words[1:]} against time"
    if table.shape[1] > len(lines):
        caption += f", {len(lines)} of {table.shape[1]} series"
    drawn = _finish(sheet, caption, series_panels.in_words(lines, unit), "f1")
    return [drawn], series_panels.sparkline(lines, *THUMB), caption


def _main_variable(product: xr.Dataset) -> str | None:
    """Return the most interesting variable over time, or None."""
    if "time" not in product.variables or product["time"].dtype.kind != "M":
        return None
    over_time = [
        str(name)
        for name, variable in product.data_vars.items()
        if variable.dims[:1] == ("time",) and variable.dtype.kind == "f" and variable.size
    ]
    preferred = [name for name in _PREFERRED if name in over_time]
    uncertain = [name for name in over_time if f"{name}_standard_error" in product]
    return next(iter([*preferred, *uncertain, *over_time]), None)


def _lines(product: xr.Dataset, variable: xr.DataArray, table: Floats) -> list[Line]:
    time = variable["time"].values.astype("datetime64[ns]")
    order = np.argsort(time, kind="stable")
    time, table = time[order], table[order]
    flag = np.zeros(table.shape, dtype=np.int64)
    if QUALITY_FLAG in product and product[QUALITY_FLAG].dims == variable.dims:
        flag = product[QUALITY_FLAG].values.reshape(table.shape).astype(np.int64)[order]
    counts = np.isfinite(table).sum(axis=0)
    columns = np.sort(np.argsort(-counts, kind="stable")[: series_panels.SERIES])
    name = str(variable.dims[1]) if variable.ndim > 1 else ""
    rejected = (flag & int(Quality.rejecting())) != 0
    return [
        Line(
            label=f"{name} {column}".strip(),
            time=time[~rejected[:, column]],
            value=table[~rejected[:, column], column],
            error=np.full(int((~rejected[:, column]).sum()), np.nan),
            off_time=time[rejected[:, column]],
            off_value=table[rejected[:, column], column],
        )
        for column in columns.tolist()
    ]


_DRAWERS: Final[Mapping[str, Callable[[xr.Dataset], _Parts]]] = {
    "signal": _signal,
    "homogeneous": _homogeneous,
    "elastic": _elastic,
    "multiangle": _multiangle,
    "visibility": _visibility,
}

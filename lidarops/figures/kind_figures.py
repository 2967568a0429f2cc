"""What a kind of product states about its figures, and how pages and reports find it.

A kind has a module ``figures``, which holds `KindFigures` by the name ``FIGURES``. Of products of
other kinds, the main variable is drawn against time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, TypeVar

import numpy as np
import xarray as xr

from lidarops.figures.image_panels import ImageQuantity, image_figure
from lidarops.figures.panels import Figure, units
from lidarops.figures.raster import Raster, raster_variables, read_raster
from lidarops.figures.series_data import TimeSeries, join
from lidarops.figures.series_panels import SERIES, Quantity, series_figures
from lidarops.kinds import kinds
from lidarops.netcdf.stored_flags import judge
from lidarops.netcdf.variables import layout_of, possible_judges, summary_of

Content = TypeVar("Content")


@dataclass(frozen=True, slots=True)
class View(Generic[Content]):
    """A way to look at products of one instrument and channel."""

    name: str
    """Name among the views of its kind."""
    variables: tuple[str, ...]
    """Variables that `read` needs."""
    read: Callable[[xr.Dataset, int], Content | None]
    """Reduces an open product, which may be lazy, to so many columns of an image at most; None if
    there is nothing to show. Raises `ProductError` if the product is of another kind. It is sent to
    another process, so it must be possible to pickle it."""
    draw: Callable[[Sequence[Content]], Iterable[Figure]]
    """Returns the figures of the contents of at least one product."""
    first: bool = False
    """Whether a report draws only the first product that has content."""
    shows: str = ""
    """Variable of an image against time."""


@dataclass(frozen=True, slots=True)
class KindFigures:
    """Figures of a kind of product."""

    views: tuple[View[Any], ...]
    """In the order of the page."""
    preferred: str
    """Variable for an overview of any product that has it."""


def image_view(
    kind: str, variable: str, quantity: ImageQuantity, along: str = "range"
) -> View[Raster]:
    """Return the view of a variable of a kind against time and range or altitude."""
    return View(
        kind if kind == variable else f"{kind}-{variable.replace('_', '-')}",
        raster_variables(variable, along),
        partial(_read_raster, variable, along, quantity.farthest),
        lambda rasters: [image_figure(rasters, quantity, along)],
        shows=variable,
    )


def _read_raster(
    variable: str, along: str, farthest: float, product: xr.Dataset, columns: int
) -> Raster:
    names = [name for name in raster_variables(variable, along) if name in product.variables]
    part = product[names]
    if along in part:
        part = part.isel({along: slice(0, int(np.searchsorted(part[along].values, farthest)))})
    profiles = max(-(-part.sizes["time"] // columns), 1)
    return read_raster(part, quantity=variable, profiles=profiles, along=along)


def figures_of(kind: str) -> KindFigures | None:
    """Return the figures of a kind of product; None if the kind is unknown or states none."""
    known = kinds().get(kind)
    return known.optional_part("figures", "FIGURES") if known else None


def preferred_variables() -> tuple[str, ...]:
    """Return the preferred variables of all kinds, in the order of their rank."""
    known = (figures_of(kind) for kind in kinds())
    return tuple(dict.fromkeys(figures.preferred for figures in known if figures is not None))


# Products of any kind --------------------------------------------------------------------------

_BULK: Final = 64_000_000
"""Bytes of a variable above which only some profiles are read."""

AnyContent = tuple[str, Quantity, tuple[TimeSeries, ...]]
"""Title, the variable, and its series."""


def _main_name(product: xr.Dataset) -> str | None:
    """Return the name of the main variable of a product; None without a variable over time.

    The first of: the preferred variables of all kinds, variables with a standard error,
    floating-point variables.
    """
    if "time" not in product.variables or product["time"].dtype.kind != "M":
        return None
    over_time = [
        str(name)
        for name, variable in product.data_vars.items()
        if variable.dims[:1] == ("time",) and variable.dtype.kind == "f" and variable.size
    ]
    preferred = [name for name in preferred_variables() if name in over_time]
    uncertain = [name for name in over_time if f"{name}_standard_error" in product]
    return next(iter([*preferred, *uncertain, *over_time]), None)


def view_of(kind: str, name: str | None = None) -> View[AnyContent]:
    """Return the view of a variable; of the main one for kinds without figures, or unknown."""
    data = layout_of(kind).data if kind in kinds() and not name else ()
    uncertain = [row.name for row in data if row.uncertain]
    names = [name] if name else dict.fromkeys([*uncertain, *preferred_variables()])
    errors = (f"{name}_standard_error" for name in names)
    judges = dict.fromkeys(flags for name in names for flags in possible_judges(name))
    summaries = (summary_of(flags) for flags in judges)
    variables = "time", *names, *errors, *judges, *summaries
    return View(kind, variables, partial(_read, name), _draw)


def views_of(kind: str) -> Sequence[View[Any]]:
    """Return the views of products of any kind, known or not."""
    figures = figures_of(kind)
    return figures.views if figures is not None else (view_of(kind),)


def _read(name: str | None, product: xr.Dataset, _: int) -> AnyContent | None:
    """Return the series with the most values; of a large variable, only of some profiles."""
    name = name or _main_name(product)
    if name is None:
        return None
    step = max(1, -(-product[name].nbytes // _BULK))
    some = product.isel(time=slice(None, None, step))
    some = some.isel(time=np.argsort(some["time"].values, kind="stable"))
    variable = some[name]

    def table(other: str) -> xr.DataArray:
        """Return another variable along the dimensions of this one; NaN if there is none."""
        has = other in some and some[other].dims == variable.dims
        return some[other] if has else xr.full_like(variable, np.nan)

    shape = variable.sizes["time"], -1
    values, errors = (
        table(which).values.reshape(shape).astype(np.float64)
        for which in (name, f"{name}_standard_error")
    )
    judged = judge(some, name)
    flags = judged.bits.reshape(shape)
    time = some["time"].values.astype("datetime64[ns]")
    most_values = np.argsort(-np.isfinite(values).sum(axis=0), kind="stable")[:SERIES]
    series = tuple(
        TimeSeries(
            time,
            {name: values[:, k], f"{name}_standard_error": errors[:, k]},
            flags[:, k],
            judged.rejecting,
            label=f"{variable.dims[1]} {k}" if variable.ndim > 1 else "",
            key=(k,),
        )
        for k in np.sort(most_values).tolist()
    )
    title = str(variable.attrs.get("long_name", name))
    few = f", {len(series)} of {values.shape[1]} series" if values.shape[1] > len(series) else ""
    quantity = Quantity(name, 1.0, units(str(variable.attrs.get("units", ""))))
    return f"{title[:1].upper()}{title[1:]}{few}", quantity, series


def _draw(contents: Sequence[AnyContent]) -> Iterator[Figure]:
    title, quantity, _ = contents[0]
    joined = join(one for _, other, more in contents for one in more if other == quantity)
    return series_figures(joined[:SERIES], (quantity,), title)

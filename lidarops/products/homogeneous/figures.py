"""The figures of the ``homogeneous`` product: extinction and background of sections.

Beside them, the truth of a simulated campaign.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.kind_figures import KindFigures, ProductSource, View
from lidarops.figures.panels import Figure, units
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
from lidarops.figures.time_axis import Times, usual_step
from lidarops.netcdf.stored_flags import bits_of, quality_bits, rejecting_mask
from lidarops.records import Role

Floats = NDArray[np.float64]

QUANTITIES: Final = ("total_extinction", "background", "amplitude")
"""Retrieved quantities, as the names of their variables."""
_ALONG_BOTH: Final = (
    *QUANTITIES,
    *(f"{name}_standard_error" for name in QUANTITIES),
    "quality_flag",
)
SECTION_VARIABLES: Final = ("time", *_ALONG_BOTH, "section_bounds")
"""Variables that `read_sections` needs."""


def read_sections(
    product: xr.Dataset,
    truth: xr.Dataset | None = None,
    *,
    instrument: str = "",
    channel: str = "",
    paths: Sequence[str] = (),
    dark_subtracted: bool = True,
) -> list[TimeSeries]:
    """Return the sections of a homogeneous product.

    Parameters
    ----------
    product : Dataset
        Kind ``homogeneous``, dims (time, section).
    truth : Dataset, optional
        Truth of a simulated campaign, dimension granule.
    instrument, channel : str, optional
        Select the truth; empty for any instrument.
    paths : sequence of str, optional
        Raw files of the profiles, in their order. If there is one per profile, the truth is
        matched by path, else by time.
    dark_subtracted : bool, optional
        Whether the dark signal was subtracted. If not, it is part of the retrieved background
        and of its truth.

    Returns
    -------
    list of TimeSeries
        Sorted by near end; truth is NaN where unknown.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions or units.
    """
    _check(product)
    order = np.argsort(product["time"].values, kind="stable")
    time = product["time"].values.astype("datetime64[ns]")[order]
    ordered = [paths[i] for i in order] if len(paths) == time.size else []
    true_values = {
        name: _truth(truth, time, instrument, ordered, variables)
        for name, variables in _true_variables(channel, dark_subtracted=dark_subtracted).items()
    }
    flags = quality_bits(product["quality_flag"])[order]
    rejecting = rejecting_mask(bits_of(product))
    bounds = product["section_bounds"].values.astype(np.float64)
    sections = []
    for k in np.argsort(bounds[:, 0], kind="stable"):
        estimates = {
            name: SeriesEstimate(
                value=float_values(product, name)[order, k],
                standard_error=float_values(product, f"{name}_standard_error")[order, k],
                truth=true_values[name],
                units=str(product[name].attrs.get("units", "")),
            )
            for name in QUANTITIES
        }
        near, far = bounds[k].tolist()
        label = f"{near / 1e3:g}\N{EN DASH}{far / 1e3:g} km"
        section = TimeSeries(time, flags[:, k], rejecting, estimates, label, (near, far))
        sections.append(section)
    return sections


def _check(product: xr.Dataset) -> None:
    require(product, {"time": ("time",)} | dict.fromkeys(_ALONG_BOTH, ("time", "section")))
    if "section_bounds" not in product or product["section_bounds"].shape[1:] != (2,):
        raise ProductError("has no section bounds", field="section_bounds")
    units = product["total_extinction"].attrs.get("units")
    if units != "m-1":
        raise ProductError(f"has the units {units!r}, not 'm-1'", field="total_extinction")


def _true_variables(channel: str, *, dark_subtracted: bool) -> Mapping[str, Sequence[str]]:
    """Return for each quantity the variables of the truth that add up to its true value."""
    offset = () if dark_subtracted else (f"dark_offset_{channel}",)
    return {
        "total_extinction": ("total_extinction",),
        "background": (f"background_{channel}", *offset),
        "amplitude": (f"amplitude_{channel}",),
    }


def _truth(
    truth: xr.Dataset | None,
    time: Times,
    instrument: str,
    paths: Sequence[str],
    variables: Sequence[str],
) -> Floats:
    """Return a true value of every profile: of its raw file, else of the nearest in time."""
    if truth is None or variables[0] not in truth.variables or truth.sizes["granule"] == 0:
        return np.full(time.size, np.nan)
    # Photon counting has no dark offset.
    terms = [float_values(truth, name) for name in variables if name in truth.variables]
    table = pd.DataFrame(
        {
            "path": truth["path"].values.astype(np.str_),
            "instrument": truth["instrument"].values.astype(np.str_),
            "value": np.sum(terms, axis=0),
        },
        index=truth["time"].values.astype("datetime64[ns]"),
    )
    table = table[table["instrument"] == instrument] if instrument else table
    by_path = table.set_index("path")["value"]
    if len(paths) and by_path.index.is_unique and by_path.index.isin(paths).sum() == len(paths):
        return np.asarray(by_path.loc[list(paths)])
    by_time = table["value"].sort_index()
    by_time = by_time[~by_time.index.duplicated()]
    step = usual_step(by_time.index.to_numpy())
    return np.asarray(by_time.reindex(time, method="nearest", tolerance=0.6 * step))


def _read(product: xr.Dataset, source: ProductSource) -> list[TimeSeries] | None:
    scene = source.scene
    steps = scene.plan.steps if scene and scene.plan else ()
    sections = read_sections(
        product,
        source.truth,
        instrument=source.instrument,
        channel=source.channel,
        paths=[item.path for item in scene.inputs if item.role is Role.SIGNAL] if scene else (),
        dark_subtracted=any(
            step.name == "dark" and step.channel == source.channel for step in steps
        ),
    )
    return [section for section in sections if section.time.size] or None


def _sections(contents: Sequence[list[TimeSeries]]) -> list[TimeSeries]:
    return join(section for sections in contents for section in sections)


def _draw(contents: Sequence[list[TimeSeries]]) -> Iterator[Figure]:
    sections = _sections(contents)
    background = units(sections[0].estimates["background"].units)
    quantities = (
        Quantity("total_extinction", 1e3, "km⁻¹"),
        Quantity("background", 1.0, background),
    )
    return series_figures(sections, quantities, "Extinction and background of range sections")


def _compare(contents: Sequence[list[TimeSeries]]) -> Iterator[Comparison | None]:
    for section in _sections(contents):
        yield from (compare(section, quantity) for quantity in QUANTITIES)


FIGURES: Final = KindFigures(
    (View("homogeneous", SECTION_VARIABLES, _read, _draw, _compare),),
    preferred="total_extinction",
    values=(Quantity("total_extinction", 1e3, "km⁻¹"),),
)

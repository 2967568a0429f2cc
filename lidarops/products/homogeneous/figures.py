"""The figures of the ``homogeneous`` product: extinction and background of sections.

Beside them, the truth of a simulated campaign.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.kind_figures import KindFigures, ProductSource, View
from lidarops.figures.panels import Figure, units
from lidarops.figures.series_data import (
    Comparison,
    Section,
    SeriesEstimate,
    compare,
    float_values,
    join,
    quality_bits,
    require,
)
from lidarops.figures.series_panels import Quantity, score_figures, series_figures
from lidarops.figures.time_axis import Times
from lidarops.products.homogeneous.variables import FLAGS
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
) -> list[Section]:
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
    list of Section
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
        near, far = float(bounds[k, 0]), float(bounds[k, 1])
        sections.append(Section(time, flags[:, k], FLAGS.rejecting, estimates, near, far))
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
    if truth is None or variables[0] not in truth.variables or truth.sizes["granule"] == 0:
        return np.full(time.size, np.nan)
    # Photon counting has no dark offset.
    terms = [float_values(truth, name) for name in variables if name in truth.variables]
    index = _match(time, truth, instrument, paths)
    return np.where(index >= 0, np.sum(terms, axis=0)[index], np.nan)


def _match(
    time: Times, truth: xr.Dataset, instrument: str, paths: Sequence[str]
) -> NDArray[np.intp]:
    """Return the index of the truth of every profile, -1 without one."""
    granules = np.arange(truth.sizes["granule"])
    if instrument:
        granules = granules[_texts(truth["instrument"]) == instrument]
    if paths:
        index = {
            path: int(i) for i, path in zip(granules, _texts(truth["path"])[granules], strict=True)
        }
        matched = np.array([index.get(path, -1) for path in paths], dtype=np.intp)
        if (matched >= 0).all():
            return matched
    return _nearest(time, truth["time"].values.astype("datetime64[ns]")[granules], granules)


def _nearest(time: Times, known: Times, granules: NDArray[np.intp]) -> NDArray[np.intp]:
    if known.size == 0:
        return np.full(time.size, -1, dtype=np.intp)
    order = np.argsort(known, kind="stable")
    known, granules = known[order], granules[order]
    after = np.clip(np.searchsorted(known, time), 1, max(known.size - 1, 1))
    after = np.minimum(after, known.size - 1)
    before = np.maximum(after - 1, 0)
    to_before, to_after = np.abs(time - known[before]), np.abs(time - known[after])
    # The truth may state starts of granules, but profiles have middles: of two about equally
    # near neighbours, the earlier one is taken.
    step = np.median(np.diff(known)) if known.size > 1 else np.timedelta64(120, "s")
    earlier = to_before <= to_after + step * 0.1
    best = np.where(earlier, before, after)
    near = np.where(earlier, to_before, to_after) <= step * 0.6
    return np.where(near, granules[best], -1)


def _texts(strings: xr.DataArray) -> NDArray[np.str_]:
    values = strings.values
    if values.dtype.kind == "S":
        return np.char.decode(values, "utf-8")
    return np.asarray(values, dtype=np.str_)


def _read(product: xr.Dataset, source: ProductSource) -> list[Section] | None:
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


def _sections(contents: Sequence[list[Section]]) -> list[Section]:
    return join(section for sections in contents for section in sections)


def _draw(contents: Sequence[list[Section]]) -> Iterator[Figure]:
    sections = _sections(contents)
    background = units(sections[0].estimates["background"].units)
    quantities = (
        Quantity("total_extinction", 1e3, "km⁻¹"),
        Quantity("background", 1.0, background),
    )
    yield from series_figures(sections, quantities, "Extinction and background of range sections")
    yield from score_figures(sections, QUANTITIES)


def _compare(contents: Sequence[list[Section]]) -> Iterator[Comparison | None]:
    for section in _sections(contents):
        yield from (compare(section, quantity) for quantity in QUANTITIES)


FIGURES: Final = KindFigures(
    (View("homogeneous", SECTION_VARIABLES, _read, _draw, _compare),),
    preferred="total_extinction",
    values=(Quantity("total_extinction", 1e3, "km⁻¹"),),
)

"""One profile of a product against range or altitude: values with errors, flags, error budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.kind_figures import View
from lidarops.figures.panels import (
    Axis,
    Band,
    Curve,
    Figure,
    Layer,
    Panel,
    decade_axis,
    flag_marks,
    percentile_axis,
    span_in_words,
)
from lidarops.figures.series_data import require
from lidarops.figures.wording import utc
from lidarops.netcdf.stored_flags import flags_names, judge
from lidarops.netcdf.variables import judging, possible_judges

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_HEIGHT: Final = 366
_POINTS: Final = 300
"""Most values that are drawn of a longer profile: every second one, or fewer."""
_BEYOND: Final = 1.15
"""A profile that depends on a window is shown to this many times its upper end."""
_MARKS: Final = 30
"""About the largest number of marks of one kind in a panel."""
_UNCLEAR: Final = 10.0
"""Lower quartiles of the errors beyond which an error does not set the axis."""


@dataclass(frozen=True, slots=True)
class ProfileQuantity:
    """A quantity as a panel of a profile shows it."""

    name: str
    """Name of its variable, beside which there is a standard error."""
    label: str
    """Name with the displayed unit."""
    factor: float = 1.0
    """From the unit of the product to the displayed unit."""
    more_errors: tuple[str, ...] = ()
    """Ends of the names of independent errors that products of some channels have beside it."""
    bound: str = ""
    """End of the name of a bound of systematic errors, drawn around the band of errors."""
    reference: str = ""
    """Another variable along the profile to compare with, such as that of molecules."""
    window: tuple[str, ...] = ()
    """Names of the two ends of a window along the profile that the values depend on."""
    budget: tuple[str, ...] = ()
    """Causes of errors, of which a further panel shows each and their total."""

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of the variables of errors that all products have."""
        bound = (f"{self.name}_{self.bound}",) if self.bound else ()
        causes = (f"{self.name}_error_{cause}" for cause in self.budget)
        return f"{self.name}_standard_error", *bound, *causes


def profile_view(name: str, quantities: Sequence[ProfileQuantity], along: str) -> View[xr.Dataset]:
    """Return the view of the clearest profile of a product; the first quantity is the main one."""
    dims = _dims(quantities, along)
    more = tuple(f"{one.name}_{part}" for one in quantities for part in one.more_errors)
    flags = dict.fromkeys(flags for one in quantities for flags in possible_judges(one.name))
    read = partial(_read, quantities, along, dims, more)
    return View(name, (*dims, *more, *flags), read, partial(_draw, quantities, along), first=True)


def _dims(quantities: Sequence[ProfileQuantity], along: str) -> dict[str, tuple[str, ...]]:
    """Return the variables that all products have, with their dimensions."""
    both = [name for quantity in quantities for name in (quantity.name, *quantity.errors)]
    beside = [one.reference for one in quantities if one.reference]
    dims: dict[str, tuple[str, ...]] = {"time": ("time",), along: (along,)}
    dims |= dict.fromkeys(beside, (along,))
    dims |= dict.fromkeys((end for one in quantities for end in one.window), ("time",))
    return dims | dict.fromkeys(both, ("time", along))


def _read(
    quantities: Sequence[ProfileQuantity],
    along: str,
    dims: dict[str, tuple[str, ...]],
    more: tuple[str, ...],
    product: xr.Dataset,
    _: int,
) -> xr.Dataset | None:
    """Return the profile with the most unflagged values, up to the last usable one.

    Values of the main quantity, the first. If it depends on a window, only values to just beyond
    that count and are shown. Among equals, that with the most usable values, then the first; None
    without any usable value. ``<name>_rejected`` and ``<name>_with_care`` of it are the verdicts
    of the values of a quantity.
    """
    main = quantities[0]
    flags = judging(main.name, flags_names(product))
    require(product, dims | {flags: ("time", along)})
    judged = {one.name: judge(product, one.name) for one in quantities}
    usable = np.isfinite(product[main.name].values) & ~judged[main.name].rejected
    if main.window:
        far = _BEYOND * product[main.window[-1]].values[:, None]
        # All are shown where there is no window: it is NaN.
        usable &= ~(product[along].values >= far)
    if not usable.any():
        return None
    earlier = -np.arange(len(usable))
    clear = (usable & (judged[main.name].bits == 0)).sum(axis=1)
    index = int(np.lexsort((earlier, usable.sum(axis=1), clear))[-1])
    shown = slice(0, max(int(np.flatnonzero(usable[index])[-1]) + 1, 2))
    profile = product[[name for name in (*dims, *more) if name in product.variables]]
    verdicts = {
        f"{name}_{verdict}": (along, getattr(one, verdict)[index, shown])
        for name, one in judged.items()
        for verdict in ("rejected", "with_care")
    }
    return profile.isel({"time": index, along: shown}).load().assign(verdicts)


def _draw(
    quantities: Sequence[ProfileQuantity], along: str, profiles: Sequence[xr.Dataset]
) -> list[Figure]:
    profile = profiles[0]
    place = profile[along].values.astype(np.float64) / 1e3
    y = Axis(f"{along} (km)", float(place[0]), float(place[-1]) + 0.02)
    panels: list[Panel] = []
    for quantity in quantities:
        if np.isfinite(profile[quantity.name].values).any():
            panels.append(_panel(profile, quantity, place, y))
            if quantity.budget:
                panels.append(_budget(profile, quantity, place, y))
    main = quantities[0]
    rejected = profile[f"{main.name}_rejected"]
    usable = main.factor * profile[main.name].where(~rejected).values
    flagged = int((rejected | profile[f"{main.name}_with_care"]).sum())
    title = f"{main.label[:1].upper()}{main.label[1:]}"
    words = (
        f"{title}: {span_in_words(usable, '')}; {flagged} of {place.size} values flagged;"
        " bands are standard errors"
    )
    time = utc(np.datetime64(profile["time"].item(), "ns"))
    caption = f"Profile at {time} (most unflagged values)"
    return [Figure(caption, words, tuple(panels), beside=True)]


def _panel(profile: xr.Dataset, quantity: ProfileQuantity, place: Floats, y: Axis) -> Panel:
    def values(name: str) -> Floats:
        return quantity.factor * np.asarray(profile[name].values, dtype=np.float64)

    name, thin = quantity.name, _thin(place)
    rejected, care = (profile[f"{name}_{verdict}"].values for verdict in ("rejected", "with_care"))
    whole = values(name)
    value = np.where(rejected, np.nan, whole)
    more = [part for part in quantity.more_errors if f"{name}_{part}" in profile]
    parts = [
        values(f"{name}_standard_error"),
        *(np.nan_to_num(values(f"{name}_{p}")) for p in more),
    ]
    error = np.sqrt(np.sum(np.square(parts), axis=0))
    label = ", with the ".join(["standard error", *(part.replace("_", " ") for part in more)])
    layers: list[Layer] = []
    if quantity.window:
        window = np.array([profile[end].item() / 1e3 for end in quantity.window])
        far = 2.0 * np.nanmax(np.abs(value) + error) * np.ones(2)
        words = quantity.window[0].rpartition("_")[0]
        layers.append(Band(window, -far, far, "soft wide", upright=True, label=f"{words} window"))
    if quantity.bound:
        wide = error + np.nan_to_num(values(f"{name}_{quantity.bound}"))
        words = f"largest {quantity.bound.replace('_', ' ')}"
        ends = (value - wide)[thin], (value + wide)[thin]
        layers.append(Band(place[thin], *ends, "c0 wide", upright=True, label=words))
    low, high = value - error, value + error
    layers.append(Band(place[thin], low[thin], high[thin], upright=True, label=label))
    layers.append(Curve(value[thin], place[thin], label="retrieved"))
    clear = _clear(value, error)
    spans = [low[clear], high[clear]]
    if quantity.reference:
        beside = values(quantity.reference)
        words = quantity.reference.replace("_", " ")
        layers.append(Curve(beside[thin], place[thin], "c1 d2", label=words))
        spans.append(beside)
    marked = np.isfinite(whole)
    layers += flag_marks(whole, place, marked & care, marked & rejected, _MARKS)
    return Panel(percentile_axis(quantity.label, spans, 0.5, 0.08), y, tuple(layers), _HEIGHT)


def _thin(place: Floats) -> slice:
    """Return which values of a profile curves and bands show; all count and set the axis."""
    return slice(None, None, -(-place.size // _POINTS))


def _clear(value: Floats, error: Floats) -> Mask:
    """Return which values set the axis: not those whose errors would hide all others."""
    known = np.isfinite(value) & np.isfinite(error)
    if not known.any():
        return known
    low, middle = np.percentile(error[known], [25.0, 50.0])
    usual = np.abs(value[known & (error <= middle)]).max()
    return np.asarray(known & (error <= max(_UNCLEAR * low, usual)))


def _budget(profile: xr.Dataset, quantity: ProfileQuantity, place: Floats, y: Axis) -> Panel:
    """Return the absolute errors of a quantity by cause."""
    name, thin = quantity.name, _thin(place)
    good = ~profile[f"{name}_rejected"].values

    def errors(of: str) -> Floats:
        return np.where(good, quantity.factor * np.abs(profile[of].values), np.nan)

    causes = {part.replace("_", " "): errors(f"{name}_error_{part}") for part in quantity.budget}
    total = errors(f"{name}_standard_error")
    lines = [
        Curve(values[thin], place[thin], f"c{number} d{number}", label=cause)
        for number, (cause, values) in enumerate(causes.items())
    ]
    x = decade_axis(f"error of {quantity.label}", [*causes.values(), total])
    whole = Curve(total[thin], place[thin], "ink thick", label="total")
    return Panel(x, y, (*lines, whole), _HEIGHT)

"""The figures of the ``raman`` product: an image of extinction, and a profile of all quantities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, ProductSource, View, image_view
from lidarops.figures.panels import (
    Axis,
    Band,
    Curve,
    Figure,
    Panel,
    percentile_axis,
    span_in_words,
)
from lidarops.figures.series_data import require
from lidarops.figures.series_panels import Quantity
from lidarops.figures.wording import utc
from lidarops.kinds import flags_of

Floats = NDArray[np.float64]

_MEGA: Final = 1e6
_HEIGHT: Final = 366
_QUANTITY: Final = "aerosol_extinction"
_IMAGES: Final = {
    "aerosol_extinction": ImageQuantity("aerosol extinction", _MEGA, "Mm⁻¹", (1.0, 1000.0)),
    "aerosol_backscatter": ImageQuantity(
        "aerosol backscatter", _MEGA, "Mm⁻¹ sr⁻¹", (0.01, 10.0), background=False
    ),
}
"""Images by variable; colours from background aerosol to dust and cirrus, as of ``elastic``."""
_SHOWN: Final = (
    ("aerosol_extinction", "aerosol extinction (Mm⁻¹)", _MEGA),
    ("aerosol_backscatter", "aerosol backscatter (Mm⁻¹ sr⁻¹)", _MEGA),
    ("lidar_ratio", "lidar ratio (sr)", 1.0),
)
"""Variable, axis and scale of each panel."""
_ALONG_BOTH: Final = (
    *(name for name, _, _ in _SHOWN),
    *(f"{name}_standard_error" for name, _, _ in _SHOWN),
    "vertical_resolution",
    "quality_flag",
)
_REJECTED: Final = flags_of("raman").rejecting


@dataclass(frozen=True, slots=True)
class _Profile:
    """The profile that is drawn."""

    time: np.datetime64
    """UTC."""
    range: Floats
    """m."""
    values: dict[str, tuple[Floats, Floats]]
    """Value and standard error of each quantity; NaN where rejected."""
    resolution: Floats
    """m."""


def _read(product: xr.Dataset, _: ProductSource) -> _Profile | None:
    """Return the profile with the most values that are not rejected; None if there are none."""
    require(
        product,
        {"time": ("time",), "range": ("range",)} | dict.fromkeys(_ALONG_BOTH, ("time", "range")),
    )
    rejected = (product["quality_flag"].to_numpy().astype(np.int64) & _REJECTED) != 0
    usable = ~rejected & np.isfinite(product[_QUANTITY].to_numpy())
    if not usable.any():
        return None
    index = int(np.argmax(usable.sum(axis=1)))
    shown = np.flatnonzero(usable[index])
    stop = int(shown[-1]) + 1
    profile = product.isel(time=index, range=slice(0, stop))
    hidden = rejected[index, :stop]

    def values(name: str) -> Floats:
        return np.where(hidden, np.nan, profile[name].to_numpy().astype(np.float64))

    return _Profile(
        product["time"].to_numpy().astype("datetime64[ns]")[index],
        profile["range"].to_numpy().astype(np.float64),
        {name: (values(name), values(f"{name}_standard_error")) for name, _, _ in _SHOWN},
        values("vertical_resolution"),
    )


def _draw(profiles: Sequence[_Profile]) -> list[Figure]:
    """Return extinction, backscatter and lidar ratio of a profile with their standard errors."""
    profile = profiles[0]
    r = profile.range / 1e3
    y = Axis("range (km)", float(r.min()), float(r.max()))
    panels = tuple(
        _panel(profile, name, label, scale, y)
        for name, label, scale in _SHOWN
        if np.isfinite(profile.values[name][0]).any()
    )
    reach = span_in_words(_MEGA * profile.values["aerosol_extinction"][0], "Mm⁻¹")
    resolution = span_in_words(profile.resolution, "m")
    words = (
        f"Particle extinction {reach} with a vertical resolution of {resolution}; bands are"
        " standard errors"
    )
    caption = f"Profile at {utc(profile.time)} (most usable bins)"
    return [Figure(caption, words, panels, beside=True)]


def _panel(profile: _Profile, name: str, label: str, scale: float, y: Axis) -> Panel:
    value, error = (scale * values for values in profile.values[name])
    x = percentile_axis(label, [value - error, value + error, np.zeros(1)])
    r = profile.range / 1e3
    band = Band(r, value - error, value + error, upright=True)
    return Panel(x, y, (band, Curve(value, r)), _HEIGHT)


FIGURES: Final = KindFigures(
    (
        *(image_view("raman", name, image) for name, image in _IMAGES.items()),
        View("profile", ("time", "range", *_ALONG_BOTH), _read, _draw, first=True),
    ),
    preferred="aerosol_extinction",
    values=(
        Quantity("aerosol_extinction", _MEGA, "Mm⁻¹"),
        Quantity("aerosol_backscatter", _MEGA, "Mm⁻¹ sr⁻¹"),
        Quantity("lidar_ratio", 1.0, "sr"),
    ),
)

"""The figures of the ``elastic`` product: an image of backscatter, and a profile with errors."""

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
    Layer,
    Mark,
    Panel,
    decade_axis,
    percentile_axis,
    span_in_words,
)
from lidarops.figures.series_data import require
from lidarops.figures.series_panels import Quantity
from lidarops.figures.wording import utc
from lidarops.kinds import flags_of

Floats = NDArray[np.float64]

CAUSES: Final = {
    "noise": "noise",
    "background": "background",
    "reference": "reference",
    "lidar_ratio": "lidar ratio",
    "molecular": "molecules",
    "dead_time": "dead time",
    "baseline": "baseline",
}
"""Causes of backscatter errors, as in the names of variables, in words."""

_ALONG_TIME: Final = ("time", "reference_bottom", "reference_top")
_ALONG_BOTH: Final = (
    "aerosol_backscatter",
    "aerosol_backscatter_standard_error",
    "quality_flag",
    *(f"aerosol_backscatter_error_{cause}" for cause in CAUSES),
)
PROFILE_VARIABLES: Final = (
    *_ALONG_TIME,
    "range",
    "molecular_backscatter",
    "lidar_ratio",
    *_ALONG_BOTH,
)
"""Variables that `clearest_profile` needs."""
_REJECTED: Final = flags_of("elastic").rejecting
_WITH_CARE: Final = flags_of("elastic").caring
_BEYOND: Final = 1.15
"""A profile is shown to this many times the top of its reference window."""


@dataclass(frozen=True, slots=True)
class Profile:
    """A mean backscatter profile with its error budget, to just beyond the reference."""

    time: np.datetime64
    """UTC."""
    range: Floats
    """m."""
    backscatter: Floats
    """m-1 sr-1; NaN where rejected."""
    standard_error: Floats
    budget: dict[str, Floats]
    """Absolute error from each of `CAUSES`, m-1 sr-1."""
    molecular: Floats
    """m-1 sr-1."""
    with_care: NDArray[np.bool_]
    reference: tuple[float, float]
    """m."""
    lidar_ratio: tuple[float, float]
    """sr, least and largest."""


def clearest_profile(product: xr.Dataset) -> Profile | None:
    """Return the profile with the most unflagged bins below its reference.

    Parameters
    ----------
    product : Dataset
        Kind ``elastic``.

    Returns
    -------
    Profile or None
        The first among equals; None if no profile has a reference and an unflagged bin.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(
        product,
        dict.fromkeys(_ALONG_TIME, ("time",))
        | dict.fromkeys(("range", "molecular_backscatter", "lidar_ratio"), ("range",))
        | dict.fromkeys(_ALONG_BOTH, ("time", "range")),
    )
    r = product["range"].values.astype(np.float64)
    top = product["reference_top"].values.astype(np.float64)
    flag = product["quality_flag"].values.astype(np.int64)
    below = r[np.newaxis, :] <= np.nan_to_num(top)[:, np.newaxis]
    clear = ((flag == 0) & below).sum(axis=1)
    if not np.any(np.isfinite(top)) or clear.max() == 0:
        return None
    index = int(np.argmax(clear))
    shown = r <= _BEYOND * top[index]
    profile = product.isel(time=index, range=shown)
    bits = flag[index, shown]
    rejected = (bits & _REJECTED) != 0

    def values(name: str) -> Floats:
        return np.where(rejected, np.nan, profile[name].values.astype(np.float64))

    return Profile(
        time=product["time"].values.astype("datetime64[ns]")[index],
        range=r[shown],
        backscatter=values("aerosol_backscatter"),
        standard_error=values("aerosol_backscatter_standard_error"),
        budget={cause: np.abs(values(f"aerosol_backscatter_error_{cause}")) for cause in CAUSES},
        molecular=profile["molecular_backscatter"].values.astype(np.float64),
        with_care=(bits & _WITH_CARE) != 0,
        reference=(float(profile["reference_bottom"]), float(top[index])),
        lidar_ratio=(float(profile["lidar_ratio"].min()), float(profile["lidar_ratio"].max())),
    )


_UNIT: Final = "Mm⁻¹ sr⁻¹"
_MEGA: Final = 1e6
_HEIGHT: Final = 366
_IMAGES: Final = {
    "aerosol_backscatter": ImageQuantity(
        "aerosol backscatter", _MEGA, _UNIT, (0.01, 10.0), background=False
    ),
    "aerosol_extinction": ImageQuantity(
        "aerosol extinction", _MEGA, "Mm⁻¹", (1.0, 1000.0), background=False
    ),
    "attenuated_backscatter": ImageQuantity("attenuated backscatter", _MEGA, _UNIT, (0.1, 100.0)),
}
"""Images by variable; colours from background aerosol to dust and cirrus. The attenuated
backscatter holds that of molecules, about 1 Mm-1 sr-1 near the ground at 532 nm."""


def _read(product: xr.Dataset, _: ProductSource) -> Profile | None:
    return clearest_profile(product)


def _draw(profiles: Sequence[Profile]) -> list[Figure]:
    """Return a backscatter profile with its standard error, and its error budget."""
    profile = profiles[0]
    r = profile.range / 1e3
    y = Axis("range (km)", float(r.min()), float(r.max()))
    bottom, top = (f"{edge / 1e3:.3g}" for edge in profile.reference)
    reach = span_in_words(_MEGA * profile.backscatter, _UNIT)
    ratio = " to ".join(dict.fromkeys(f"{value:g}" for value in profile.lidar_ratio))
    words = (
        f"Particle backscatter {reach}, lidar ratio {ratio} sr, reference window"
        f" {bottom} to {top} km; the band is the standard error"
    )
    caption = f"Profile at {utc(profile.time)} (most unflagged bins) and its error budget"
    panels = (_backscatter(profile, y), _error_budget(profile, y))
    return [Figure(caption, words, panels, beside=True)]


def _backscatter(profile: Profile, y: Axis) -> Panel:
    r = profile.range / 1e3
    value, error, molecular = (
        _MEGA * values
        for values in (profile.backscatter, profile.standard_error, profile.molecular)
    )
    x = percentile_axis(
        f"backscatter ({_UNIT})", [value - error, value + error, molecular, np.zeros(1)]
    )
    layers: list[Layer] = [
        _reference(profile, x),
        Band(r, value - error, value + error, upright=True),
        Curve(value, r, label="particles"),
        Curve(molecular, r, "c1 d2", label="molecules"),
    ]
    care = np.flatnonzero(profile.with_care & np.isfinite(value))[::10]
    if care.size:
        marks = Curve(
            value[care], r[care], "ink hollow", Mark.DISC, joined=False, label="use with care"
        )
        layers.append(marks)
    return Panel(x, y, tuple(layers), _HEIGHT)


def _error_budget(profile: Profile, y: Axis) -> Panel:
    error = _MEGA * profile.standard_error
    causes = {name: _MEGA * values for name, values in profile.budget.items()}
    x = decade_axis(f"error of backscatter ({_UNIT})", [*causes.values(), error])
    lines = [
        Curve(values, profile.range / 1e3, f"c{number} d{number}", label=CAUSES[name])
        for number, (name, values) in enumerate(causes.items())
    ]
    total = Curve(error, profile.range / 1e3, "ink thick", label="total")
    return Panel(x, y, (_reference(profile, x), *lines, total), _HEIGHT)


def _reference(profile: Profile, x: Axis) -> Band:
    """Return the band of the reference window."""
    along = np.array([x.low, x.high])
    bottom, top = (np.full(2, edge / 1e3) for edge in profile.reference)
    return Band(along, bottom, top, "soft wide")


FIGURES: Final = KindFigures(
    (
        *(image_view("elastic", name, image) for name, image in _IMAGES.items()),
        View(
            "profile",
            PROFILE_VARIABLES,
            _read,
            _draw,
            first=True,
        ),
    ),
    preferred="aerosol_backscatter",
    values=(
        Quantity("aerosol_backscatter", _MEGA, _UNIT),
        Quantity("aerosol_extinction", _MEGA, "Mm⁻¹"),
    ),
)

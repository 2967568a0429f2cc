"""The backscatter profile of an elastic product that is drawn, with its error budget."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.series_data import require
from lidarops.kinds import flags_of

Floats = NDArray[np.float64]

CAUSES: Final = (
    "noise", "background", "reference", "lidar_ratio", "molecular", "dead_time", "baseline",
)  # fmt: skip
"""Causes of backscatter errors, as in the names of variables."""

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

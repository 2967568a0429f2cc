"""What people call a product: by its attributes and the channel that it states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from lidarops.records import GLUED, is_glued

if TYPE_CHECKING:
    import xarray as xr

    from lidarops.netcdf.stored import StoredProduct

UNKNOWN: Final = "unknown"


def attribute(product: xr.Dataset | StoredProduct, name: str, default: str = UNKNOWN) -> str:
    """Return a global attribute as text."""
    return str(product.attrs.get(name, "")).strip() or default


def light_in_words(product: xr.Dataset) -> str:
    """Return wavelength, detection and name of the channel in words; empty if unknown.

    The name tells polarisations and telescopes apart.
    """
    wavelength = scalar(product, "wavelength")
    units = "" if wavelength is None else product.variables["wavelength"].attrs["units"]
    words = "" if wavelength is None else f"{wavelength:g} {units}"
    channel = attribute(product, "lidarops_channel", "")
    glued = is_glued(channel)
    mode = _DETECTION.get(GLUED if glued else attribute(product, "lidarops_detection_mode"), "")
    name = f"({channel})" if words and channel else ""
    return " ".join(filter(None, (", ".join(filter(None, (words, mode))), name)))


_DETECTION: Final = {
    "photon": "photon counting",
    "analog": "analog",
    GLUED: "analog glued to photon counting",
}


def scalar(product: xr.Dataset, name: str) -> float | None:
    """Return a variable that is one finite number; None without it."""
    stored = product.variables.get(name)
    if stored is None or stored.ndim or "units" not in stored.attrs:
        return None
    value = stored.values.astype(np.float64).item()
    return float(value) if np.isfinite(value) else None

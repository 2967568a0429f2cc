"""Quantities as people write them: ``532 nm``, ``4 ns``, ``30 min``, ``5 %``; inside all are SI."""

from __future__ import annotations

import math
import re
from decimal import Decimal
from typing import Final

PATTERN: Final = r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*?)\s*"
"""Regular expression of a number and what is behind it."""
_QUANTITY: Final = re.compile(PATTERN, re.ASCII)
_FACTORS: Final = {
    "m": {
        "nm": "1e-9", "um": "1e-6", "mm": "1e-3", "cm": "1e-2", "m": "1", "km": "1e3",
        "meters": "1", "metres": "1",
    },
    "nm": {"nm": "1", "um": "1e3", "m": "1e9"},
    "s": {
        "ns": "1e-9", "us": "1e-6", "ms": "1e-3", "s": "1", "min": "60", "h": "3600", "d": "86400",
        "seconds": "1", "minute": "60", "minutes": "60", "hour": "3600", "hours": "3600",
        "day": "86400", "days": "86400",
    },
    "h": {"min": "0.016666666666666666", "h": "1", "d": "24"},
    "m-1": {"m-1": "1", "km-1": "1e-3", "Mm-1": "1e-6"},
    "h-1": {"h-1": "1"},
    "degree": {"degree": "1", "degrees": "1", "deg": "1", "°": "1", "mrad": "0.0572957795130823"},
    "sr": {"sr": "1"},
    "V": {"V": "1", "mV": "1e-3"},
    "mV": {"uV": "1e-3", "mV": "1", "V": "1e3"},
    "Hz": {"Hz": "1", "kHz": "1e3", "MHz": "1e6"},
    "MHz": {"Hz": "1e-6", "kHz": "1e-3", "MHz": "1", "GHz": "1e3"},
    "J": {"mJ": "1e-3", "J": "1"},
    "Pa": {"Pa": "1", "hPa": "1e2", "mbar": "1e2"},
    "K": {"K": "1"},
    "m s-1": {"m s-1": "1", "km h-1": "0.2777777777777778"},
    "kg kg-1": {"kg kg-1": "1", "g kg-1": "1e-3"},
    "1": {"%": "0.01"},
    "bins": {"bins": "1"},
}  # fmt: skip
"""Unit of a setting -> units in which it can be written, and their factors."""
_SMALL: Final = {"s": (1e-6, "ns"), "m": (1e-4, "nm")}
"""Unit -> below which values are written in a smaller one."""


def is_quantity(text: str) -> bool:
    """Return whether a text is a number with something behind it, which may be a unit."""
    return _found(text) is not None


def _found(text: str) -> re.Match[str] | None:
    return _QUANTITY.fullmatch(text.replace("\N{MINUS SIGN}", "-"))


def parse_quantity(text: str, unit: str) -> float | None:
    """Return the value of a text such as ``4 ns`` in a unit such as ``s``.

    None where the text is no finite number with a unit of that dimension. ``km^-1`` and ``/km`` are
    ``km-1``.
    """
    found = _found(text)
    if found is None:
        return None
    name = " ".join(found[2].replace("µ", "u").replace("μ", "u").replace("^", "").split())
    if "/" in name:
        above, _, below = name.partition("/")
        name = f"{above.strip()} {below.strip()}-1".strip()
    factor = _FACTORS.get(unit, {}).get(name)
    if factor is None or not math.isfinite(float(found[1])):
        return None
    # Decimal: 532 nm are 5.32e-7 m, to the last bit.
    return float(Decimal(found[1]) * Decimal(factor))


def is_small(value: float, unit: str) -> bool:
    """Return whether people write a value in a smaller unit."""
    return unit in _SMALL and 0.0 < abs(value) < _SMALL[unit][0]


def written(value: float, unit: str) -> str:
    """Return a value with its unit as people write it: ``4 ns`` for 4e-9 s."""
    if is_small(value, unit):
        small = _SMALL[unit][1]
        value, unit = float(Decimal(repr(value)) / Decimal(_FACTORS[unit][small])), small
    return f"{value:.6g} {unit}".rstrip()

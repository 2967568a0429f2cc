"""Measured shares of false values, in the words of comments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from lidarops.netcdf.measured_shares import SHARES

NAMED: Final = 0.5
"""Percent above which a class is named: the target of ``lidarops bench stability``."""


def percent(quantity: str, name: str) -> str:
    """Return the share of a class, as "3 percent", to the decade of its standard error.

    Parameters
    ----------
    quantity, name : str
        Of `SHARES`.
    """
    value, error = SHARES[quantity, name]
    return f"{round(value, -math.floor(math.log10(error))):g} percent"


def by_class(quantity: str, words: Mapping[str, str]) -> str:
    """Return the shares of the classes above `NAMED`, and a limit of all others.

    The limit is 2 standard errors above the shares, rounded up.

    Parameters
    ----------
    quantity : str
    words : mapping of str
        Class to its words, such as "with a plume".
    """
    shares = {name: SHARES[quantity, name] for name in words}
    classes = sorted(shares, key=lambda name: shares[name], reverse=True)
    named = [name for name in classes if shares[name][0] > NAMED]
    rest = [value + 2.0 * error for value, error in shares.values() if value <= NAMED]
    limit = math.ceil(10.0 * max(rest, default=0.0)) / 10.0
    parts = [f"{percent(quantity, name)} {words[name]}" for name in named]
    return ", ".join([*parts, f"at most {limit:g} percent otherwise"])

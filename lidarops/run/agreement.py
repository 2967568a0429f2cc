"""Compare the products of channels that measure the same: detections and polarisations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr

from lidarops.kinds import kinds
from lidarops.netcdf.read import open_product
from lidarops.records import Disagreement, ProductRecord

_MOST_DEVIATION: Final = 4.0
"""Standard errors of a difference beyond which noise does not explain it: 6e-5 of normal ones."""
_REJECTED: Final = 2
"""Value of ``usable``."""


def find_disagreements(products: Sequence[ProductRecord], root: Path) -> tuple[Disagreement, ...]:
    """Return the channels of a scene whose products disagree about what they measure alike.

    Differences are averaged over the times of the scene at which both values are usable. So are
    their errors, because those of inhomogeneous air are common to all times.

    Parameters
    ----------
    products : sequence of ProductRecord
        Of one scene.
    root : Path
        Of all products.
    """
    disagreements: list[Disagreement] = []
    for kind in kinds().values():
        of_kind = {p.channel: root / p.path for p in products if p.kind == kind.name}
        if kind.common and len(of_kind) > 1:
            disagreements += _name_outliers(list(_compare(kind.name, kind.common, of_kind)))
    return tuple(disagreements)


def _compare(kind: str, common: tuple[str, str], paths: dict[str, Path]) -> Iterator[Disagreement]:
    """Yield the pairs of channels of a wavelength that disagree."""
    variable, along = common
    profiles = {channel: _usable_values(path, variable, along) for channel, path in paths.items()}
    for pair in combinations(profiles, 2):
        first, second = xr.align(*(profiles[channel] for channel in pair), join="inner")
        if first["wavelength"] != second["wavelength"] or not first[along].size:
            continue
        difference = first["value"] - second["value"]
        error = ((first["error"] ** 2 + second["error"] ** 2) ** 0.5).where(difference.notnull())
        deviation = abs(difference.mean("time") / error.mean("time")).fillna(0.0)
        largest = deviation[int(deviation.to_numpy().argmax())]
        if largest > _MOST_DEVIATION:
            yield Disagreement(kind, pair, "", float(largest[along]), float(largest))


def _usable_values(path: Path, variable: str, along: str) -> xr.Dataset:
    names = (variable, f"{variable}_standard_error")
    with open_product(path, (*names, along, "time", "usable", "wavelength")) as product:
        usable = product["usable"].load() < _REJECTED
        value, error = (product[name].astype(np.float64).where(usable) for name in names)
        wavelength = float(product["wavelength"])
        return xr.Dataset({"value": value, "error": error, "wavelength": wavelength}).load()


def _name_outliers(pairs: list[Disagreement]) -> list[Disagreement]:
    """Return the pairs with the channel that takes part in most of them, if it is one."""
    often = Counter(channel for pair in pairs for channel in pair.channels).most_common(2)
    if len(pairs) < 2 or often[0][1] == often[1][1]:
        return pairs
    outlier = often[0][0]
    return [replace(p, outlier=outlier) if outlier in p.channels else p for p in pairs]

"""Compare the products of channels that measure the same: detections and polarisations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import nullcontext, suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr
from scipy.special import ndtri

from lidarops.errors import ProductError
from lidarops.flags import Severity
from lidarops.kinds import kinds
from lidarops.netcdf.context import path_of_product
from lidarops.netcdf.read import open_product
from lidarops.records import Disagreement, ProductRecord, Scene
from lidarops.steps.dependence import ProductKey

_FALSE_ALARM: Final = 1e-3
"""Probability that noise makes a pair of channels disagree, at all places of a profile together.

Chosen: three channels, which are 3 pairs, give one false alarm in 333 scenes, about a year of days.
"""


def find_disagreements(
    products: Sequence[ProductRecord], scene: Scene, requested: Sequence[ProductKey], root: Path
) -> tuple[Disagreement, ...]:
    """Return the channels of a scene whose products disagree about what they measure alike.

    New products are compared with each other and with those of other channels of the scene, which
    may be older. Differences are averaged over the times at which both values are usable. So are
    their errors, because those of inhomogeneous air are common to all times. Older files that
    cannot be read are left out.

    Parameters
    ----------
    products : sequence of ProductRecord
        New products of the scene.
    scene : Scene
    requested : sequence of (str, str)
        Kind and channel of its new and older products; some may not be made.
    root : Path
        Of all products.

    Raises
    ------
    ProductError
        If a new product cannot be read.
    """
    disagreements: list[Disagreement] = []
    for kind in kinds().values():
        new = {product.channel for product in products if product.kind == kind.name}
        if kind.common and new:
            names = [channel for name, channel in requested if name == kind.name]
            paths = {name: root / _path(scene, kind.name, name) for name in names}
            pairs = _name_outliers(list(_compare(kind.name, kind.common, paths, new)))
            # Pairs of two older products were reported when these were made.
            disagreements += [pair for pair in pairs if new & set(pair.channels)]
    return tuple(disagreements)


def _path(scene: Scene, kind: str, channel: str) -> str:
    names = (scene.station, scene.instrument, kind, channel)
    return path_of_product(names, scene.id, scene.start)


def _compare(
    kind: str, common: tuple[str, str], paths: Mapping[str, Path], new: Set[str]
) -> Iterator[Disagreement]:
    """Yield the pairs of channels of a wavelength that disagree."""
    variable, along = common
    profiles = {}
    for channel, path in paths.items():
        with nullcontext() if channel in new else suppress(ProductError):
            profiles[channel] = _usable_values(path, variable, along)
    for pair in combinations(profiles, 2):
        first, second = xr.align(*(profiles[channel] for channel in pair), join="inner")
        if first["wavelength"] != second["wavelength"] or not first[along].size:
            continue
        difference = first["value"] - second["value"]
        error = ((first["error"] ** 2 + second["error"] ** 2) ** 0.5).where(difference.notnull())
        deviation = abs(difference.mean("time") / error.mean("time")).fillna(0.0)
        largest = deviation[int(deviation.to_numpy().argmax())]
        if largest > -ndtri(0.5 * _FALSE_ALARM / deviation.size):
            yield Disagreement(kind, pair, "", float(largest[along]), float(largest))


def _usable_values(path: Path, variable: str, along: str) -> xr.Dataset:
    names = (variable, f"{variable}_standard_error")
    with open_product(path, (*names, along, "time", "usable", "wavelength")) as product:
        if not {*names, along, "usable", "wavelength"} <= set(product.variables):
            raise ProductError("lacks variables", file=path, field=variable)
        usable = product["usable"].load() < Severity.REJECT
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

"""Compare the products of channels that measure the same: detections and polarisations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import nullcontext, suppress
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr
from scipy.special import ndtri

from lidarops.errors import ProductError
from lidarops.flags import Severity
from lidarops.kinds import CommonQuantity, kinds
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
            pairs = _compare(kind.name, kind.common, paths, new)
            # Pairs of two older products were reported when these were made.
            disagreements += [pair for pair in pairs if new & set(pair.channels)]
    return tuple(disagreements)


def _path(scene: Scene, kind: str, channel: str) -> str:
    names = (scene.station, scene.instrument, kind, channel)
    return path_of_product(names, scene.id, scene.start)


def _compare(
    kind: str, common: CommonQuantity, paths: Mapping[str, Path], new: Set[str]
) -> Iterator[Disagreement]:
    """Yield the pairs of channels of a wavelength that disagree."""
    profiles = {}
    for channel, path in paths.items():
        with nullcontext() if channel in new else suppress(ProductError):
            profiles[channel] = _usable_values(path, common)
    deviations = {}
    for pair in combinations(profiles, 2):
        first, second = xr.align(*(profiles[channel] for channel in pair), join="inner")
        if first["wavelength"] == second["wavelength"] and first[common.along].size:
            difference = first["value"] - second["value"]
            error = _error_of_difference(first, second, common).where(difference.notnull())
            deviations[pair] = abs(difference.mean("time") / error.mean("time")).fillna(0.0)
    for pair, deviation in deviations.items():
        largest = deviation[int(deviation.to_numpy().argmax())]
        if largest > _limit(deviation.size):
            place = float(largest[common.along])
            at_place = {
                others: float(values.where(values[common.along] == place).max())
                for others, values in deviations.items()
            }
            yield Disagreement(kind, pair, _wrong_one(pair, at_place), place, float(largest))


def _limit(places: int) -> float:
    """Return the deviation that noise exceeds at one of some places, standard errors."""
    return -float(ndtri(0.5 * _FALSE_ALARM / places))


def _wrong_one(pair: tuple[str, str], deviations: Mapping[tuple[str, str], float]) -> str:
    """Return the one of a pair that more of the other channels contradict; empty if none is."""
    against = Counter(
        channel
        for others, deviation in deviations.items()
        for channel in set(pair) & set(others)
        if others != pair and deviation > _limit(1)
    )
    first, second = pair
    return "" if against[first] == against[second] else max(pair, key=against.__getitem__)


def _error_of_difference(
    first: xr.Dataset, second: xr.Dataset, common: CommonQuantity
) -> xr.DataArray:
    """Return the standard error of the difference of two channels, of all stated errors."""
    variance = xr.zeros_like(first["value"])
    for name in common.errors:
        if name in common.errors_of_air:
            variance = variance + (first[name] - second[name]) ** 2
        else:
            variance = variance + first[name] ** 2 + second[name] ** 2
    return variance**0.5


def _usable_values(path: Path, common: CommonQuantity) -> xr.Dataset:
    """Return the usable values, with errors; those that a channel does not state are 0."""
    needed = (common.variable, common.errors[0], common.along, "usable", "wavelength")
    with open_product(path, (*needed, *common.errors, "time")) as product:
        if not set(needed) <= set(product.variables):
            raise ProductError("lacks variables", file=path, field=common.variable)
        usable = product["usable"].load() < Severity.REJECT
        value = product[common.variable].astype(np.float64).where(usable)
        errors = {
            name: product[name].astype(np.float64) if name in product else 0.0 * value
            for name in common.errors
        }
        wavelength = float(product["wavelength"])
        return xr.Dataset({"value": value, "wavelength": wavelength, **errors}).load()

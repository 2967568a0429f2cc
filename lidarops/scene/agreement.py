"""Compare the products of channels that measure the same: detections and polarisations."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
import xarray as xr
from scipy.special import ndtri

from lidarops.flags import Quality
from lidarops.kinds import CommonQuantity, flags_of
from lidarops.netcdf.context import Context
from lidarops.records import Disagreement

_FALSE_ALARM: Final = 1e-3
"""Probability that noise makes a pair of channels disagree, at all places of a profile together.

Chosen: three channels, which are 3 pairs, give one false alarm in 333 scenes, about a year of days.
"""


@dataclass(frozen=True, slots=True)
class Retrieved:
    """A product of a kind with a common quantity, before it is written."""

    common: CommonQuantity
    context: Context
    frame: xr.Dataset
    batches: tuple[xr.Dataset, ...]
    """All its rows; see `lidarops.scene.profiles.ProductStream`."""


def compare_channels(
    products: Collection[Retrieved],
) -> tuple[list[Retrieved], tuple[Disagreement, ...]]:
    """Return the products of a scene with bits where channels disagree, and the disagreements.

    Products of one kind and wavelength are compared. Differences are averaged over the times at
    which both values are usable. So are their errors, because those of inhomogeneous air are common
    to all times. Of two channels that disagree, the one that further channels contradict has
    CONTRADICTED where they differ, and DISAGREES at the other places; where none decides, both have
    DISAGREES.
    """
    alike: defaultdict[tuple[str, float], dict[str, Retrieved]] = defaultdict(dict)
    for product in products:
        context = product.context
        alike[context.kind, context.wavelength][context.channel] = product
    judged: list[Retrieved] = []
    found: list[Disagreement] = []
    for (kind, _), channels in alike.items():
        for pair, deviation in _disagreeing(kind, channels):
            found.append(pair)
            wrong = (deviation > _limit(1)) & bool(pair.outlier)
            for name in (pair.outlier,) if pair.outlier else pair.channels:
                channels[name] = _flagged(channels[name], pair, wrong)
        judged += channels.values()
    return judged, tuple(found)


def _flagged(product: Retrieved, pair: Disagreement, wrong: xr.DataArray) -> Retrieved:
    """Return the product of a channel of a pair that states where it is wrong or doubtful."""
    along, frame = product.common.along, product.frame
    wrong = wrong.reindex({along: frame[along]}, fill_value=False)
    either = np.where(wrong, np.int32(Quality.CONTRADICTED), np.int32(Quality.DISAGREES))
    bits = wrong.copy(data=either)
    words = "; ".join(filter(None, (frame.attrs.get("steps"), f"agreement: {pair.words}")))
    batches = tuple(
        _without_layers(rows, wrong).assign(quality_flag=rows["quality_flag"] | bits)
        for rows in product.batches
    )
    return replace(product, frame=frame.assign_attrs(steps=words), batches=batches)


def _without_layers(rows: xr.Dataset, wrong: xr.DataArray) -> xr.Dataset:
    """Return rows without the values of layers that begin or end at a wrong value."""
    if "layer_bnds" not in rows:
        return rows
    bounds = rows["layer_bnds"]
    at_bounds = wrong.reindex({wrong.dims[0]: bounds.to_numpy().ravel()}, fill_value=False)
    hidden = at_bounds.to_numpy().reshape(bounds.shape).any(axis=1)
    layers = [name for name, array in rows.items() if array.dims == ("time", "layer")]
    return rows.assign({name: rows[name].where(~hidden) for name in layers})


def _disagreeing(
    kind: str, channels: Mapping[str, Retrieved]
) -> Iterator[tuple[Disagreement, xr.DataArray]]:
    """Yield the pairs of channels that disagree, and their deviations along the profile."""
    profiles = {name: _usable_values(product) for name, product in channels.items()}
    common = next(iter(channels.values())).common
    deviations = {}
    for pair in combinations(profiles, 2):
        first, second = xr.align(*(profiles[channel] for channel in pair), join="inner")
        if first[common.along].size:
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
            wrong = _wrong_one(pair, at_place)
            yield Disagreement(kind, pair, wrong, place, float(largest)), deviation


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
    """Return the standard error of the difference of two channels, of all stated errors.

    Both see the same air. A channel with less noise weighs beams otherwise, and polarisations
    differ: the smaller part of the air remains. The larger one may be a distorted signal.
    """
    variance = xr.zeros_like(first["value"])
    for name in common.errors:
        if name in common.errors_of_air:
            variance = variance + (first[name] - second[name]) ** 2
        else:
            variance = variance + first[name] ** 2 + second[name] ** 2
    for name in common.parts_of_air:
        variance = variance - np.maximum(first[name], second[name]) ** 2
    return variance**0.5


def _usable_values(product: Retrieved) -> xr.Dataset:
    """Return the usable values, with errors; those that a channel does not state are 0."""
    common, batches = product.common, product.batches
    errors = (*common.errors, *common.parts_of_air)
    needed = {common.variable, *errors, "quality_flag"} & set(batches[0])
    rows = xr.concat([batch[sorted(needed)] for batch in batches], "time")
    usable = (rows["quality_flag"] & flags_of(product.context.kind).rejecting) == 0
    value = rows[common.variable].where(usable)
    known = {name: rows.get(name, xr.zeros_like(value)) for name in errors}
    return xr.Dataset({"value": value, **known})

"""The product ``averaged``: its decision, and its making from the product ``signal``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import xarray as xr

from lidar_extras.averaged import AveragedSettings
from lidarops.scene.case import REQUESTED, ChannelCase, Entries, NoSettings
from lidarops.scene.profiles import in_one_batch
from lidarops.scene.retrieval import Derivation, InputProduct
from lidarops.settings import SettingsModel

BINS: Final = ("time", "range")
GEOMETRY: Final = ("time", "time_bnds", "range", "zenith_angle", "azimuth")


class AveragedPlan(SettingsModel):
    """What a plan states of a product."""

    averaged: NoSettings


def needs(case: ChannelCase[AveragedSettings]) -> Entries:
    """Average over the scene, always."""
    yield case.run("averaged", REQUESTED)


def derive(_: AveragedPlan, products: Sequence[InputProduct]) -> Iterator[xr.Dataset]:
    """Yield the mean of the one product that is read."""
    (signal,) = products
    with signal.open((*GEOMETRY, "signal", "quality_flag")) as product:
        bits = np.bitwise_or.reduce(product["quality_flag"].to_numpy(), axis=0)
        limits = product["time_bnds"].to_numpy()
        begin, end = limits.min(), limits.max()
        mean = xr.Dataset(
            {
                "mean_signal": (BINS, product["signal"].mean("time").to_numpy()[np.newaxis]),
                "quality_flag": (BINS, bits[np.newaxis]),
            },
            {
                "time": [begin + (end - begin) / 2],
                "time_bnds": (("time", "nv"), [[begin, end]]),
                "range": product["range"].load(),
                **{name: product[name].load() for name in GEOMETRY[3:] if name in product},
            },
        )
    yield from in_one_batch(mean)


RETRIEVAL: Final = Derivation(settings=AveragedPlan, needs=needs, derive=derive)

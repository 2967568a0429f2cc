"""The product ``monthly``: its decision, and its making from the products of a month."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import xarray as xr

from lidar_extras.averaged.retrieval import GEOMETRY
from lidar_extras.monthly import MonthlySettings
from lidarops.scene.case import REQUESTED, ChannelCase, Entries, NoSettings
from lidarops.scene.profiles import in_one_batch
from lidarops.scene.retrieval import Derivation, InputProduct
from lidarops.settings import SettingsModel


class MonthlyPlan(SettingsModel):
    """What a plan states of a product."""

    monthly: NoSettings


def needs(case: ChannelCase[MonthlySettings]) -> Entries:
    """Join the products of the month, always."""
    yield case.run("monthly", REQUESTED)


def _read(product: InputProduct) -> xr.Dataset:
    with product.open((*GEOMETRY, "mean_signal", "quality_flag")) as opened:
        return opened.load().set_coords([name for name in GEOMETRY if name in opened])


def derive(_: MonthlyPlan, products: Sequence[InputProduct]) -> Iterator[xr.Dataset]:
    """Yield the products of the month, one row each."""
    rows = xr.concat(map(_read, products), "time", data_vars="minimal", coords="minimal")
    yield from in_one_batch(rows)


RETRIEVAL: Final = Derivation(settings=MonthlyPlan, needs=needs, derive=derive)

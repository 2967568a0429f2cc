"""Product kind ``monthly``: the products ``averaged`` of a month, as a time series."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.settings import MonthProduct


class MonthlySettings(MonthProduct):
    """The ``monthly`` product: the mean signals of a month."""


KIND: Final = Kind(
    name="monthly",
    title="Mean signals of months",
    package=__name__,
    settings=MonthlySettings,
    rank=97,
    expects_usable=False,
    reads=("averaged",),
)

"""Product kind ``averaged``: the mean of the product ``signal`` of the same scene."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.settings import ChannelProduct


class AveragedSettings(ChannelProduct):
    """The ``averaged`` product: the mean signal of a scene."""


KIND: Final = Kind(
    name="averaged",
    title="Mean signals of scenes",
    package=__name__,
    settings=AveragedSettings,
    rank=96,
    expects_usable=False,
    reads=("signal",),
)

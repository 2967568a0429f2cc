"""Product kind ``signal``: background-subtracted, range-corrected signals."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import Kind
from lidarops.products.signal.settings import SignalSettings

KIND: Final = Kind(
    name="signal",
    title="Range-corrected signals",
    package=__name__,
    settings=SignalSettings,
    rank=90,
    expects_usable=False,
)

"""Quality bits that products of kind ``integrated`` can carry."""

from __future__ import annotations

from typing import Final

from lidarops.flags import RAW_BITS, FlagBit, Flags, Quality, Severity


class IntegratedQuality(FlagBit):
    """Bits of integrals over windows."""

    WINDOW_CUT = (
        17,
        Severity.CARE,
        "the window begins before the first bin or ends beyond the last: the integral is over less",
    )


FLAGS: Final = Flags(
    kind="integrated",
    version=1,
    bits=(
        *RAW_BITS,
        Quality.BACKGROUND_UNCERTAIN,
        Quality.NO_GLUING,
        *IntegratedQuality,
    ),
)

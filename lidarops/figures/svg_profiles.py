"""Profiles against range or altitude, in two panels side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.svg import LEFT, RIGHT, WIDTH, Scale, SvgPanel

Floats = NDArray[np.float64]

_TOP: Final = 44
_FOOT: Final = 410
HEIGHT: Final = 456
_MIDDLE: Final = (WIDTH + LEFT - RIGHT) / 2


def panels(height: Floats, spans: Sequence[tuple[float, float]], *, log: bool) -> list[SvgPanel]:
    """Return two panels over the same heights, km; the second is logarithmic if `log`."""
    low, high = float(height.min()), float(height.max())
    y = (low, high if high > low else low + 1.0, _FOOT, _TOP)
    ends = ((LEFT, _MIDDLE - 36), (_MIDDLE + 36, WIDTH - RIGHT))
    return [
        SvgPanel(Scale(*span, *end, log=log and number == 1), Scale(*y))
        for number, (span, end) in enumerate(zip(spans, ends, strict=True))
    ]


def span(values: Sequence[Floats]) -> tuple[float, float]:
    """Return the limits of a linear axis: zero, and the 1st and 99th percentile with a margin."""
    whole = np.concatenate(list(values))
    whole = whole[np.isfinite(whole)]
    if whole.size == 0:
        return 0.0, 1.0
    low, high = (float(level) for level in np.percentile(whole, [1.0, 99.0]))
    room = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return min(low - room, 0.0), high + room


def decades(values: Sequence[Floats]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis, of five decades at most."""
    whole = np.concatenate(list(values))
    whole = whole[np.isfinite(whole) & (whole > 0)]
    if whole.size == 0:
        return 0.1, 1.0
    high = 1.5 * float(whole.max())
    return max(0.7 * float(np.percentile(whole, 2.0)), 1e-5 * high), high

"""Files as archives hold them: truncated, empty, foreign, absurd."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from lidarops.simulate.settings import DamageKind

FOREIGN_NAME: Final = "log.txt"
"""What follows the prefix of the raw files in the name of a foreign file."""

_LOG: Final = "".join(
    f"2000-01-01 {hour:02d}:00:00 laser energy {150 - hour:d} mJ, room {20 + hour % 3:d} C\r\n"
    for hour in range(24)
).encode()


def damaged(kind: DamageKind, content: bytes, random: np.random.Generator) -> bytes:
    """Return the bytes of a raw file after damage.

    Parameters
    ----------
    kind : DamageKind
    content : bytes
        Of a good Licel file.
    random : numpy.random.Generator
        For garbage.
    """
    return _DAMAGE[kind](content, random)


def _truncated(content: bytes, _: np.random.Generator) -> bytes:
    return content[: len(content) * 3 // 5]


def _empty(_: bytes, __: np.random.Generator) -> bytes:
    return b""


def _garbage(content: bytes, random: np.random.Generator) -> bytes:
    return random.bytes(len(content))


def _negative_bins(content: bytes, _: np.random.Generator) -> bytes:
    return re.sub(rb"(\r\n [01] \d \d )\d{5} ", rb"\g<1>-0005 ", content, count=1)


def _impossible_position(content: bytes, _: np.random.Generator) -> bytes:
    # Impossible in either order of the coordinates.
    place = rb"(:\d\d \d\d/\d\d/\d{4} \d\d:\d\d:\d\d \S+) \S+ \S+"
    return re.sub(place, rb"\g<1> 0987.6 0765.4", content, count=1)


def _foreign(_: bytes, __: np.random.Generator) -> bytes:
    return _LOG


def _no_final_newline(content: bytes, _: np.random.Generator) -> bytes:
    return content.removesuffix(b"\r\n")


_DAMAGE: Final[Mapping[DamageKind, Callable[[bytes, np.random.Generator], bytes]]] = {
    DamageKind.TRUNCATED: _truncated,
    DamageKind.EMPTY: _empty,
    DamageKind.GARBAGE: _garbage,
    DamageKind.NEGATIVE_BINS: _negative_bins,
    DamageKind.IMPOSSIBLE_POSITION: _impossible_position,
    DamageKind.FOREIGN: _foreign,
    DamageKind.NO_FINAL_NEWLINE: _no_final_newline,
}

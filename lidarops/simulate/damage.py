"""Damage of raw files as in real archives: truncated, empty, foreign, wrong, or merely odd."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.campaign.simulated_instrument import DamageKind
from lidarops.raw.licel import Dataset, parse_header
from lidarops.records import DetectionMode

FOREIGN_NAME: Final = "log.txt"
"""End of the name of a foreign file, after the prefix of the raw files."""

_Edit = Callable[[bytes, np.random.Generator], bytes]

_LOG: Final = "".join(
    f"2000-01-01 {hour:02d}:00:00 laser energy {150 - hour:d} mJ, room {20 + hour % 3:d} C\r\n"
    for hour in range(24)
).encode()
_SITE: Final = re.compile(rb"(?<=\r\n ).*?(?= \d\d/\d\d/\d{4} )")
_PLACE: Final = re.compile(rb"(:\d\d \d\d/\d\d/\d{4} \d\d:\d\d:\d\d \S+) (\S+ \S+) (\S+)([^\r]*)")
_BINS: Final = re.compile(rb"(\r\n [01] \d \d )(\d{5}) ")
_DATASET: Final = re.compile(rb"(?<=\r\n )[01] \d \d \d{5} [^\r]*")
_STOP: Final = re.compile(rb"(\d\d/\d\d/\d{4} \d\d:\d\d:\d\d) \d\d/\d\d/\d{4} \d\d:\d\d:\d\d")
_SURPLUS: Final = 1000
_TIME: Final = "%d/%m/%Y %H:%M:%S"
_LONG_SITE: Final = b"Demonstration site"


def damage_file(kind: DamageKind, content: bytes, random: np.random.Generator) -> bytes:
    """Return the bytes of a damaged raw file.

    Parameters
    ----------
    kind : DamageKind
        Kinds that only change names (renamed, duplicate) leave the bytes unchanged.
    content : bytes
        A good Licel file.
    random : numpy.random.Generator
        For garbage and the bin of a glitch.
    """
    return _DAMAGE[kind](content, random)


def _unchanged(content: bytes, _: np.random.Generator) -> bytes:
    return content


def _in_header(edit: Callable[[bytes], bytes]) -> _Edit:
    """Return an edit of the file that changes the header text only."""

    def change(content: bytes, _: np.random.Generator) -> bytes:
        start = parse_header(content).data_start
        return edit(content[:start]) + content[start:]

    return change


def _replaced(
    pattern: re.Pattern[bytes], replacement: bytes | Callable[[re.Match[bytes]], bytes]
) -> _Edit:
    """Return an edit of the first match in the header text."""
    return _in_header(lambda header: pattern.sub(replacement, header, count=1))


def _wider(match: re.Match[bytes]) -> bytes:
    after = match[4].split()
    weather = b" 30.0 1013.0" if after else b" 00 30.0 1013.0"
    values = match[4].rstrip() + (b"" if len(after) > 1 else weather)
    return b"%s %s %s%s" % (match[1], match[2], match[3], values.ljust(30))


def _decimal_comma(header: bytes) -> bytes:
    name, _, rest = header.partition(b"\r\n")
    return name + b"\r\n" + re.sub(rb"(?<=\d)\.(?=\d)", b",", rest)


def _replace_token(header: bytes, column: int, token: bytes) -> bytes:
    """Replace one value of every dataset line by another of the same length."""

    def change(match: re.Match[bytes]) -> bytes:
        tokens = match[0].split(b" ")
        tokens[column] = token
        return b" ".join(tokens)

    return _DATASET.sub(change, header)


def _in_counts(edit: Callable[[Dataset, NDArray[np.int32], np.random.Generator], None]) -> _Edit:
    """Return an edit of the file that changes the counts of channels only."""

    def change(content: bytes, random: np.random.Generator) -> bytes:
        changed = bytearray(content)
        for dataset in parse_header(content).datasets:
            counts = np.frombuffer(changed, "<i4", dataset.bins, dataset.offset or 0)
            edit(dataset, counts, random)
        return bytes(changed)

    return change


def _glitch(dataset: Dataset, counts: NDArray[np.int32], random: np.random.Generator) -> None:
    if dataset.full_scale is not None:
        counts[_random_bin(counts, random)] = min(3 * dataset.full_scale, np.iinfo(np.int32).max)


def _largest(_: Dataset, counts: NDArray[np.int32], random: np.random.Generator) -> None:
    counts[_random_bin(counts, random)] = np.iinfo(np.int32).max


def _random_bin(counts: NDArray[np.int32], random: np.random.Generator) -> int:
    # Within the range that retrievals use.
    return int(random.integers(counts.size // 10, counts.size // 4))


def _dead_photon(dataset: Dataset, counts: NDArray[np.int32], _: np.random.Generator) -> None:
    if dataset.mode is DetectionMode.PHOTON:
        counts[:] = 0


def _saturation(dataset: Dataset, counts: NDArray[np.int32], _: np.random.Generator) -> None:
    if dataset.full_scale is not None:
        counts[: counts.size // 4] = dataset.full_scale


def _zero_counts(_: Dataset, counts: NDArray[np.int32], __: np.random.Generator) -> None:
    counts[:] = 0


def _zero_shots(content: bytes, random: np.random.Generator) -> bytes:
    without = _in_counts(_zero_counts)(content, random)
    return _in_header(lambda header: _replace_token(header, 13, b"000000"))(without, random)


def _earlier(match: re.Match[bytes]) -> bytes:
    start = datetime.strptime(match[1].decode(), _TIME)  # noqa: DTZ007 - as written
    return b"%s %s" % (match[1], f"{start - timedelta(seconds=1):{_TIME}}".encode())


_DAMAGE: Final[Mapping[DamageKind, _Edit]] = {
    DamageKind.TRUNCATED: lambda content, _: content[: len(content) * 3 // 5],
    DamageKind.EMPTY: lambda _, __: b"",
    DamageKind.GARBAGE: lambda content, random: random.bytes(len(content)),
    DamageKind.NEGATIVE_BINS: _replaced(_BINS, rb"\g<1>-0005 "),
    DamageKind.TOO_MANY_BINS: _replaced(_BINS, lambda m: b"%s%05d " % (m[1], 2 * int(m[2]))),
    # Impossible in either order of the coordinates.
    DamageKind.IMPOSSIBLE_POSITION: _replaced(_PLACE, rb"\g<1> 0987.6 0765.4 \g<3>\g<4>"),
    DamageKind.FOREIGN: lambda _, __: _LOG,
    DamageKind.SURPLUS: lambda content, random: content + random.bytes(_SURPLUS),
    DamageKind.NO_FINAL_NEWLINE: lambda content, _: content.removesuffix(b"\r\n"),
    DamageKind.GLITCH: _in_counts(_glitch),
    DamageKind.DEAD_PHOTON: _in_counts(_dead_photon),
    DamageKind.LONG_SITE: _replaced(_SITE, _LONG_SITE),
    DamageKind.BLANK_SITE: _replaced(_SITE, lambda site: b" " * len(site[0])),
    DamageKind.ZENITH_MINUS_90: _replaced(_PLACE, rb"\g<1> \g<2> -90\g<4>"),
    DamageKind.WIDE_LINE: _replaced(_PLACE, _wider),
    DamageKind.DECIMAL_COMMA: _in_header(_decimal_comma),
    DamageKind.SATURATION: _in_counts(_saturation),
    DamageKind.ZERO_SHOTS: _zero_shots,
    DamageKind.RENAMED: _unchanged,
    DamageKind.ZERO_VOLTAGE: _in_header(lambda header: _replace_token(header, 5, b"0000")),
    DamageKind.LARGEST_INTEGER: _in_counts(_largest),
    DamageKind.DUPLICATE: _unchanged,
    DamageKind.STOP_BEFORE_START: _replaced(_STOP, _earlier),
    # 89 degrees below the horizon.
    DamageKind.STALE_POINTING: _replaced(_PLACE, rb"\g<1> \g<2> 89.0\g<4>"),
}

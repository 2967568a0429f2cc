"""Bytes as a failing disk or a broken copy leaves them."""

from __future__ import annotations

import random
from collections.abc import Callable

from lidarops.raw import licel

Damage = Callable[[bytes, random.Random], bytes]
"""Content of a file -> damaged content."""

_PAGE = 512


def flip(content: bytes, rng: random.Random) -> bytes:
    """Flip one bit."""
    damaged = bytearray(content)
    damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def zero_page(content: bytes, rng: random.Random) -> bytes:
    """Replace a page by zeros."""
    first = rng.randrange(max(len(content) // _PAGE, 1)) * _PAGE
    return content[:first] + bytes(len(content[first : first + _PAGE])) + content[first + _PAGE :]


def zero_tail(content: bytes, rng: random.Random) -> bytes:
    """Replace the end by zeros."""
    kept = rng.randrange(len(content))
    return content[:kept] + bytes(len(content) - kept)


def truncate(content: bytes, rng: random.Random) -> bytes:
    """Cut the end off."""
    return content[: rng.randrange(len(content) - 2)]


def flip_line_end(content: bytes, rng: random.Random) -> bytes:
    """Flip a bit of a line end between the datasets of a Licel file."""
    header = licel.parse_header(content, file="raw", size=len(content))
    ends = [d.offset + 4 * d.bins for d in header.datasets if d.offset is not None]
    damaged = bytearray(content)
    damaged[rng.choice(ends) + rng.randrange(2)] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def flip_counts(content: bytes, rng: random.Random) -> bytes:
    """Flip a bit of the counts of a Licel file."""
    header = licel.parse_header(content, file="raw", size=len(content))
    return content[: header.data_start] + flip(content[header.data_start :], rng)


OF_ANY_FILE: tuple[Damage, ...] = (flip, zero_page, zero_tail, truncate)
OF_RAW_FILES: tuple[Damage, ...] = (flip_line_end, flip_counts, zero_page, zero_tail, truncate)

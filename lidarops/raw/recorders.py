"""Names of channels, which mean one recorder in all files of an instrument.

A file names its channels by itself: of two telescopes ``analog_532o`` and ``analog_532o_2``, and
the second one ``analog_532o`` when the first is off. Over many files, a name is bound to the
recorder that has it in the files with most recorders of its mode, wavelength and polarisation.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from typing import Any, Final

from lidarops.records import FEWEST_ALIKE, ChannelLayout

POLARISATIONS: Final = {
    "o": "none", "p": "parallel", "s": "perpendicular", "r": "right circular", "l": "left circular"
}  # fmt: skip
_NUMBERED: Final = re.compile(r"([a-z]+_\d+[a-z])_\d+")

Layout = tuple[ChannelLayout, ...]
Recorder = tuple[str, str, int]
"""Label and recorder, such as ``("analog_532o", "BT5", 0)``, and the number among such channels of
a file. A format without recorders gives the whole name."""
Names = Mapping[Recorder, str]


def label_of(channel: str) -> str:
    """Return the mode, wavelength and polarisation in the name of a channel."""
    numbered = _NUMBERED.fullmatch(channel)
    return numbered[1] if numbered else channel


def _recorders(layout: Layout) -> list[Recorder]:
    seen: Counter[tuple[str, str]] = Counter()
    recorders = []
    for channel in layout:
        key = (label_of(channel.name) if channel.recorder else channel.name, channel.recorder)
        recorders.append((*key, seen[key]))
        seen[key] += 1
    return recorders


def recorder_names(
    files: Iterable[tuple[Layout, int, datetime]],
    stated: Mapping[str, str] | None = None,
    bound: Names | None = None,
) -> Names:
    """Return the name of each recorder of an instrument, whatever the order of its files.

    Of the files with most recorders of a label, those that start first count. One file that
    differs from many may be damaged, so that it counts last. `files` are channels as files name
    them, the number of these files, and the start of the first one; `stated` are names that a
    person gave, with their recorders, and `bound` earlier ones. No other recorder has such a name.
    """
    counts: Counter[Any] = Counter()
    starts: dict[Any, datetime] = {}
    for layout, number, start in files:
        key = tuple(zip(_recorders(layout), (channel.name for channel in layout), strict=True))
        counts[key] += number
        starts[key] = min(starts.get(key, start), start)
    many = max(counts.values(), default=0) >= FEWEST_ALIKE
    first: dict[Recorder, Any] = {}
    for key, start in starts.items():
        held = Counter(label for (label, *_), _ in key)
        for recorder, name in key:
            place = (many and counts[key] == 1, -held[recorder[0]], start, key, name)
            first[recorder] = min(first.get(recorder, place), place)
    names = {(label_of(name), recorder, 0): name for name, recorder in (stated or {}).items()}
    # Before all others, and first those whose names no person gave to others.
    given = set(names.values())
    first |= {recorder: (-1, name in given, name) for recorder, name in (bound or {}).items()}
    for recorder in sorted(first.keys() - names.keys(), key=first.__getitem__):
        *_, name = first[recorder]
        number = 2
        while name in names.values():
            name, number = f"{recorder[0]}_{number}", number + 1
        names[recorder] = name
    return names


def named_layout(layout: Layout, names: Names) -> Layout:
    """Return the channels of a file with the names of their recorders, where they have any."""
    bound = zip(layout, _recorders(layout), strict=True)
    return tuple(replace(c, name=names.get(recorder, c.name)) for c, recorder in bound)

"""Formats numbers, names and texts for reports."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

from lidarops.flags import Severity
from lidarops.records import Grade, Measure

if TYPE_CHECKING:
    import numpy as np

    from lidarops.records import Change, Verdicts

SEVERITIES: Final[Mapping[Severity | None, str]] = {
    Severity.REJECT: "do not use",
    Severity.CARE: "use with care",
    None: "unknown",
}
"""What the severity of a quality bit means; None where it is not known."""
_NAMED: Final = 2
"""Most descriptions that `named_shares` names."""
_MOST_NAMES: Final = 8
"""Most names that `listed` lists."""
_HIDDEN: Final = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff"
    "\N{LEFT-TO-RIGHT EMBEDDING}-\N{RIGHT-TO-LEFT OVERRIDE}"
    "\N{LEFT-TO-RIGHT ISOLATE}-\N{POP DIRECTIONAL ISOLATE}]"
)
"""Control characters but the end of a line and the tabulator, bytes of file names that are not
UTF-8, and characters that reorder text."""


def percent(share: float) -> str:
    """Return a share (0 to 1) in percent; only exact 0 and 1 become 0 % and 100 %."""
    if math.isnan(share):
        return "no value"
    number = 100.0 * share
    if 0.0 < number < 0.1:
        return "<0.1 %"
    if 99.9 < number < 100.0:
        return ">99.9 %"
    # Halves are rounded up, whatever the rounding errors of the share.
    tenths = math.floor(10.0 * round(number, 6) + 0.5) / 10.0
    return f"{tenths:.1f} %" if number % 100.0 else f"{number:.0f} %"


def named_shares(counts: Iterable[tuple[str, int]], values: int) -> str:
    """Return the most frequent of some descriptions with their shares, such as why values lack.

    Parameters
    ----------
    counts : iterable of (str, int)
        Descriptions, and the number of values that each concerns; those of none are left out.
    values : int
        Number of all values.
    """
    most = sorted((pair for pair in counts if pair[1]), key=lambda pair: -pair[1])[:_NAMED]
    return "; ".join(f"{words} ({percent(count / values)})" for words, count in most)


def verdicts_in_words(verdicts: Verdicts) -> str:
    """Return the shares of good values, of those to be used with care, and of rejected ones."""
    if not verdicts.values:
        return "no value"
    named = zip(verdicts._fields, verdicts, strict=True)
    return ", ".join(f"{percent(count / verdicts.values)} {word}" for word, count in named)


def change_in_words(change: Change) -> str:
    """Return how a product differs from the one that it replaces, as a phrase."""
    if change.grade is Grade.NONE:
        return "the same"
    if not change.share:
        return "the same values, other texts"
    words = [change.moved] if change.moved else []
    if change.lost:
        words.append(f"{counted(change.lost, 'value')} came or went")
    if change.largest:
        words.append(f"up to {_measured(change)} in {change.variable}")
    if change.flags:
        words.append(f"{counted(change.flags, 'flag')} differ{'s' if change.flags == 1 else ''}")
    return "; ".join([*words, f"{percent(change.share)} of the values differ"])


def _measured(change: Change) -> str:
    """Return the largest difference with what it is measured in."""
    if change.measure is Measure.ERROR:
        return f"{_two_digits(change.largest)} standard errors"
    of = "standard error" if change.measure is Measure.OF_ERROR else "value"
    return f"{_two_digits(100.0 * change.largest)} % of the {of}"


def _two_digits(value: float) -> str:
    """Return a number with two digits, without an exponent below a million."""
    return f"{float(f'{value:.2g}'):g}"


def size(count: float) -> str:
    """Return a number of bytes in decimal units."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000.0:
            return f"{count:.3g} {unit}"
        count /= 1000.0
    return f"{count:,.1f} TB"


def duration(seconds: float) -> str:
    """Return a duration in suitable units."""
    if seconds < 1.0:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def utc(time: np.datetime64) -> str:
    """Return a time to the second."""
    return str(time.astype("datetime64[s]")).replace("T", " ") + " UTC"


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural with an s."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def listed(names: Iterable[str]) -> str:
    """Return sorted names on one line, cut after the first few."""
    ordered = sorted(names)
    more = f" and {len(ordered) - _MOST_NAMES} more" if len(ordered) > _MOST_NAMES else ""
    return ", ".join(ordered[:_MOST_NAMES]) + more


def visible(text: str) -> str:
    """Return text with control characters and invalid bytes shown as escapes."""
    return text if text.isprintable() else _HIDDEN.sub(_escape, text)


def _escape(character: re.Match[str]) -> str:
    return character[0].encode("unicode_escape").decode("ascii")


def decided_on(number: float | None) -> str:
    """Return the number that a rule decided on; empty for None."""
    return "" if number is None else f"{number:.4g}"

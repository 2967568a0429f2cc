"""Quality flags: the bits of ``quality_flag``, with their severity and description.

A value of ``quality_flag`` is a bit mask; 0 means that no test failed. Bits that raw data, signals
and background raise, and that mean the same in every kind of product, are in `Quality`; their
places are the same in all kinds. A retrieval has an enum of its own bits beside it, at places from
`FIRST_OWN` on, which the retrievals of other kinds use for other bits. `Flags` states which bits a
kind of product can carry (``products/KIND/variables.py``). The CF flag attributes follow from that.

Readers of files go by ``flag_masks``, ``flag_meanings`` and ``flag_assessments`` of the file
(`lidarops.netcdf.stored_flags`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple, Self

FIRST_OWN: Final = 17
"""Place of the first bit of a kind's own; the bits of `Quality` have lower places."""
PLACES: Final = 31
"""Places of bits in ``quality_flag``, an int32 that is never negative."""


STANDARD_AIR: Final = (
    "the air is the standard atmosphere, because no source of the campaign holds a profile near"
    " enough in time and place, or above the top of the profile"
)
"""Description of a bit of kinds that need the density of the air."""


class Severity(IntEnum):
    """What a raised bit means for the use of the value."""

    CARE = 1
    """Use with care: the value is valid, but its stated uncertainty may be too small, or as large
    as the value."""
    REJECT = 2
    """Do not use: the value does not represent the named quantity."""

    @property
    def assessment(self) -> str:
        """Word in ``flag_assessments`` of a file, by the data standard of ARM."""
        return "Bad" if self is Severity.REJECT else "Indeterminate"


class Meaning(NamedTuple):
    """What a bit means, apart from its name."""

    severity: Severity
    description: str


def reject(place: int, description: str) -> tuple[int, Severity, str]:
    """Return the member of a `FlagBit` that forbids the use of a value."""
    return place, Severity.REJECT, description


def care(place: int, description: str) -> tuple[int, Severity, str]:
    """Return the member of a `FlagBit` that asks for care."""
    return place, Severity.CARE, description


class FlagBit(IntFlag):
    """Base of enums of quality bits, whose members are given by `reject`, `care`, or their values.

    Places count from 0. Names in lower case are the CF ``flag_meanings``. Members of different
    enums may be the same number: compare them within one kind of product only. A union of members
    of two enums is a mask, which cannot be iterated over: see `Flags.raised`. So is the complement
    of a number, ``~int(bit)``; that of a member lacks the bits of other enums.
    """

    severity: Severity
    description: str
    """As a phrase without a full stop."""
    word: str
    """Name of a single bit in ``flag_meanings``."""

    def __new__(cls, place: int, *_: object) -> Self:
        """Return the bit at a place."""
        bit = int.__new__(cls, 1 << place)
        bit._value_ = 1 << place
        return bit

    def __init__(self, _: int, severity: Severity, description: str) -> None:
        self.severity = severity
        self.description = description
        self.word = str(self.name).lower()


class Quality(FlagBit):
    """Bits that kinds of product share."""

    INPUT_MISSING = reject(0, "the raw data are missing or not finite")
    SATURATED = reject(
        1,
        "the digitiser is at full scale in at least some shots, or the photon counter is"
        " paralysed, or its dead time is not known well enough for its rate",
    )
    PILE_UP = care(
        2,
        "the dead-time effect on the count rate exceeds 10 percent, or 1 percent where the dead"
        " time is unknown",
    )
    INCOMPLETE_OVERLAP = reject(
        3,
        "the range is shorter than that of full overlap between laser beam and telescope field"
        " of view",
    )
    TOO_FEW_BINS = reject(4, "the section has fewer than 8 valid range bins")
    NO_SIGNAL = reject(
        5,
        "the profile contains no backscatter, as of a laser that is off: it is constant, or"
        " shows no light where other profiles of the scene show much, or none of them any",
    )
    LOW_SIGNAL = reject(
        6,
        "the backscatter signal is less than 5 times its standard error, or so small that noise"
        " may have shifted the root of the cubic",
    )
    SINGLE_RECORD = care(
        7,
        "analog detection and photon counting are not glued: one alone gives the signal, as the"
        " other is missing, saturated or too weak, or no range is linear in both",
    )
    NEGATIVE_AMPLITUDE = reject(8, "the fitted amplitude is not positive")
    CONTRADICTED = reject(
        9,
        "the value differs by more than stated errors from another channel that measures the"
        " same, and further channels tell that this one is wrong",
    )
    DISAGREES = care(
        10,
        "another channel that measures the same disagrees by more than stated errors, here or"
        " elsewhere in the profile",
    )
    NOT_HOMOGENEOUS = reject(
        11, "the residuals vary systematically with range: the path is not homogeneous"
    )
    OUTLIER = care(12, "at least one bin deviates by more than 5 standard errors")
    NO_REAL_SOLUTION = reject(13, "the estimating equation has no admissible real root")
    LOW_SIGNAL_TO_NOISE = care(
        14,
        "the value is smaller than its error by noise, dead time and baseline (or another"
        " multiple, by least_signal_to_noise): keep it in means, which would be biased without"
        " such values",
    )
    BACKGROUND_UNCERTAIN = care(
        15,
        "the background may contain signal: signal before the far range implies some there, or"
        " the bins of the background do not look like what its method assumes",
    )
    NO_GLUING = reject(
        16,
        "analog detection and photon counting are not glued, and none alone gives the signal:"
        " their ratio shows that one is not linear or that the lag is wrong, both are too weak,"
        " or the scale of analog detection is not known",
    )


RAW_BITS: Final = (
    Quality.INPUT_MISSING,
    Quality.SATURATED,
    Quality.PILE_UP,
    Quality.INCOMPLETE_OVERLAP,
    Quality.NO_SIGNAL,
)
"""Bits of raw profiles that all kinds pass on."""
SIGNAL_BITS: Final = (
    *RAW_BITS,
    Quality.SINGLE_RECORD,
    Quality.OUTLIER,
    Quality.LOW_SIGNAL_TO_NOISE,
    Quality.BACKGROUND_UNCERTAIN,
    Quality.NO_GLUING,
)
"""Bits of signals that retrievals of profiles pass on."""
WITHHELD: Final = int(
    Quality.INPUT_MISSING
    | Quality.SATURATED
    | Quality.INCOMPLETE_OVERLAP
    | Quality.NO_SIGNAL
    | Quality.NO_GLUING
)
"""Bits of bins that retrievals of profiles do not use."""
COMPARED_BITS: Final = (Quality.CONTRADICTED, Quality.DISAGREES)
"""Bits of kinds of product that state a quantity which channels have in common."""


def rejecting(bits: Iterable[FlagBit]) -> int:
    """Return the union of the bits whose severity is `Severity.REJECT`."""
    return sum({int(bit) for bit in bits if bit.severity is Severity.REJECT})


@dataclass(frozen=True, slots=True)
class Flags:
    """Bits that a kind of product can carry.

    Raises
    ------
    ValueError
        If two bits have one place or name, or a place is not that of a shared or an own bit.
    """

    kind: str
    version: int
    """Raised when a bit gets another place."""
    bits: tuple[FlagBit, ...]
    """Bits of `Quality`, then the kind's own; rising."""
    layout: str = field(init=False)
    """Name of the places, such as ``elastic 2``."""
    rejecting: int = field(init=False)
    """Union of the bits that reject a value."""

    def __post_init__(self) -> None:
        places = [bit.bit_length() - 1 for bit in self.bits]
        right = all(
            place < FIRST_OWN if isinstance(bit, Quality) else FIRST_OWN <= place < PLACES
            for bit, place in zip(self.bits, places, strict=True)
        )
        names = {bit.name for bit in self.bits}
        if not right or places != sorted(set(places)) or len(names) != len(places):
            raise ValueError(
                f"flags of {self.kind}: names and places must differ, and places rise: shared bits"
                f" below {FIRST_OWN}, own bits from {FIRST_OWN} to {PLACES - 1}"
            )
        object.__setattr__(self, "layout", f"{self.kind} {self.version}")
        object.__setattr__(self, "rejecting", rejecting(self.bits))

    def __iter__(self) -> Iterator[FlagBit]:
        """Iterate over the bits, rising."""
        return iter(self.bits)

    def only(self, bits: Iterable[FlagBit]) -> Flags:
        """Return the flags with some of the bits, at the same places."""
        return replace(self, bits=tuple(sorted(bits)))

    def raised(self, value: int) -> tuple[FlagBit, ...]:
        """Return the bits that a value carries; bits that the kind does not have are left out."""
        return tuple(bit for bit in self.bits if value & bit)

    def named(self, word: str) -> FlagBit | None:
        """Return a bit by its name in any case; None if the kind does not have it."""
        return next((bit for bit in self.bits if bit.word == word.lower()), None)


# Meanings that several retrievals give to bits of their own.
POORLY_DETERMINED: Final = Meaning(
    Severity.REJECT,
    "the standard error of extinction exceeds 15 percent of (extinction + 1 / mean range)",
)
POOR_FIT: Final = Meaning(
    Severity.REJECT,
    "the residuals are larger than the stated noise explains (reduced chi-square)",
)
PRIOR_DOMINATED: Final = Meaning(
    Severity.CARE,
    "smoothness or another prior determines the extinction more than the data do",
)
LOW_LEVERAGE: Final = Meaning(
    Severity.CARE,
    "the slant paths differ little, so the result is sensitive to small signal errors",
)

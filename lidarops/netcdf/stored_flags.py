"""Quality bits of a file, by the flag attributes that the file states: places, words, assessments.

Files written by other versions may have a bit at another place than its kind has now, so a number
alone has no meaning. Who goes by the places of now refuses such a file.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.flags import PLACES, Flags, Quality, Severity
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.variables import QUALITY_FLAG, judging
from lidarops.records import Verdicts

if TYPE_CHECKING:
    import xarray as xr

    from lidarops.netcdf.stored import StoredProduct, StoredVariable

Values = NDArray[Any]
READ_VALUES: Final = 2_000_000
"""Most flags in memory."""


@dataclass(frozen=True, slots=True)
class StoredBit:
    """A bit at its place in a file."""

    mask: int
    word: str
    """As in ``flag_meanings``; such as ``bit_20`` where the file does not name it."""
    severity: Severity | None
    """None where neither the file states it nor this version knows the bit."""
    description: str

    @property
    def rejects(self) -> bool:
        """Whether the value must not be used; so where the severity is not known."""
        return self.severity is not Severity.CARE


def stored_bits(attributes: Mapping[str, Any], kind: str | None) -> tuple[StoredBit, ...]:
    """Return all bits of a file's ``quality_flag``, those first that the file names.

    Parameters
    ----------
    attributes : mapping
        Of ``quality_flag``. Without ``flag_masks``, the places are those of now.
    kind : str or None
        Kind of product. Without a known kind, severity is known of shared bits, and of those that
        the file assesses.
    """
    meanings = _meanings(attributes)
    words = tuple(str(attributes.get("flag_assessments", "")).split())
    return _all_bits(None if meanings is None else tuple(meanings.items()), words, kind)


@cache
def _all_bits(
    meanings: tuple[tuple[str, int], ...] | None, words: tuple[str, ...], kind: str | None
) -> tuple[StoredBit, ...]:
    flags = _flags_of_known_kind(kind)
    if meanings is None:
        meanings = tuple((bit.word, int(bit)) for bit in flags or Quality)
    if len(words) not in {0, len(meanings)}:
        raise ProductError("has not one flag_assessments for each bit", field=QUALITY_FLAG)
    assessments = dict(zip((word for word, _ in meanings), words, strict=False))
    named = [_bit(word, mask, flags, assessments.get(word)) for word, mask in meanings]
    stated = sum({bit.mask for bit in named})
    unnamed = (1 << place for place in range(PLACES) if not stated >> place & 1)
    return (*named, *(_bit(f"bit_{places(mask)}", mask, None) for mask in unnamed))


def bits_of(product: xr.Dataset | StoredProduct, name: str = QUALITY_FLAG) -> tuple[StoredBit, ...]:
    """Return all bits of a variable of flags of a product, as `stored_bits`."""
    return stored_bits(product.variables[name].attrs, product.attrs.get("lidarops_kind"))


def flags_names(product: xr.Dataset | StoredProduct) -> list[str]:
    """Return the names of the variables of flags of a product, ``quality_flag`` first."""
    names = [str(name) for name in product.variables if str(name).endswith(QUALITY_FLAG)]
    return sorted(names, key=QUALITY_FLAG.__ne__)


def all_bits(product: xr.Dataset | StoredProduct) -> tuple[StoredBit, ...]:
    """Return the bits of all variables of flags of a product, rising."""
    every = [bit for name in flags_names(product) for bit in bits_of(product, name)]
    # A bit that one variable does not name may be of another.
    found = {bit.mask: bit for bit in sorted(every, key=lambda bit: bit.severity is not None)}
    return tuple(bit for _, bit in sorted(found.items()))


class Judged(NamedTuple):
    """The bits of a quantity, and what they say of it."""

    bits: NDArray[np.int64]
    rejecting: int
    """Union of the bits that reject a value."""

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """Whether a bit rejects the value."""
        return np.asarray((self.bits & self.rejecting) != 0)

    @property
    def with_care(self) -> NDArray[np.bool_]:
        """Whether the value is to be used with care."""
        return np.asarray((self.bits != 0) & ~self.rejected)


def judge(product: xr.Dataset, quantity: str) -> Judged:
    """Return the flags that judge a quantity: no bits without flags of its dimensions."""
    name = judging(quantity, flags_names(product))
    if name not in product or product[name].dims != product[quantity].dims:
        return Judged(np.zeros(product[quantity].shape, dtype=np.int64), 0)
    return Judged(quality_bits(product[name]), rejecting_mask(bits_of(product, name)))


def quality_bits(flags: xr.DataArray | xr.Variable | Values) -> NDArray[np.int64]:
    """Return quality flags as integers; missing flags become `Quality.INPUT_MISSING`."""
    values = np.asarray(flags)
    if values.dtype.kind == "f":
        # Where there are fill values, xarray decodes integers as floats with NaN.
        values = np.where(np.isfinite(values), values, float(Quality.INPUT_MISSING))
    return np.asarray(values, dtype=np.int64)


def blocks(variable: xr.DataArray | xr.Variable | StoredVariable, most: int) -> Iterator[Any]:
    """Yield a variable some rows at a time, at most `most` values but at least a row."""
    return (variable[part] for part in parts(variable, most))


def parts(variable: xr.DataArray | xr.Variable | StoredVariable, most: int) -> Iterator[Any]:
    """Yield indices of some rows of a variable at a time, of `most` values but at least a row."""
    size = math.prod(variable.shape)
    if not variable.shape or not size:
        yield ...
        return
    step = max(1, most * variable.shape[0] // size)
    for first in range(0, variable.shape[0], step):
        yield slice(first, first + step)


def rejecting_mask(bits: Iterable[StoredBit]) -> int:
    """Return the union of the bits that reject a value."""
    return sum(bit.mask for bit in bits if bit.rejects)


class FlagCounter:
    """Counts values of variables of flags by bit, and by what their bits say of them.

    Parameters
    ----------
    rejecting : int
        Union of the bits that reject a value.
    """

    def __init__(self, rejecting: int) -> None:
        self._rejecting = rejecting
        self.carried: Counter[int] = Counter()
        """Numbers of values that carry each of the bits that occur, by the mask of the bit."""
        self.verdicts = Verdicts(0, 0, 0)

    def add(self, values: Values) -> None:
        """Count more values, integers of any shape."""
        unflagged, usable = (
            values.size - int(np.count_nonzero(bits)) for bits in (values, values & self._rejecting)
        )
        good, care, reject = self.verdicts
        care += usable - unflagged
        self.verdicts = Verdicts(good + unflagged, care, reject + values.size - usable)
        # Few bits occur in a product: count only these.
        union = int(np.bitwise_or.reduce(values, axis=None))
        for mask in (1 << place for place in range(PLACES)):
            if union & mask:
                self.carried[mask] += int(np.count_nonzero(values & mask))


def refuse_moved_flags(product: xr.Dataset | StoredProduct) -> None:
    """Refuse a product of a known kind whose flags have bits at other places than now.

    Raises
    ------
    ProductError
        If a bit that the file names has another place, or its kind no longer has it.
    """
    flags = _flags_of_known_kind(product.attrs.get("lidarops_kind"))
    now = {bit.word: int(bit) for bit in flags or ()}
    for name in flags_names(product) if now else ():
        moved = (_meanings(product[name].attrs) or {}).items() - now.items()
        if moved:
            raise ProductError(
                f"has other places of bits than this version: {', '.join(sorted(dict(moved)))}",
                field=name,
                remedy="make the product again: lidarops reprocess",
            )


def places(bits: int) -> str:
    """Return the numbers of bits in words, counted from 0."""
    return ", ".join(str(place) for place in range(PLACES + 1) if bits >> place & 1)


def _flags_of_known_kind(kind: object) -> Flags | None:
    return flags_of(str(kind)) if kind in set(kinds()) else None


def _meanings(attributes: Mapping[str, Any]) -> dict[str, int] | None:
    """Return word -> mask as a file states them; None where it states none."""
    if "flag_masks" not in attributes:
        return None
    masks = np.atleast_1d(attributes["flag_masks"]).tolist()
    words = str(attributes.get("flag_meanings", "")).split()
    if len(masks) != len(words):
        raise ProductError("has not one flag_meanings for each of flag_masks", field=QUALITY_FLAG)
    return dict(zip(words, masks, strict=True))


def _bit(word: str, mask: int, flags: Flags | None, assessment: str | None = None) -> StoredBit:
    stated = next((found for found in Severity if found.assessment == assessment), None)
    known = Quality if flags is None else flags.bits
    bit = next((bit for bit in known if bit.word == word), None)
    if bit is None:
        return StoredBit(mask, word, stated, "bit unknown to this version of lidarops")
    return StoredBit(mask, word, stated or bit.severity, bit.description)

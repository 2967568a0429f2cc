"""The vocabulary of stiff and extreme cases: what is asked, what has to come, what came."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from lidarops.errors import LidarOpsError
from lidarops.flags import Quality

Array = npt.NDArray[np.float64]
Reference = float | Array | Callable[[], "float | Array"]
"""A value to compare with; a function where it is costly."""

REJECTING: Final = int(Quality.rejecting())
_CRASHES: Final = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What must not leave a retrieval, whatever it is given: only errors of ours may."""
_SHOWN: Final = 3
"""Values of an array that are told."""


class Retrieval(StrEnum):
    """What a case is asked of."""

    HOMOGENEOUS = "homogeneous"
    SIGNAL = "signal chain"
    ELASTIC = "elastic"
    MULTIANGLE = "multi-angle"
    MULTIPOSITION = "multi-position"
    FORWARD = "forward model"


def _no_bits() -> npt.NDArray[np.int32]:
    return np.zeros(1, dtype=np.int32)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a retrieval gave: named values, and the quality bits of each of them."""

    values: Mapping[str, Any]
    quality: npt.NDArray[np.int32] = field(default_factory=_no_bits)
    """Bits of `lidarops.flags.Quality`, broadcast against the values."""

    def value(self, name: str) -> Array:
        """Return one of the values."""
        return np.asarray(self.values[name], dtype=np.float64)

    def rejected(self) -> npt.NDArray[np.bool_]:
        """Return where a bit says that the value is not to be used."""
        return np.asarray((self.quality & REJECTING) != 0)


class Expectation(Protocol):
    """What has to come."""

    def told(self) -> str:
        """Return it in words."""

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""


@dataclass(frozen=True, slots=True)
class StiffCase:
    """One stiff or extreme case."""

    name: str
    retrieval: Retrieval
    build: Callable[[], Mapping[str, Any]]
    """Of the arguments."""
    solve: Callable[..., Answer]
    expected: tuple[Expectation, ...]
    """All of these; or that it is refused, which stands alone."""
    finding: str = ""
    """Why it is known not to be met; empty where it is."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """What came of a case."""

    name: str
    retrieval: str
    expected: str
    got: str
    passed: bool
    finding: str


@dataclass(frozen=True, slots=True)
class Refused:
    """An error of ours, of the field that is wrong."""

    kind: type[LidarOpsError]
    field: str | None = None

    def told(self) -> str:
        """Return it in words."""
        return f"{self.kind.__name__}{f' of {self.field}' if self.field else ''}"

    def met(self, _: Answer) -> bool:
        """Return False: an answer is not a refusal."""
        return False

    def got(self, answer: Answer) -> str:
        """Return what came in place of the error."""
        return f"an answer: {', '.join(answer.values)}"

    def raised(self, error: LidarOpsError) -> bool:
        """Return whether it is this error."""
        return isinstance(error, self.kind) and self.field in {None, error.field}


@dataclass(frozen=True, slots=True)
class Near:
    """A value within a tolerance of its reference, everywhere."""

    quantity: str
    reference: Reference
    tolerance: float
    relative: bool = True
    """Whether the tolerance is a share of the reference."""

    def told(self) -> str:
        """Return it in words."""
        share = " relative" if self.relative else ""
        return f"{self.quantity} {spelled(self._truth())} within {self.tolerance:.0e}{share}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        return bool(self._error(answer) <= self.tolerance)

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        value = spelled(answer.value(self.quantity))
        return f"{self.quantity} {value}, off by {self._error(answer):.1e}"

    def _truth(self) -> Array:
        found = self.reference() if callable(self.reference) else self.reference
        return np.asarray(found, dtype=np.float64)

    def _error(self, answer: Answer) -> float:
        truth = self._truth()
        error = np.abs(answer.value(self.quantity) - truth)
        if self.relative:
            error = error / np.abs(truth)
        # A NaN is an error without bound.
        return float(np.max(np.where(np.isnan(error), np.inf, error)))


@dataclass(frozen=True, slots=True)
class Between:
    """A value between two bounds, everywhere."""

    quantity: str
    low: float
    high: float

    def told(self) -> str:
        """Return it in words."""
        return f"{self.quantity} in [{self.low:.3g}, {self.high:.3g}]"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        value = answer.value(self.quantity)
        return bool(np.all((value >= self.low) & (value <= self.high)))

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        return f"{self.quantity} {spelled(answer.value(self.quantity))}"


@dataclass(frozen=True, slots=True)
class Missing:
    """No value, anywhere."""

    quantity: str

    def told(self) -> str:
        """Return it in words."""
        return f"{self.quantity} NaN"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        return bool(np.isnan(answer.value(self.quantity)).all())

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        return f"{self.quantity} {spelled(answer.value(self.quantity))}"


@dataclass(frozen=True, slots=True)
class Raised:
    """At least one of these bits, everywhere (or on a share of the values at least)."""

    bits: Quality
    share: float = 1.0

    def told(self) -> str:
        """Return it in words."""
        part = "" if self.share == 1.0 else f" on {100.0 * self.share:g} % at least"
        if int(self.bits) == REJECTING:
            return f"rejected{part}"
        return f"flag {bits_told(int(self.bits), ' or ')}{part}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        return bool(np.mean((answer.quality & int(self.bits)) != 0) >= self.share)

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        return f"flag {quality_told(answer)}"


@dataclass(frozen=True, slots=True)
class Stands:
    """No bit that rejects (on a share of the values at least)."""

    share: float = 1.0

    def told(self) -> str:
        """Return it in words."""
        part = "" if self.share == 1.0 else f" of {100.0 * self.share:g} % at least"
        return f"not rejected{part}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        return bool(np.mean(~answer.rejected()) >= self.share)

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        return f"flag {quality_told(answer)}"


@dataclass(frozen=True, slots=True)
class Unflagged:
    """No bit at all."""

    def told(self) -> str:
        """Return it in words."""
        return "no flag"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        return not answer.quality.any()

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        return f"flag {quality_told(answer)}"


@dataclass(frozen=True, slots=True)
class Honest:
    """Each value within 4 stated standard errors of the truth, or rejected, or missing."""

    quantity: str
    truth: Reference
    errors: float = 4.0
    valued: float = 0.0
    """Share of the values that must stand."""
    most: float = 0.0
    """Share of those that stand that may be farther off, where they are many."""

    def told(self) -> str:
        """Return it in words."""
        part = f", {100.0 * self.valued:g} % at least with a value" if self.valued else ""
        but = f" but for {100.0 * self.most:g} %" if self.most else ""
        return (
            f"{self.quantity} {spelled(self._truth())} within {self.errors:g} standard"
            f" errors{but}, or flagged{part}"
        )

    def met(self, answer: Answer) -> bool:
        """Return whether an answer is such."""
        _, false, standing = self._judged(answer)
        return false <= self.most and standing >= self.valued

    def got(self, answer: Answer) -> str:
        """Return what came, in the same words."""
        worst, false, standing = self._judged(answer)
        value = spelled(answer.value(self.quantity))
        beyond = f", {100.0 * false:.2g} % beyond {self.errors:g}" if false else ""
        return (
            f"{self.quantity} {value}, {100.0 * standing:.3g} % unflagged, worst {worst:.3g}"
            f" standard errors{beyond}, flag {quality_told(answer)}"
        )

    def _truth(self) -> Array:
        found = self.truth() if callable(self.truth) else self.truth
        return np.asarray(found, dtype=np.float64)

    def _judged(self, answer: Answer) -> tuple[float, float, float]:
        """Return the worst error, the share that is false, and the share that stands."""
        value = answer.value(self.quantity)
        stated = answer.value(f"{self.quantity}_standard_error")
        standing = np.isfinite(value) & ~answer.rejected()
        error = np.abs(value - self._truth())
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.where(error == 0.0, 0.0, error / stated)
        # A value without a stated error is false whatever it is.
        off = np.where(np.isnan(off), np.inf, off)[standing]
        if not off.size:
            return 0.0, 0.0, 0.0
        return float(off.max()), float(np.mean(off > self.errors)), float(np.mean(standing))


def evaluate(case: StiffCase) -> CaseOutcome:
    """Return what comes of a case; a warning counts as a crash."""
    told = "; ".join(one.told() for one in case.expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        passed, got = _tried(case)
    return CaseOutcome(case.name, case.retrieval.value, told, got, passed, case.finding)


def _tried(case: StiffCase) -> tuple[bool, str]:
    try:
        answer = case.solve(**case.build())
    except LidarOpsError as error:
        first = case.expected[0]
        refused = isinstance(first, Refused) and first.raised(error)
        return refused, f"{type(error).__name__}: {error}"
    except (*_CRASHES, RuntimeWarning) as error:
        return False, f"crash, {type(error).__name__}: {error}"
    passed = all(one.met(answer) for one in case.expected)
    return passed, "; ".join(dict.fromkeys(one.got(answer) for one in case.expected))


def spelled(values: Array) -> str:
    """Return a number, or the first ones and the range of many."""
    flat = np.atleast_1d(values).ravel()
    if flat.size <= _SHOWN:
        return ", ".join(f"{value:.6g}" for value in flat)
    finite = flat[np.isfinite(flat)]
    if not finite.size:
        return f"{flat.size} times NaN or infinity"
    few = "" if finite.size == flat.size else f", {flat.size - finite.size} not finite"
    return f"{finite.min():.4g} to {finite.max():.4g} ({flat.size} values{few})"


def bits_told(bits: int, between: str = ", ") -> str:
    """Return the names of quality bits."""
    names = [(bit.name or "").lower() for bit in Quality if bits & int(bit)]
    return between.join(names) or "none"


def quality_told(answer: Answer) -> str:
    """Return the names of all bits, and the share of the values that have them."""
    count = answer.quality.size
    parts = []
    for bit in Quality:
        share = np.count_nonzero(answer.quality & int(bit)) / count if count else 0.0
        if share:
            name = (bit.name or "").lower()
            parts.append(name if share == 1.0 else f"{name} ({100.0 * share:.3g} %)")
    return ", ".join(parts) or "none"

"""Building blocks of the stiff and extreme cases: case, expectations, outcome.

A stiff case calls a retrieval with difficult input and compares its answer with expectations: a
known value within a tolerance, a flag, or an error that names the wrong field.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from lidarops.errors import LidarOpsError
from lidarops.flags import FlagBit, Quality, rejecting
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.network.flags import NetworkQuality

Array = npt.NDArray[np.float64]
Reference = float | Array | Callable[[], "float | Array"]
"""Reference value, or a function that returns it where it is costly."""

_CRASHES: Final = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Exceptions that no input may cause: a retrieval raises only `LidarOpsError`."""
_SHOWN: Final = 3
"""Largest array that is printed in full."""


class Retrieval(StrEnum):
    """The retrieval, or the forward model, of a case."""

    HOMOGENEOUS = "homogeneous"
    SIGNAL = "signal chain"
    ELASTIC = "elastic"
    MULTIANGLE = "multi-angle"
    NETWORK = "network"
    FORWARD = "forward model"


_OWN: Final[Mapping[Retrieval, Iterable[FlagBit]]] = {
    Retrieval.HOMOGENEOUS: HomogeneousQuality,
    Retrieval.SIGNAL: HomogeneousQuality,
    Retrieval.ELASTIC: ElasticQuality,
    Retrieval.MULTIANGLE: MultiAngleQuality,
    Retrieval.NETWORK: NetworkQuality,
}
"""A cubic of the signal chain that is singular counts as poorly determined."""


def _no_bits() -> npt.NDArray[np.int32]:
    return np.zeros(1, dtype=np.int32)


@dataclass(frozen=True, slots=True)
class Answer:
    """Named values that a retrieval returned, and their quality bits."""

    values: Mapping[str, Any]
    quality: npt.NDArray[np.int32] = field(default_factory=_no_bits)
    """Quality bits, broadcast against the values."""
    own: Iterable[FlagBit] = ()
    """The retrieval's own bits, beside `lidarops.flags.Quality`."""

    def value(self, name: str) -> Array:
        """Return the values of a quantity."""
        return np.asarray(self.values[name], dtype=np.float64)

    def rejected(self) -> npt.NDArray[np.bool_]:
        """Return where a bit rejects the value."""
        return np.asarray((self.quality & rejecting((*Quality, *self.own))) != 0)


class Expectation(Protocol):
    """Condition that an answer must meet."""

    def describe(self) -> str:
        """Return the condition in words."""

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""


@dataclass(frozen=True, slots=True)
class StiffCase:
    """One stiff or extreme case."""

    name: str
    retrieval: Retrieval
    build: Callable[[], Mapping[str, Any]]
    """Returns the arguments of `solve`."""
    solve: Callable[..., Answer]
    expected: tuple[Expectation, ...]
    """All must be met; `Refused` stands alone."""
    finding: str = ""
    """Reason of a known failure; empty for cases that pass."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """Outcome of a case."""

    name: str
    retrieval: str
    expected: str
    got: str
    passed: bool
    finding: str


@dataclass(frozen=True, slots=True)
class Refused:
    """A `LidarOpsError` that names the wrong field."""

    kind: type[LidarOpsError]
    field: str | None = None

    def describe(self) -> str:
        """Return the condition in words."""
        return f"{self.kind.__name__}{f' of {self.field}' if self.field else ''}"

    def met(self, _: Answer) -> bool:
        """Return False: an answer is not a refusal."""
        return False

    def got(self, answer: Answer) -> str:
        """Return the answer that came in place of the error."""
        return f"an answer: {', '.join(answer.values)}"

    def raised(self, error: LidarOpsError) -> bool:
        """Return whether this is the expected error."""
        return isinstance(error, self.kind) and self.field in {None, error.field}


@dataclass(frozen=True, slots=True)
class Near:
    """All values are within a tolerance of their reference."""

    quantity: str
    reference: Reference
    tolerance: float
    relative: bool = True
    """Whether the tolerance is relative to the reference."""

    def describe(self) -> str:
        """Return the condition in words."""
        share = " relative" if self.relative else ""
        return f"{self.quantity} {format_values(self._truth())} within {self.tolerance:.0e}{share}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(self._error(answer) <= self.tolerance)

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        value = format_values(answer.value(self.quantity))
        return f"{self.quantity} {value}, off by {self._error(answer):.1e}"

    def _truth(self) -> Array:
        reference = self.reference() if callable(self.reference) else self.reference
        return np.asarray(reference, dtype=np.float64)

    def _error(self, answer: Answer) -> float:
        truth = self._truth()
        error = np.abs(answer.value(self.quantity) - truth)
        if self.relative:
            error = error / np.abs(truth)
        # NaN counts as an infinite error.
        return float(np.max(np.where(np.isnan(error), np.inf, error)))


@dataclass(frozen=True, slots=True)
class Between:
    """All values are between two bounds."""

    quantity: str
    low: float
    high: float

    def describe(self) -> str:
        """Return the condition in words."""
        return f"{self.quantity} in [{self.low:.3g}, {self.high:.3g}]"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        value = answer.value(self.quantity)
        return bool(np.all((value >= self.low) & (value <= self.high)))

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        return f"{self.quantity} {format_values(answer.value(self.quantity))}"


@dataclass(frozen=True, slots=True)
class Missing:
    """All values are missing."""

    quantity: str

    def describe(self) -> str:
        """Return the condition in words."""
        return f"{self.quantity} NaN"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.isnan(answer.value(self.quantity)).all())

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        return f"{self.quantity} {format_values(answer.value(self.quantity))}"


@dataclass(frozen=True, slots=True)
class Flagged:
    """At least one of these bits is set, for all or at least a share of the values."""

    bits: FlagBit
    share: float = 1.0

    def describe(self) -> str:
        """Return the condition in words."""
        least = "" if self.share == 1.0 else f" on at least {100.0 * self.share:g} %"
        words = dict.fromkeys(bit.word for bit in (*Quality, *type(self.bits)) if self.bits & bit)
        return f"flag {' or '.join(words)}{least}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.mean((answer.quality & int(self.bits)) != 0) >= self.share)

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        return f"flag {_flag_shares(answer)}"


@dataclass(frozen=True, slots=True)
class Rejected:
    """A bit rejects, for all or at least a share of the values."""

    share: float = 1.0

    def describe(self) -> str:
        """Return the condition in words."""
        return "rejected" if self.share == 1.0 else f"rejected on at least {100.0 * self.share:g} %"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.mean(answer.rejected()) >= self.share)

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        return f"flag {_flag_shares(answer)}"


@dataclass(frozen=True, slots=True)
class Accepted:
    """No bit rejects, for all or at least a share of the values."""

    share: float = 1.0

    def describe(self) -> str:
        """Return the condition in words."""
        least = "" if self.share == 1.0 else f" for at least {100.0 * self.share:g} %"
        return f"not rejected{least}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.mean(~answer.rejected()) >= self.share)

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        return f"flag {_flag_shares(answer)}"


@dataclass(frozen=True, slots=True)
class Unflagged:
    """No bit is set."""

    def describe(self) -> str:
        """Return the condition in words."""
        return "no flag"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return not answer.quality.any()

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        return f"flag {_flag_shares(answer)}"


@dataclass(frozen=True, slots=True)
class Covered:
    """Each value is within 4 stated standard errors of the truth, or rejected, or missing."""

    quantity: str
    truth: Reference
    errors: float = 4.0
    """Stated standard errors."""
    valued: float = 0.0
    """Least share of accepted values among all."""
    most: float = 0.0
    """Largest share of accepted values that may differ by more."""

    def describe(self) -> str:
        """Return the condition in words."""
        least = f", at least {100.0 * self.valued:g} % with a value" if self.valued else ""
        but = f" except {100.0 * self.most:g} %" if self.most else ""
        return (
            f"{self.quantity} {format_values(self._truth())} within {self.errors:g} standard"
            f" errors{but}, or flagged{least}"
        )

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        _, false, accepted = self._shares(answer)
        return false <= self.most and accepted >= self.valued

    def got(self, answer: Answer) -> str:
        """Return the answer in the same words."""
        worst, false, accepted = self._shares(answer)
        value = format_values(answer.value(self.quantity))
        beyond = f", {100.0 * false:.2g} % beyond {self.errors:g}" if false else ""
        return (
            f"{self.quantity} {value}, {100.0 * accepted:.3g} % unflagged, worst {worst:.3g}"
            f" standard errors{beyond}, flag {_flag_shares(answer)}"
        )

    def _truth(self) -> Array:
        truth = self.truth() if callable(self.truth) else self.truth
        return np.asarray(truth, dtype=np.float64)

    def _shares(self, answer: Answer) -> tuple[float, float, float]:
        """Return the worst error, the share of false and the share of accepted values."""
        value = answer.value(self.quantity)
        stated = answer.value(f"{self.quantity}_standard_error")
        accepted = np.isfinite(value) & ~answer.rejected()
        error = np.abs(value - self._truth())
        with np.errstate(divide="ignore", invalid="ignore"):
            score = np.where(error == 0.0, 0.0, error / stated)
        # A value without a stated error is false.
        score = np.where(np.isnan(score), np.inf, score)[accepted]
        if not score.size:
            return 0.0, 0.0, 0.0
        return float(score.max()), float(np.mean(score > self.errors)), float(np.mean(accepted))


def evaluate(case: StiffCase) -> CaseOutcome:
    """Return the outcome of a case; a warning counts as a crash."""
    expected = "; ".join(expectation.describe() for expectation in case.expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        passed, got = _run(case)
    return CaseOutcome(case.name, case.retrieval.value, expected, got, passed, case.finding)


def _run(case: StiffCase) -> tuple[bool, str]:
    try:
        answer = replace(case.solve(**case.build()), own=_OWN.get(case.retrieval, ()))
    except LidarOpsError as error:
        first = case.expected[0]
        refused = isinstance(first, Refused) and first.raised(error)
        return refused, f"{type(error).__name__}: {error}"
    except (*_CRASHES, RuntimeWarning) as error:
        return False, f"crash, {type(error).__name__}: {error}"
    passed = all(expectation.met(answer) for expectation in case.expected)
    texts = dict.fromkeys(expectation.got(answer) for expectation in case.expected)
    return passed, "; ".join(texts)


def format_values(values: Array) -> str:
    """Return up to 3 numbers in full, or the range of many."""
    flat = np.atleast_1d(values).ravel()
    if flat.size <= _SHOWN:
        return ", ".join(f"{value:.6g}" for value in flat)
    finite = flat[np.isfinite(flat)]
    if not finite.size:
        return f"{flat.size} times NaN or infinity"
    not_finite = "" if finite.size == flat.size else f", {flat.size - finite.size} not finite"
    return f"{finite.min():.4g} to {finite.max():.4g} ({flat.size} values{not_finite})"


def _flag_shares(answer: Answer) -> str:
    """Return the names of all bits, and the share of the values that have them."""
    count = answer.quality.size
    names = []
    for bit in (*Quality, *answer.own):
        share = np.count_nonzero(answer.quality & int(bit)) / count if count else 0.0
        if share:
            names.append(bit.word if share == 1.0 else f"{bit.word} ({100.0 * share:.3g} %)")
    return ", ".join(names) or "none"

"""Building blocks of the stiff and extreme cases: case, expectations, verdict.

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


@dataclass(frozen=True, slots=True)
class Answer:
    """Named values that a retrieval returned, and their quality bits."""

    values: Mapping[str, Any]
    quality: npt.NDArray[np.int32] = field(default_factory=lambda: np.zeros(1, dtype=np.int32))
    """Quality bits, broadcast against the values."""
    own: Iterable[FlagBit] = ()
    """The retrieval's own bits, beside `lidarops.flags.Quality`."""

    def value(self, name: str) -> Array:
        """Return the values of a quantity."""
        return np.asarray(self.values[name], dtype=np.float64)

    def rejected(self) -> npt.NDArray[np.bool_]:
        """Return where a bit rejects the value."""
        return np.asarray((self.quality & rejecting((*Quality, *self.own))) != 0)

    def __str__(self) -> str:
        """Return the values, and the share of them that have each bit."""
        values = [f"{name} {format_values(self.value(name))}" for name in self.values]
        flags = [
            f"{bit.word} ({100.0 * share:.3g} %)"
            for bit in (*Quality, *self.own)
            if (share := np.mean((self.quality & int(bit)) != 0))
        ]
        return "; ".join((*values, *flags))


class Expectation(Protocol):
    """Condition that an answer must meet."""

    def __str__(self) -> str:
        """Return the condition in words."""

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""


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
    slow: bool = False
    """Whether the case takes several seconds."""

    def __str__(self) -> str:
        """Return what is expected, in words."""
        return "; ".join(str(expectation) for expectation in self.expected)


@dataclass(frozen=True, slots=True)
class Refused:
    """A `LidarOpsError` that names the wrong field."""

    kind: type[LidarOpsError]
    field: str | None = None

    def __str__(self) -> str:
        return f"{self.kind.__name__}{f' of {self.field}' if self.field else ''}"

    def met(self, _: Answer) -> bool:
        """Return False: an answer is not a refusal."""
        return False

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

    def __str__(self) -> str:
        share = " relative" if self.relative else ""
        truth = format_values(_known(self.reference))
        return f"{self.quantity} {truth} within {self.tolerance:.0e}{share}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition; NaN does not."""
        truth = _known(self.reference)
        error = np.abs(answer.value(self.quantity) - truth)
        return bool(np.all((error / np.abs(truth) if self.relative else error) <= self.tolerance))


@dataclass(frozen=True, slots=True)
class Between:
    """All values are between two bounds."""

    quantity: str
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.quantity} in [{self.low:.3g}, {self.high:.3g}]"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        value = answer.value(self.quantity)
        return bool(np.all((value >= self.low) & (value <= self.high)))


@dataclass(frozen=True, slots=True)
class Missing:
    """All values are missing."""

    quantity: str

    def __str__(self) -> str:
        return f"{self.quantity} NaN"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.isnan(answer.value(self.quantity)).all())


@dataclass(frozen=True, slots=True)
class Flagged:
    """At least one of these bits is set, for all or at least a share of the values."""

    bits: FlagBit
    share: float = 1.0

    def __str__(self) -> str:
        words = dict.fromkeys(bit.word for bit in (*Quality, *type(self.bits)) if self.bits & bit)
        return f"flag {' or '.join(words)}{_least(self.share)}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.mean((answer.quality & int(self.bits)) != 0) >= self.share)


@dataclass(frozen=True, slots=True)
class Rejected:
    """A bit rejects, for all or at least a share of the values."""

    share: float = 1.0

    def __str__(self) -> str:
        return f"rejected{_least(self.share)}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.mean(answer.rejected()) >= self.share)


@dataclass(frozen=True, slots=True)
class Accepted:
    """No bit rejects, for all or at least a share of the values."""

    share: float = 1.0

    def __str__(self) -> str:
        return f"not rejected{_least(self.share)}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return bool(np.mean(~answer.rejected()) >= self.share)


@dataclass(frozen=True, slots=True)
class Unflagged:
    """No bit is set."""

    def __str__(self) -> str:
        return "no flag"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition."""
        return not answer.quality.any()


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

    def __str__(self) -> str:
        least = f", at least {100.0 * self.valued:g} % with a value" if self.valued else ""
        but = f" except {100.0 * self.most:g} %" if self.most else ""
        truth = format_values(_known(self.truth))
        errors = f"{self.errors:g} standard errors"
        return f"{self.quantity} {truth} within {errors}{but}, or flagged{least}"

    def met(self, answer: Answer) -> bool:
        """Return whether an answer meets the condition; a value without an error does not."""
        value = answer.value(self.quantity)
        stated = answer.value(f"{self.quantity}_standard_error")
        accepted = np.isfinite(value) & ~answer.rejected()
        false = accepted & ~(np.abs(value - _known(self.truth)) <= self.errors * stated)
        return bool(false.sum() <= self.most * accepted.sum() and np.mean(accepted) >= self.valued)


def failure(case: StiffCase) -> str:
    """Return how a case fails, or nothing; a warning is raised as an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            answer = replace(case.solve(**case.build()), own=_OWN.get(case.retrieval, ()))
        except LidarOpsError as error:
            first = case.expected[0]
            if isinstance(first, Refused) and first.raised(error):
                return ""
            return f"expected {case}; {type(error).__name__}: {error}"
    unmet = [str(expectation) for expectation in case.expected if not expectation.met(answer)]
    return f"expected {'; '.join(unmet)}; got {answer}" if unmet else ""


def _known(reference: Reference) -> Array:
    value = reference() if callable(reference) else reference
    return np.asarray(value, dtype=np.float64)


def _least(share: float) -> str:
    return "" if share == 1.0 else f" on at least {100.0 * share:g} %"


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

"""All stiff and extreme cases, and the expectations that they use."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from support.stiff import CASES
from support.stiff.cases import (
    Accepted,
    Answer,
    Between,
    Covered,
    Flagged,
    Missing,
    Near,
    Refused,
    Rejected,
    Retrieval,
    StiffCase,
    Unflagged,
    failure,
    format_values,
)
from support.stiff.homogeneous import CLEAR, exact_root

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality

BAD = int(Quality.NOT_HOMOGENEOUS)
CARE = int(Quality.OUTLIER)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            case,
            id=f"{case.retrieval.value}: {case.name}",
            marks=(pytest.mark.slow,) if case.slow else (),
        )
        for case in CASES
    ],
)
def test_case_meets_its_expectations(case):
    assert not failure(case)


def test_no_two_cases_of_a_retrieval_share_a_name():
    names = [(case.retrieval, case.name) for case in CASES]
    assert len(set(names)) == len(names)


def test_every_retrieval_has_accepted_and_refused_cases():
    for retrieval in Retrieval:
        kinds = {type(expectation) for case in CASES if case.retrieval is retrieval
                 for expectation in case.expected}  # fmt: skip
        assert Refused in kinds
        assert kinds & {Near, Covered}


# Expectations ---------------------------------------------------------------------------------


def answer(value, error=1.0, bits=0):
    values = {"x": value, "x_standard_error": np.broadcast_to(error, np.shape(value))}
    return Answer(values, np.broadcast_to(np.int32(bits), np.shape(value)))


@pytest.mark.parametrize(
    ("expectation", "good", "bad"),
    [
        (Near("x", 2.0, 0.1), answer([2.19, 1.81]), answer([2.0, 2.21])),
        (Near("x", 2.0, 0.1, relative=False), answer([2.09]), answer([2.11])),
        (Near("x", lambda: 2.0, 0.1), answer([2.0]), answer([np.nan])),
        (Between("x", 1.0, 2.0), answer([1.0, 2.0]), answer([1.5, np.nan])),
        (Missing("x"), answer([np.nan, np.nan]), answer([np.nan, 0.0])),
        (Flagged(Quality.NOT_HOMOGENEOUS), answer([1.0], bits=BAD), answer([1.0], bits=CARE)),
        (Rejected(), answer([1.0], bits=BAD), answer([1.0], bits=CARE)),
        (Accepted(), answer([1.0], bits=CARE), answer([1.0], bits=BAD)),
        (Unflagged(), answer([1.0]), answer([1.0], bits=CARE)),
        (Covered("x", 0.0), answer([3.9, -3.9]), answer([0.0, 4.1])),
        (Covered("x", 0.0), answer([9.0], bits=BAD), answer([9.0], bits=CARE)),
        (Covered("x", 0.0), answer([np.nan]), answer([1.0], error=np.nan)),
        (Covered("x", 0.0), answer([0.0], error=0.0), answer([1e-9], error=0.0)),
        (Covered("x", 0.0, valued=0.5), answer([1.0, np.nan]), answer([np.nan, np.nan])),
        (Covered("x", 0.0, most=0.5), answer([1.0, 5.0]), answer([5.0, 5.0])),
    ],
)
def test_expectations_separate_good_from_bad(expectation, good, bad):
    assert expectation.met(good)
    assert not expectation.met(bad)
    assert str(expectation)


def made(solve, *expected):
    return StiffCase("made", Retrieval.HOMOGENEOUS, dict, solve, expected)


def refuse():
    raise RetrievalInputError("is wrong", field="range")


def warn():
    warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)
    return answer([1.0])


@pytest.mark.parametrize(
    ("solve", "expected", "text"),
    [
        (lambda: answer([1.0]), Accepted(), ""),
        (refuse, Refused(RetrievalInputError, "range"), ""),
        (refuse, Refused(RetrievalInputError, "power"), "of power; .*range: is wrong"),
        (refuse, Accepted(), "expected not rejected; RetrievalInputError"),
        (lambda: answer([1.0]), Refused(RetrievalInputError), "got x 1"),
        (lambda: answer([1.0], bits=BAD), Accepted(), r"not_homogeneous \(100 %\)"),
    ],
)
def test_a_failure_tells_expectation_and_answer(solve, expected, text):
    assert re.search(text, failure(made(solve, expected)))
    assert bool(text) == bool(failure(made(solve, expected)))


def test_a_warning_is_an_error():
    with pytest.raises(RuntimeWarning, match="divide by zero"):
        failure(made(warn, Accepted()))


def test_many_values_are_described_by_their_range():
    assert format_values(np.array([1.0, 2.0])) == "1, 2"
    assert format_values(np.array([1.0, 5.0, np.nan, 3.0])) == "1 to 5 (4 values, 1 not finite)"
    assert format_values(np.full(7, np.nan)) == "7 times NaN or infinity"


@pytest.mark.parametrize("lag", [1, 11])
def test_oracle_of_the_cubic_against_mpmath(lag):
    path = replace(CLEAR, bins=33, length=1000.0)
    with mpmath.workdps(60):
        p = [mpmath.mpf(float(x)) for x in path.noisy(1)[0]]
        r = [mpmath.mpf(float(x)) for x in path.range]
        total = [mpmath.mpf(0)] * 4
        for k in range(len(p) - 2 * lag):
            p0, p1, p2 = p[k], p[k + lag], p[k + 2 * lag]
            u, v = (r[k] * r[k + 2 * lag]) ** 2, r[k + lag] ** 4
            a, b, c = v - u, u * (p0 + p2) - 2 * v * p1, v * p1**2 - u * p0 * p2
            terms = (2 * a * a, 3 * a * b, 2 * a * c + b * b, b * c)
            total = [value + term for value, term in zip(total, terms, strict=True)]
        roots = mpmath.polyroots(total, maxsteps=500, extraprec=400)
        largest = max(mpmath.re(x) for x in roots if abs(mpmath.im(x)) < 1e-25 * abs(x))
    assert exact_root(path.noisy(1)[0], path.range, lag) == pytest.approx(float(largest), rel=1e-14)

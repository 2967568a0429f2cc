"""Verdicts on figures with Monte Carlo errors."""

from __future__ import annotations

import pytest

from benchmarks.harness.figure import Figure, Judgement, Target, Unit, Verdict

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("value", "error", "verdict"),
    [
        (0.955, 0.005, Verdict.MET),
        # Within the limits, but not by 2 errors: precision is needed for both verdicts.
        (0.955, 0.010, Verdict.UNDECIDED),
        (0.965, 0.005, Verdict.UNDECIDED),
        (0.975, 0.005, Verdict.UNDECIDED),
        (0.981, 0.005, Verdict.MISSED),
        (0.929, 0.005, Verdict.MISSED),
        (0.931, 0.005, Verdict.UNDECIDED),
    ],
)
def test_a_target_is_met_or_missed_only_beyond_two_errors(value, error, verdict):
    assert Target(0.97, 0.94).verdict(Figure(value, error)) is verdict


def test_a_share_needs_no_lower_limit():
    assert Target(1e-3).verdict(Figure(0.0, 4e-4)) is Verdict.MET
    assert Target(1e-3).verdict(Figure(0.0, 6e-4)) is Verdict.UNDECIDED
    assert Target(1e-3).verdict(Figure(1.2e-3, 0.5e-4)) is Verdict.MISSED


def test_the_text_states_the_target_whose_it_is_and_the_verdict():
    share = Figure(0.2, 0.001, Unit.SHARE)
    assert str(Target(0.13, own=True).judged(share)) == "own target 13 % MISSED"
    assert str(Target(0.97, 0.94).judged(share)) == "94 to 97 % MISSED"
    assert str(Target(2.5).judged(Figure(9.3))) == "2.5 MISSED"
    assert str(Target(2.5).judged(Figure(2.4))) == "2.5 met"


@pytest.mark.parametrize("verdict", Verdict)
def test_what_a_result_states_is_read_again(verdict):
    judgement = Judgement("own target 94 to 97 %", verdict)
    assert Judgement.read(str(judgement)) == judgement
    assert judgement.met == (verdict is Verdict.MET)

"""Benchmark of a Raman night: it times what it names, and the retrievals give values."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.harness.results import Effort
from benchmarks.throughput import raman_night

pytestmark = pytest.mark.slow


def test_the_night_is_timed_and_its_retrievals_give_values():
    study = raman_night.measure_raman(Effort(date="2026-01-01", repeats=1), profiles=60)
    methods = {method for results in study.results for _, method in results.scores}
    assert {raman_night.AVERAGES, raman_night.RETRIEVALS} <= methods
    means = raman_night.means_of(raman_night.night(60))
    for product in raman_night.retrieved(means):
        assert np.isfinite(product["aerosol_extinction"].values).any()

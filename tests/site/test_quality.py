"""Quality over time: shares of the values of each profile."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest
from support.products.fabricated import START, homogeneous, signal, times

from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.site import quality as qualities
from lidarops.site.quality import read_quality


@pytest.fixture(params=[1, 10**9])
def product(request, monkeypatch):
    """Flags of 30 profiles, read in many blocks and in one."""
    monkeypatch.setattr(qualities, "READ_VALUES", request.param)
    made = signal(times(START, 30, 60.0), bins=50)
    bits = [0, 0, int(Quality.PILE_UP), int(Quality.SATURATED), int(Quality.INPUT_MISSING)]
    flags = np.random.default_rng(3).choice(bits, (30, 50))
    made["quality_flag"][:] = flags.astype(np.int32)
    return made.assign_attrs(lidarops_kind="signal")


def test_shares_are_those_of_the_flags(product):
    quality = read_quality(product)
    flags = product["quality_flag"].values
    rejected = (flags & flags_of("signal").rejecting) != 0
    assert quality.verdicts.good == (flags == 0).sum()
    assert quality.verdicts.reject == rejected.sum()
    (panel,) = quality.figure.panels
    assert [layer.label for layer in panel.layers] == ["good", "use with care", "do not use"]
    good, care, reject = panel.layers
    np.testing.assert_array_equal(good.high, care.low)
    np.testing.assert_array_equal(care.high, reject.low)
    np.testing.assert_allclose(good.high[::3], 100.0 * (flags == 0).mean(axis=1))
    np.testing.assert_allclose(care.high[::3], 100.0 * (1.0 - rejected.mean(axis=1)))
    assert (reject.high == 100.0).all()


def test_many_profiles_become_means():
    made = homogeneous(times(START, 3000, 20.0), flagged=0.3)
    (panel,) = read_quality(made).figure.panels
    good = panel.layers[0].high[::3]
    assert good.size <= 240
    flags = made["quality_flag"].values
    size = 3000 // good.size + 1
    np.testing.assert_allclose(good[0], 100.0 * (flags[:size] == 0).mean(), atol=1e-9)


def test_the_words_are_of_all_values_whatever_the_columns():
    # 250 profiles in columns of 2, and one that is a column of its own.
    time = np.concatenate([times(START, 250, 60.0), times(START + timedelta(hours=9), 1, 60.0)])
    made = signal(time, bins=20)
    made["quality_flag"][:] = 0
    made["quality_flag"].values[-1] = int(Quality.SATURATED)
    assert f"{100 * 250 / 251:.1f} % of the values good" in read_quality(made).figure.words


def test_nothing_is_drawn_in_a_gap():
    time = np.concatenate([times(START, 10, 60.0), times(START + timedelta(hours=1), 10, 60.0)])
    good = read_quality(signal(time, bins=20)).figure.panels[0].layers[0]
    left, right = good.along.reshape(-1, 3)[:, :2].T
    np.testing.assert_allclose(1440.0 * (left[10] - right[9]), 50.0, atol=1e-3)


def test_without_flags_over_time_there_is_no_figure():
    made = signal(times(START, 3, 60.0))
    assert read_quality(made.drop_vars("quality_flag")).figure is None
    assert read_quality(made.isel(time=slice(0))).figure is None

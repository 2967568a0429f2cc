"""Quality over time: shares of the values of each profile."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest
from support.products.fabricated import START, homogeneous, signal, times

from lidarops.figures import quality_panel
from lidarops.figures.quality_panel import quality_figure, read_quality
from lidarops.flags import Quality
from lidarops.kinds import flags_of


@pytest.fixture(params=[1, 10**9])
def product(request, monkeypatch):
    """Flags of 30 profiles, read in many blocks and in one."""
    monkeypatch.setattr(quality_panel, "READ_VALUES", request.param)
    made = signal(times(START, 30, 60.0), bins=50)
    bits = [0, 0, int(Quality.PILE_UP), int(Quality.SATURATED), int(Quality.INPUT_MISSING)]
    flags = np.random.default_rng(3).choice(bits, (30, 50))
    made["quality_flag"][:] = flags.astype(np.int32)
    return made.assign_attrs(lidarops_kind="signal")


def test_shares_are_those_of_the_flags(product):
    quality = read_quality(product)
    flags = product["quality_flag"].values
    np.testing.assert_allclose(quality.good, (flags == 0).mean(axis=1))
    rejected = (flags & flags_of("signal").rejecting) != 0
    np.testing.assert_allclose(quality.rejected, rejected.mean(axis=1))
    (panel,) = quality_figure(quality).panels
    assert [layer.label for layer in panel.layers] == ["good", "use with care", "do not use"]
    good, care, reject = panel.layers
    np.testing.assert_array_equal(good.high, care.low)
    np.testing.assert_array_equal(care.high, reject.low)
    np.testing.assert_allclose(care.high[::3], 100.0 * (1.0 - rejected.mean(axis=1)))
    assert (reject.high == 100.0).all()


def test_many_profiles_become_means():
    made = homogeneous(times(START, 3000, 20.0), flagged=0.3).assign_attrs(
        lidarops_kind="homogeneous"
    )
    quality = read_quality(made)
    assert quality.good.size <= 240
    flags = made["quality_flag"].values
    size = 3000 // quality.good.size + 1
    np.testing.assert_allclose(quality.good[0], (flags[:size] == 0).mean(), atol=1e-9)


def test_the_words_are_of_all_values_whatever_the_columns():
    # 250 profiles in columns of 2, and one that is a column of its own.
    time = np.concatenate([times(START, 250, 60.0), times(START + timedelta(hours=9), 1, 60.0)])
    made = signal(time, bins=20).assign_attrs(lidarops_kind="signal")
    made["quality_flag"][:] = 0
    made["quality_flag"].values[-1] = int(Quality.SATURATED)
    quality = read_quality(made)
    assert quality.profiles.tolist() == [*[2] * 125, 1]
    assert f"{100 * 250 / 251:.1f} % of the values good" in quality_figure(quality).words


def test_nothing_is_drawn_in_a_gap():
    time = np.concatenate([times(START, 10, 60.0), times(START + timedelta(hours=1), 10, 60.0)])
    quality = read_quality(signal(time, bins=20))
    hour = (quality.start[10:11] - quality.stop[9:10]) / np.timedelta64(1, "m")
    np.testing.assert_allclose(hour, 50.0)


def test_without_flags_there_is_no_figure():
    made = signal(times(START, 3, 60.0))
    assert read_quality(made.drop_vars("quality_flag")) is None
    assert read_quality(made.isel(time=slice(0))) is None

"""Panels of series hold values, errors, flags and gaps."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest
from support.products.drawn import figures, labelled
from support.products.fabricated import SECTIONS, START, homogeneous, signal, times

from lidarops.errors import ProductError
from lidarops.figures.panels import Band, Curve
from lidarops.figures.wording import counted
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality


def drawn(*products):
    return figures("homogeneous", "homogeneous", products)


def values(panel):
    """Return the curves of the series."""
    return [layer for layer in panel.layers if isinstance(layer, Curve) and layer.joined
            and "ink" not in layer.style]  # fmt: skip


def test_lines_hold_the_unflagged_values_in_km():
    product = homogeneous(times(START, 100, 300.0), flagged=0.2)
    ((upper, lower),) = (figure.panels for figure in drawn(product))
    assert upper.y.label == "total extinction (km⁻¹)"
    assert lower.y.label == "background (MHz)"
    for panel, name, scale in ((upper, "total_extinction", 1e3), (lower, "background", 1.0)):
        assert len(values(panel)) == len(SECTIONS)
        for k, curve in enumerate(values(panel)):
            good = product["quality_flag"].values[:, k] == 0
            shown = curve.y[np.isfinite(curve.y)]
            np.testing.assert_allclose(shown, scale * product[name].values[good, k], rtol=1e-6)


def test_error_bars_are_one_standard_error():
    product = homogeneous(times(START, 50, 300.0), flagged=0.0, sections=SECTIONS[:1])
    panel = drawn(product)[0].panels[0]
    (bars,) = (layer for layer in panel.layers if isinstance(layer, Band))
    assert bars.bars
    expected = 1e3 * product["total_extinction_standard_error"].values[:, 0]
    np.testing.assert_allclose((bars.high - bars.low) / 2, expected, rtol=1e-5)


def test_many_profiles_get_a_band_of_their_means():
    product = homogeneous(times(START, 4000, 20.0), flagged=0.0, sections=SECTIONS[:1])
    panel = drawn(product)[0].panels[0]
    (curve,) = values(panel)
    assert 250 <= curve.y.size <= 300
    assert curve.label.endswith("means of 14 profiles")
    (band,) = (layer for layer in panel.layers if isinstance(layer, Band))
    assert not band.bars


def test_flagged_values_and_those_to_use_with_care_are_marked():
    product = homogeneous(times(START, 200, 300.0), flagged=0.3)
    product["quality_flag"].values[[3, 9], 0] = int(Quality.OUTLIER)
    panel = drawn(product)[0].panels[0]
    flag = product["quality_flag"].values
    rejected = (flag & flags_of("homogeneous").rejecting) != 0
    for words, chosen in (
        ("do not use", rejected),
        ("use with care", (flag != 0) & ~rejected),
    ):
        (marks,) = labelled(panel, words)
        assert not marks.joined
        assert marks.label == f"{words}: {counted(int(chosen.sum()), 'value')}"
        expected = 1e3 * product["total_extinction"].values.T[chosen.T]
        np.testing.assert_allclose(marks.y, expected, rtol=1e-6)


def test_flagged_values_do_not_set_the_axis():
    product = homogeneous(times(START, 40, 300.0), flagged=0.0)
    product["quality_flag"].values[5, 0] = int(HomogeneousQuality.AT_BOUND)
    product["total_extinction"].values[5, 0] = 5.0
    assert drawn(product)[0].panels[0].y.high < 0.6


def test_values_beyond_the_axis_are_counted():
    product = homogeneous(times(START, 1000, 60.0), flagged=0.0, sections=SECTIONS[:1])
    product["total_extinction"].values[5, 0] = 5.0
    assert "1 value of total extinction beyond the axis" in drawn(product)[0].words


def test_no_line_bridges_a_gap():
    time = np.concatenate([times(START, 20, 60.0), times(START + timedelta(hours=1), 20, 60.0)])
    (curve, _) = values(drawn(homogeneous(time, flagged=0.0))[0].panels[0])
    assert np.flatnonzero(np.isnan(curve.y)).tolist() == [20]


def test_products_are_joined_in_time_and_sections_are_few_in_a_figure():
    parts = [homogeneous(times(START + timedelta(hours=h), 20, 60.0), flagged=0.0) for h in (3, 0)]
    (figure,) = drawn(*parts)
    assert [np.isfinite(curve.y).sum() for curve in values(figure.panels[0])] == [40, 40]
    many = tuple((100.0 * k, 100.0 * k + 50.0) for k in range(1, 7))
    product = homogeneous(times(START, 9, 60.0), flagged=0.0, sections=many)
    assert [len(values(f.panels[0])) for f in drawn(product)] == [4, 2]


def test_one_profile_and_all_flagged_and_all_missing():
    drawn(homogeneous(times(START, 1, 60.0), flagged=0.0))
    product = homogeneous(times(START, 5, 60.0))
    product["quality_flag"][:] = int(HomogeneousQuality.POOR_FIT)
    assert "no usable value, 5 flagged values" in drawn(product)[0].words
    # Values to use with care are usable.
    product["quality_flag"][:] = int(Quality.PILE_UP)
    words = drawn(product)[0].words
    assert "km⁻¹, 5 flagged values" in words
    assert "no usable value" not in words
    for name in ("total_extinction", "background"):
        product[name][:] = np.nan
    assert drawn(product)
    assert not drawn(product.isel(time=slice(0)), homogeneous(times(START, 1, 60.0)))[1:]


def test_a_foreign_product_is_refused():
    with pytest.raises(ProductError, match="total_extinction"):
        drawn(signal(times(START, 3, 60.0)))

"""Images show block means, flags, gaps and clouds."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from support.products.drawn import decoded, figures, images, labelled, pixels
from support.products.encoded_products import build_product
from support.products.fabricated import START, signal, times
from support.products.made_products import MAKERS, context

from lidarops.figures.image_panels import colour_limits
from lidarops.figures.panels import BLANK, NEGATIVE, REJECTED
from lidarops.figures.raster import COLUMNS, ROWS
from lidarops.figures.time_axis import days
from lidarops.kinds import flags_of


def drawn(*products):
    (figure,) = figures("signal", "signal", products, columns=COLUMNS // len(products))
    return figure


def test_codes_are_the_signal_and_its_flags():
    product = signal(times(START, 48, 1800.0), bins=150)
    figure = drawn(product)
    (panel,) = figure.panels
    (image,) = images(panel)
    rows = image.codes.shape[1]
    flag = product["quality_flag"].values[:, :rows]
    rejected = (flag & flags_of("signal").rejecting) != 0
    np.testing.assert_array_equal(image.codes == REJECTED, rejected)
    np.testing.assert_allclose(image.left, days(product["time"].values) - 1 / 96, atol=1e-9)
    near = product["range"].values[:rows] - 7.5
    np.testing.assert_allclose(1e3 * image.edges[:-1], 0.94 * near + 120.0)
    value = np.clip(product["signal"].values[:, :rows], panel.bar.low, panel.bar.high)
    shown = ~rejected & (image.codes != NEGATIVE)
    assert shown.mean() > 0.5
    np.testing.assert_allclose(decoded(image.codes, panel.bar)[shown], value[shown], rtol=0.02)
    assert panel.bar.label == "range-corrected signal (MHz m²)"
    assert "light grey" in figure.words


def test_gaps_in_time_are_blank():
    time = np.concatenate([times(START, 12, 600.0), times(START + timedelta(hours=4), 12, 600.0)])
    panel = drawn(signal(time, bins=100)).panels[0]
    x = panel.x.low + (np.arange(COLUMNS) + 0.5) / COLUMNS * (panel.x.high - panel.x.low)
    blank = (pixels(panel) == BLANK).all(axis=0)
    since = x - panel.x.low
    np.testing.assert_array_equal(blank, (since > 2 / 24) & (since < 4 / 24))


def test_scenes_are_drawn_as_one():
    whole = signal(times(START, 120, 60.0), bins=200)
    halves = [whole.isel(time=slice(60, None)), whole.isel(time=slice(60))]
    expected, joined = drawn(whole), drawn(*halves)
    np.testing.assert_array_equal(pixels(expected.panels[0]), pixels(joined.panels[0]))
    assert expected.words == joined.words


def test_scenes_with_different_grids_share_a_panel():
    coarse = signal(times(START, 30, 60.0), bins=200, bin_width=15.0)
    fine = signal(times(START + timedelta(minutes=30), 30, 60.0), bins=800, bin_width=7.5)
    panel = drawn(coarse, fine).panels[0]
    assert panel.y.high <= 6.0
    filled = pixels(panel) != BLANK
    assert filled[-1].all()
    assert filled[:, -COLUMNS // 3 :].all()


def test_large_products_are_reduced():
    product = signal(times(START, 1600, 20.0), bins=1700, bin_width=3.0)
    (image,) = images(drawn(product).panels[0])
    assert image.codes.shape[0] <= COLUMNS
    assert image.codes.shape[1] <= ROWS


@pytest.mark.parametrize("value", [-1.0, np.nan, 0.0])
def test_an_empty_panel_says_so(value):
    product = signal(times(START, 5, 60.0), bins=40)
    product["signal"][:] = value
    figure = drawn(product)
    assert figure.words.startswith("No usable value above zero")
    assert figure.panels[0].bar is None


def test_a_beam_that_is_nearly_horizontal_is_drawn_against_range():
    product = signal(times(START, 5, 60.0), bins=40)
    product["altitude"] = ("range", 120.0 + 0.01 * product["range"].values)
    panel = drawn(product).panels[0]
    assert panel.y.label == "range (km)"


def test_altitude_rises_also_where_a_beam_looks_down():
    product = signal(times(START, 40, 60.0), bins=40)
    product["quality_flag"][:] = 0
    product["signal_standard_error"][:] = 1.0
    product["signal"][:] = 1e3 * np.where(np.arange(40) < 20, 10.0, 1.0)
    product["altitude"] = ("range", 5000.0 - product["range"].values)
    figure = drawn(product)
    (panel,) = figure.panels
    np.testing.assert_allclose([panel.y.low, panel.y.high], [4.4, 5.0])
    (image,) = images(panel)
    assert (np.diff(image.edges) > 0).all()
    assert (image.codes[:, -1] == image.codes.max()).all()
    assert (image.codes[:, 0] < image.codes.max()).all()
    assert (image.codes[:, 0] > BLANK).all()


def test_a_quicklook_shows_the_lowest_15_km():
    product = signal(times(START, 5, 60.0), bins=4000, bin_width=15.0)
    product["signal_standard_error"].values[:] = 1e-3 * np.abs(product["signal"].values)
    assert drawn(product).panels[0].y.high == pytest.approx(0.12 + 0.94 * 15.0, rel=0.02)


def test_far_noise_is_left_out_with_a_note():
    figure = drawn(signal(times(START, 60, 60.0), bins=4000, bin_width=15.0))
    assert figure.panels[0].y.high < 30.0
    assert "noise dominates beyond" in figure.words


def test_a_quantity_that_noise_hides_is_shown_as_far_as_it_is_usable():
    """As particles of clean air below a reference window, with rejected bins far above."""
    product = signal(times(START, 60, 60.0), bins=4000, bin_width=15.0)
    product["signal"].values[:] = 0.0
    product["quality_flag"].values[:] = 0
    product["quality_flag"].values[:, 400:] = flags_of("signal").rejecting
    assert drawn(product).panels[0].y.high == pytest.approx(0.12 + 0.94 * 7.2, rel=0.02)


def test_triangles_mark_the_lowest_cloud_bases():
    product = signal(times(START, 8, 60.0), bins=100)
    assert not labelled(drawn(product).panels[0], "base of the lowest cloud")
    product["cloud_base_range"] = ("time", [90.0, np.nan, 40.0, 60.0, *[np.nan] * 4])
    figure = drawn(product)
    (marks,) = labelled(figure.panels[0], "base of the lowest cloud")
    base = np.array([0.09, np.nan, 0.04, 0.06])
    np.testing.assert_allclose(marks.y[:4], 0.12 + 0.94 * base)
    assert "cloud base in 3 of 8 columns (triangles)" in figure.words


def measured(product, seconds):
    """Return a product whose profiles were measured for a part of the time between them."""
    half = np.timedelta64(int(500 * seconds), "ms")
    time = product["time"].values
    return product.assign(time_bnds=(("time", "nv"), np.stack([time - half, time + half], -1)))


def filled(panel):
    return (pixels(panel) != BLANK).any(axis=0)


def test_time_without_measurement_is_blank():
    """A mean of 5 s every 42 min is drawn as what it is."""
    product = measured(signal(times(START, 12, 2520.0), bins=100), 5.0)
    panel = drawn(product).panels[0]
    (image,) = images(panel)
    np.testing.assert_allclose((image.right - image.left) * 86400.0, 5.0, atol=1e-3)
    start, stop = product["time_bnds"].values[[0, -1], [0, 1]]
    assert panel.x.high - panel.x.low == pytest.approx((stop - start) / np.timedelta64(1, "D"))


def test_short_pauses_between_profiles_are_filled_and_said():
    product = measured(signal(times(START, 60, 60.0), bins=100), 12.0)
    figure = drawn(product)
    assert filled(figure.panels[0]).all()
    assert "measured in 20.3 % of the time that is filled" in figure.words
    whole = drawn(measured(signal(times(START, 60, 60.0), bins=100), 60.0))
    assert "that is filled" not in whole.words


def test_means_at_or_below_zero_are_grey():
    product = signal(times(START, 10, 60.0), bins=40)
    product["quality_flag"][:] = 0
    product["signal"][:] = 1.0
    product["signal"].values[:, 10:20] = -1.0
    product["signal_standard_error"][:] = 0.1
    (image,) = images(drawn(product).panels[0])
    negative = np.tile(np.arange(30) // 10 == 1, (10, 1))
    np.testing.assert_array_equal(image.codes[:, :30] == NEGATIVE, negative)


@pytest.mark.parametrize("factor", [1.0, 1e-3])
def test_colours_of_a_retrieved_quantity_mean_the_same_in_all_products(factor):
    product = xr.decode_cf(build_product(MAKERS["elastic"](), context("elastic")))
    product["aerosol_backscatter"] = product["aerosol_backscatter"] * factor
    (figure,) = figures("elastic", "elastic-aerosol-backscatter", [product])
    bar = figure.panels[0].bar
    assert (bar.low, bar.high, bar.label) == (0.01, 10.0, "aerosol backscatter (Mm⁻¹ sr⁻¹)")


@given(low=st.floats(1e-9, 1e9), ratio=st.floats(1.0, 1e3))
def test_other_scales_end_at_round_values(low, ratio):
    ends = colour_limits(np.repeat([low, low * ratio], 1000))
    for end in ends:
        digits = f"{end:.6e}".split("e")[0]
        assert float(digits) in (1.0, 2.0, 5.0)
    assert ends[0] <= low * (1 + 1e-9)
    assert ends[1] >= 0.99 * low * ratio


def test_a_cloud_that_passes_is_not_cut_off():
    product = signal(times(START, 60, 60.0), bins=1000, bin_width=15.0)
    product["quality_flag"][:] = 0
    product["signal_standard_error"][:] = 1.0
    noise = np.random.default_rng(0).standard_normal((60, 1000))
    product["signal"][:] = noise + 10.0 * (product["range"].values < 3000.0)
    assert drawn(product).panels[0].y.high == pytest.approx(3.6, abs=0.3)
    product["signal"].values[20:30, 600:640] += 30.0
    assert drawn(product).panels[0].y.high == pytest.approx(1.2 * 9.6, abs=0.4)

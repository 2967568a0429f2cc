"""Figures as files and as data of a page."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.products.drawn import decoded, described

from lidarops.figures import browser
from lidarops.figures.panels import (
    Axis,
    Band,
    Curve,
    Figure,
    Image,
    Mark,
    Panel,
    Words,
    codes_of,
    decade_axis,
    percentile_axis,
    units,
)
from lidarops.figures.stills import still

ONE = np.array([0.0, 1.0])
UP = Axis("up", 0.1, 100.0, log=True)
ACROSS = Axis("time (UTC)", 20_000.0, 20_001.0, time=True)
SCALE = Axis("bar", 0.01, 10.0, log=True)


def every_layer() -> Figure:
    """Return a figure with every sort of layer and axis."""
    x, y = 20_000.0 + np.linspace(0.0, 1.0, 9), np.geomspace(0.2, 50.0, 9)
    y[4] = np.nan
    codes = codes_of(np.random.default_rng(0).uniform(size=(3, 5)))
    image = Image(codes, x[[0, 2, 6]], x[[2, 4, 8]], np.geomspace(0.1, 100.0, 6))
    layers = (
        image,
        Band(x, 0.5 * y, 2.0 * y, "c1", label="band"),
        Band(x, 0.5 * y, 2.0 * y, bars=True),
        *(Curve(x, y, "ink hollow d1", mark, label=mark.name) for mark in Mark),
        Words(x[:1], y[:1], ("<words>",)),
    )
    other = Axis("other $x^$", 0.0, 3.0)
    flat = Panel(Axis("a", 0, 1), Axis("b", 0, 1), (Curve(ONE, ONE),), to_scale=True)
    return Figure(
        "Caption", "words", (Panel(ACROSS, UP, layers, bar=SCALE), Panel(ACROSS, other, ()), flat)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "begin"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")]
)
def test_a_still_is_a_reproducible_file_of_its_type(suffix: str, begin: bytes):
    first = still(every_layer(), suffix)
    assert first.startswith(begin)
    assert len(first) > 5_000
    assert still(every_layer(), suffix) == first


def test_logarithmic_axes_and_bars_are_labelled_with_numbers():
    # Texts are drawn as shapes, with the text in a comment before.
    text = still(every_layer(), ".svg").decode()
    assert "mathdefault" not in text
    labels = re.findall(r"<!-- (\S+) -->", text)
    # The axis from 0.1 to 100, and the bar from 0.01 to 10.
    assert labels.count("0.1") >= 2
    assert {"0.01", "10", "100"} <= set(labels)


def test_a_page_holds_positions_to_16_bits_and_codes():
    figure = every_layer()
    panels = described(browser.inline(figure))["panels"]
    for shown, panel in zip(panels, figure.panels, strict=True):
        for one, layer in zip(shown["layers"], panel.layers, strict=True):
            if isinstance(layer, Image):
                np.testing.assert_array_equal(one["codes"], layer.codes)
                np.testing.assert_allclose(np.exp(one["edges"]), layer.edges, rtol=1e-4)
                np.testing.assert_allclose(one["left"], layer.left, atol=1e-4)
            elif isinstance(layer, Curve):
                place = np.exp(one["y"]) if panel.y.log else one["y"]
                np.testing.assert_allclose(place, layer.y, rtol=1e-4)
                assert one["label"] == layer.label


@given(st.floats(-1.0, 2.0), st.integers(2, 50))
def test_codes_hold_a_share_to_half_a_step(share: float, count: int):
    codes = codes_of(np.full(count, share))
    value = decoded(codes, SCALE)
    inside = min(max(share, 0.0), 1.0)
    np.testing.assert_allclose(np.log(value / SCALE.low) / np.log(1e3), inside, atol=0.5 / 252)


def test_text_cannot_end_the_data():
    nasty = "</script><b>\x1b"
    one = Panel(Axis(nasty, 0, 1), UP, (Curve(ONE, ONE, label=nasty),))
    markup = str(browser.inline(Figure(nasty, nasty, (one,))))
    assert markup.count("</script>") == 1
    assert "\x1b" not in markup
    assert described(markup)["panels"][0]["x"]["label"] == "</script><b>\\x1b"


def test_an_axis_that_is_not_finite_is_no_json():
    panel = Panel(Axis("x", 0.0, np.nan), UP, (Curve(ONE, ONE),))
    with pytest.raises(ValueError, match="JSON"):
        browser.inline(Figure("c", "w", (panel,)))


@pytest.mark.slow
def test_drawing_libraries_are_imported_only_where_something_is_drawn():
    code = (
        "import lidarops.site.build, lidarops.reports.run_page, lidarops.cli.app, sys;"
        "assert not {'matplotlib', 'PIL'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_axes_of_data():
    values = [np.array([1.0, 2.0, 3.0, np.nan]), np.array([np.inf])]
    axis = percentile_axis("name", values, share=0.0, room=0.5)
    assert (axis.low, axis.high) == (0.0, 4.0)
    for values in ([np.array([])], [np.array([5.0, 5.0])], [np.array([np.nan])]):
        for axis in (percentile_axis("name", values), decade_axis("name", values)):
            assert axis.low < axis.high
    wide = decade_axis("name", [np.array([-1.0, *[1e-30] * 9, 1.0])])
    assert wide.low == pytest.approx(1e-5 * wide.high)


def test_units_have_superscripts():
    assert units("m-1 sr-1") == "m⁻¹ sr⁻¹"
    assert units("MHz m2") == "MHz m²"
    assert units("1") == "1"

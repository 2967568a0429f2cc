"""SVG files of figures: positions, text, legends, images, thumbnails."""

from __future__ import annotations

import base64
import io
import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pictures

from lidarops.figures import pixels, svg
from lidarops.figures.panels import (
    Axis,
    Band,
    Curve,
    Figure,
    Image,
    Mark,
    Palette,
    Panel,
    Words,
    decade_axis,
    percentile_axis,
    units,
)
from lidarops.figures.time_axis import Tick

ONE = np.array([0.0, 1.0])


def panel(*layers, y=Axis("up", 0.0, 1.0), **options):  # noqa: B008 - it is frozen
    return Panel(Axis("across", 0.0, 1.0), y, layers, **options)


def figure(*panels, **options):
    return Figure("Caption", "words", panels, **options)


def drawn(*panels, **options):
    return svg.file(figure(*panels, **options)).decode()


def texts(document):
    return [element.text for element in ET.fromstring(document).iter() if "text" in element.tag]


def numbers(path):
    return [float(word) for word in re.findall(r"-?\d+\.?\d*", path)]


def paths(document, css):
    return re.findall(rf'<path class="{css}" d="([^"]*)"', document)


def frame(document):
    """Return left, top, width and height of the first panel."""
    return [float(re.search(rf'<svg [^>]*\b{n}="([\d.]+)"', document[60:])[1]) for n in
            ("x", "y", "width", "height")]  # fmt: skip


def test_curves_lie_where_the_axes_say():
    document = drawn(panel(Curve(np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0, 0.5]))))
    left, top, width, height = frame(document)
    (path,) = paths(document, "line c0")
    expected = [left, top + height, left + width / 2, top, left + width, top + height / 2]
    np.testing.assert_allclose(numbers(path), expected, atol=0.11)


def test_logarithmic_axes():
    y = Axis("up", 1.0, 100.0, log=True)
    curve = Curve(np.array([0.0, 0.5, 1.0]), np.array([1.0, 10.0, -1.0]))
    document = drawn(panel(curve, y=y))
    _, top, _, height = frame(document)
    (path,) = paths(document, "line c0")
    np.testing.assert_allclose(numbers(path)[1::2], [top + height, top + height / 2], atol=0.11)
    assert {"1", "10", "100"} <= set(texts(document))


def test_no_line_bridges_a_value_that_is_not_finite():
    y = np.array([0.1, 0.2, np.nan, 0.3, 0.4])
    x = np.linspace(0.0, 1.0, 5)
    document = drawn(panel(Band(x, y - 0.1, y + 0.1), Curve(x, y, mark=Mark.SQUARE)))
    assert paths(document, "line c0")[0].count("M") == 2
    assert paths(document, "band c0")[0].count("Z") == 2
    assert paths(document, "mark c0")[0].count("M") == 4


def test_steps_run_across_then_up():
    document = drawn(panel(Curve(ONE, ONE, steps=True)))
    left, top, width, height = frame(document)
    expected = [left, top + height, left + width, top + height, left + width, top]
    np.testing.assert_allclose(numbers(paths(document, "line c0")[0]), expected, atol=0.11)


def test_bars_are_one_at_each_point():
    document = drawn(panel(Band(ONE, ONE - 0.1, ONE + 0.1, bars=True)))
    assert paths(document, "err c0")[0].count("V") == 2


def test_layers_are_clipped_at_the_panel():
    (inner,) = re.findall(r'<svg x=[^>]*viewBox="([^"]*)"', drawn(panel(Curve(ONE, 5 * ONE))))
    assert [float(word) for word in inner.split()] == frame(drawn(panel(Curve(ONE, 5 * ONE))))


def test_each_legend_lists_only_what_no_earlier_panel_has():
    first = panel(Curve(ONE, ONE, label="both"))
    second = panel(Curve(ONE, ONE, label="both"), Curve(ONE, ONE, "c1", label="second"))
    for beside in (False, True):
        words = texts(drawn(first, second, beside=beside))
        assert words.count("both") == words.count("second") == 1


def test_long_legends_get_more_lines():
    layers = [Curve(ONE, ONE, label=f"{'long ' * 8}{n}") for n in range(6)]
    few, many = (frame(drawn(panel(*layers[:n])))[1] for n in (1, 6))
    assert many >= few + 18


def test_names_are_text():
    nasty = "<b>&\x1b$\\frac"
    document = drawn(panel(Words(ONE, ONE, (nasty, "")), title=nasty, note=nasty))
    assert texts(document).count("<b>&\\x1b$\\frac") == 3
    assert "aria-label" in svg.inline(Figure(nasty, nasty, (panel(),)))


@pytest.mark.parametrize("values", [[1e-5, 7e-5], [0.0123, 0.0124], [0.1, 0.9]])
def test_the_title_of_an_axis_stands_clear_of_its_labels(values):
    axis = percentile_axis("background (MHz)", [np.linspace(*values, 50)])
    document = drawn(panel(y=axis, height=110))
    labels = re.findall(r'<text class="t e" x="([\d.]+)" y="[\d.]+">([^<]+)<', document)
    title = float(re.search(r'x="([\d.]+)"[^>]*>background', document)[1])
    # Letters are 7 wide, and half the height of the title is 7.
    assert title >= 7.0
    assert all(title + 7.0 <= float(end) - 7.0 * len(label) for end, label in labels)


def test_ticks_are_round_and_have_equal_decimals():
    words = texts(drawn(panel(y=Axis("up", -0.13, 0.93))))
    assert {"0.0", "0.2", "0.4", "0.6", "0.8"} <= set(words)
    assert "\u22121" in texts(drawn(panel(y=Axis("up", -1.3, 1.4))))


def test_panels_that_share_an_axis_are_labelled_once():
    lower = panel()
    upper = Panel(lower.x, lower.y, ())
    assert texts(drawn(upper, lower)).count("across") == 1
    assert texts(drawn(panel(), panel(y=Axis("u", 0, 2)), beside=True)).count("across") == 2


@pytest.mark.parametrize("palette", Palette)
def test_images_hold_their_pixels_and_the_scale_becomes_lighter(palette):
    values = np.array([[0.0, 0.5, 1.0], [np.nan, 0.25, 0.75]])
    encoded = drawn(panel(Image(pixels.steps(values), palette), bar=Axis("bar", 1.0, 2.0)))
    first, ramp = re.findall(r"base64,([^\"]*)", encoded)
    image = Pictures.open(io.BytesIO(base64.b64decode(first)))
    np.testing.assert_array_equal(np.asarray(image), pixels.steps(values))
    assert np.asarray(image.convert("RGBA"))[1, 0, 3] == 0
    colours = np.asarray(Pictures.open(io.BytesIO(base64.b64decode(ramp))).convert("RGB"))[:, 0]
    luminance = colours @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) < 1.0).all()
    assert luminance[0] > 180
    rejected = drawn(panel(Image(np.array([[2, 1]], dtype=np.uint8), palette)))
    (stripes,) = re.findall(r"base64,([^\"]*)", rejected)
    grey = np.asarray(Pictures.open(io.BytesIO(base64.b64decode(stripes))).convert("RGB"))[0]
    assert np.abs(colours[:, None].astype(int) - grey).max(axis=-1).min() > 40
    assert "bar" in texts(encoded)


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 99))
def test_narrow_images_lose_no_data(columns, most, seed):
    image = np.random.default_rng(seed).choice([pixels.BLANK, 7, 8], (3, columns)).astype(np.uint8)
    narrow = pixels.narrowed(image, most)
    size = -(-columns // most)
    assert narrow.shape == (3, -(-columns // size))
    for place in range(narrow.shape[1]):
        for row, pixel in zip(image[:, place * size :][:, :size], narrow[:, place], strict=True):
            assert pixel == next((value for value in row if value != pixels.BLANK), pixels.BLANK)


def test_a_second_axis_stands_at_the_right():
    document = drawn(panel(right=Axis("altitude", 100.0, 300.0)))
    assert {"altitude", "200"} <= set(texts(document))
    assert frame(document)[2] < frame(drawn(panel()))[2]


@pytest.mark.parametrize("whole", [svg.WIDTH, svg.NARROW])
def test_a_figure_below_another_one_has_its_horizontal_axis(whole):
    line = Curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    scaled = panel(line, right=Axis("altitude (km)", 0.0, 2.0))
    below = panel(line, height=80.0)
    first, second = (
        frame(svg.file(one, whole).decode())
        for one in (figure(scaled), figure(below, above=(scaled,)))
    )
    assert (second[0], second[2]) == (first[0], first[2])


def test_thumbnails_are_small_and_without_axes():
    many = np.linspace(0.0, 1.0, 5000)
    for layer in (Curve(many, many), Image(np.full((306, 780), 9, dtype=np.uint8))):
        small = svg.thumbnail(figure(panel(layer)))
        assert len(small) < 8000
        assert texts(small) == []
    assert texts(svg.thumbnail(None, "nothing <here>")) == ["nothing <here>"]


def test_axes_of_data():
    values = [np.array([1.0, 2.0, 3.0, np.nan]), np.array([np.inf])]
    axis = percentile_axis("name", values, share=0.0, room=0.5)
    assert (axis.low, axis.high) == (0.0, 4.0)
    for values in ([np.array([])], [np.array([5.0, 5.0])], [np.array([np.nan])]):
        for axis in (percentile_axis("name", values), decade_axis("name", values)):
            assert axis.low < axis.high
            drawn(panel(y=axis))
    wide = decade_axis("name", [np.array([-1.0, *[1e-30] * 9, 1.0])])
    assert wide.low == pytest.approx(1e-5 * wide.high)


def test_units_have_superscripts():
    assert units("m-1 sr-1") == "m⁻¹ sr⁻¹"
    assert units("MHz m2") == "MHz m²"
    assert units("1") == "1"


def narrow(*panels, **options):
    return svg.file(figure(*panels, **options), svg.NARROW).decode()


def test_a_narrow_figure_has_panels_below_each_other():
    pair = (panel(Curve(ONE, ONE)), panel(Curve(ONE, ONE)))
    wide, small = drawn(*pair, beside=True), narrow(*pair, beside=True)
    assert f'width="{svg.NARROW}"' in small
    tops = [
        [float(y) for y in re.findall(r'<svg x="[\d.]+" y="([\d.]+)"', document)]
        for document in (wide, small)
    ]
    assert tops[0][0] == tops[0][1]
    assert tops[1][1] > tops[1][0] + 100


def test_labels_of_a_narrow_figure_do_not_touch():
    ticks = tuple(Tick(float(k), f"{k:02d}:00") for k in range(13))
    one = Panel(Axis("time", 0.0, 12.0, ticks=ticks), Axis("up", 0.0, 1.0), (Curve(ONE, ONE),))
    assert {tick.label for tick in ticks} <= set(texts(drawn(one)))
    shown = [text for text in texts(narrow(one)) if text and text.endswith(":00")]
    assert shown == [f"{k:02d}:00" for k in range(0, 13, 2)]


def test_a_map_keeps_its_shape():
    flat = Panel(Axis("east", 0.0, 2.0), Axis("north", 0.0, 1.0), (), height=434, to_scale=True)
    for document in (drawn(flat), narrow(flat)):
        _, _, width, height = frame(document)
        assert width / height == pytest.approx(2.0, rel=0.01)


def test_a_page_gets_both_widths():
    markup = str(svg.inline(figure(panel(Curve(ONE, ONE)))))
    assert re.findall(r'class="fig (\w+)"', markup) == ["wide", "narrow"]


def labels(document):
    """Return the words of a figure with their horizontal positions."""
    elements = [element for element in ET.fromstring(document).iter() if "text" in element.tag]
    return {element.text: float(element.get("x")) for element in elements}


@pytest.mark.parametrize("width", [svg.WIDTH, svg.NARROW])
def test_a_date_at_the_end_of_an_axis_is_within_the_figure(width):
    ticks = (Tick(0.0, "22:30\n2024-09-21"), Tick(1.0, "00:00\n2024-09-22"))
    shown = Panel(Axis("time", 0.0, 1.0, ticks=ticks), Axis("up", 0.0, 1.0), (Curve(ONE, ONE),))
    document = svg.file(figure(shown), width).decode()
    # A digit of 13 px is at most 8.3 px wide.
    assert labels(document)["2024-09-22"] + 5 * 8.2 <= width


def test_the_title_of_an_axis_at_the_right_is_beside_its_labels():
    document = drawn(panel(Curve(ONE, ONE), right=Axis("altitude (km)", 2.5, 15.0), height=240))
    shown = labels(document)
    # Letters of 13 px: 8.3 px wide, and 10 px high above the line of the title.
    assert shown["altitude (km)"] - 10.0 > shown["10.0"] + 3 * 8.3 + 4.2


def test_each_axis_has_a_scale():
    """As of aerosol extinction of a Raman product: the only multiple of 200 in it is 0."""
    shown = [
        Panel(Axis("across", -160.0, 190.0), Axis("up", 0.0, 1.0), (Curve(ONE, ONE),))
        for _ in range(3)
    ]
    words = texts(drawn(*shown, beside=True))
    assert words.count("0") >= 3
    assert words.count("100") == 3

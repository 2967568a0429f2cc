"""Figures of homogeneous products and signals show values, flags, truth and gaps."""

from __future__ import annotations

import io
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from PIL import Image
from support.products import fabricated as fab
from support.products.fabricated import (
    CHANNEL,
    SECTIONS,
    START,
    homogeneous,
    signal,
    times,
    truth_of,
)

from lidarops.errors import ProductError
from lidarops.figures import product_figures
from lidarops.figures.raster import COLUMNS, read_raster
from lidarops.figures.series_data import join
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.products.homogeneous import report_figures
from lidarops.products.homogeneous.figure_data import read_sections
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

INSTRUMENT = {"instrument": "horizontal", "channel": CHANNEL}


def sections_of(products, truth=None, **options):
    return join(
        section for product in products for section in read_sections(product, truth, **options)
    )


def retrieval(products, truth=None, *, title="", **options):
    return report_figures.draw_retrieval(sections_of(products, truth, **options), title=title)


def truth_comparison(products, truth, **options):
    return report_figures.draw_comparison(sections_of(products, truth, **options))


def quicklook(products, *, title=""):
    profiles = -(-sum(product.sizes["time"] for product in products) // COLUMNS)
    rasters = [read_raster(product, profiles=profiles) for product in products]
    return product_figures.draw_image(rasters, title=title)


def lines(panel, gid):
    return [line for line in panel.get_lines() if line.get_gid() == gid]


def legend_texts(panel):
    return [text.get_text() for text in panel.get_legend().get_texts()]


def picture(figure):
    return np.asarray(Image.open(io.BytesIO(product_figures.render(figure).png)).convert("RGB"))


class TestRetrieval:
    def test_lines_hold_the_unflagged_values_in_km(self):
        product = homogeneous(times(START, 100, 300.0), flagged=0.2)
        upper, lower = retrieval([product]).axes
        assert upper.get_ylabel() == "extinction (km$^{-1}$)"
        assert lower.get_ylabel() == "background (MHz)"
        for panel, name, scale in ((upper, "extinction", 1e3), (lower, "background", 1.0)):
            drawn = lines(panel, f"values-{name}")
            assert len(drawn) == len(SECTIONS)
            for k, line in enumerate(drawn):
                good = product["quality_flag"].values[:, k] == 0
                values = line.get_ydata()
                np.testing.assert_allclose(
                    values[np.isfinite(values)], scale * product[name].values[good, k], rtol=1e-6
                )

    def test_error_bars_are_one_standard_error(self):
        product = homogeneous(times(START, 50, 300.0), flagged=0.0, sections=SECTIONS[:1])
        panel = retrieval([product]).axes[0]
        (bars,) = panel.containers
        segments = np.array(bars.lines[2][0].get_segments())
        half = (segments[:, 1, 1] - segments[:, 0, 1]) / 2
        expected = 1e3 * product["extinction_standard_error"].values[:, 0]
        np.testing.assert_allclose(half, expected, rtol=1e-5)

    def test_many_profiles_get_a_band_of_their_means(self):
        product = homogeneous(times(START, 4000, 20.0), flagged=0.0, sections=SECTIONS[:1])
        panel = retrieval([product]).axes[0]
        (line,) = lines(panel, "values-extinction")
        assert 1300 <= line.get_ydata().size <= 1500
        (band,) = panel.collections
        height = np.ptp(band.get_paths()[0].vertices[:, 1])
        assert height >= np.ptp(line.get_ydata())
        assert any("means of 3 profiles" in text for text in legend_texts(panel))

    def test_flagged_values_are_hollow_grey_crosses(self):
        product = homogeneous(times(START, 200, 300.0), flagged=0.3)
        panel = retrieval([product]).axes[0]
        rejected = (product["quality_flag"].values & flags_of("homogeneous").rejecting) != 0
        value = 1e3 * product["extinction"].values[rejected]
        (marks,) = lines(panel, "flagged-extinction")
        assert marks.get_marker() == "X"
        assert marks.get_markerfacecolor() == "none"
        drawn = marks.get_ydata()
        assert drawn.size == np.isfinite(value).sum()
        low, high = panel.get_ylim()
        expected = np.clip(value[np.isfinite(value)], low, high)
        np.testing.assert_allclose(np.sort(drawn), np.sort(expected), rtol=1e-5)
        (text,) = [text for text in legend_texts(panel) if "do not use" in text]
        beyond = int(((value < low) | (value > high)).sum())
        assert text.split("\n") == [
            f"flagged, do not use: {rejected.sum()}",
            f"{beyond} off the axis, drawn at its edge",
            f"{np.isnan(value).sum()} without a value",
        ]

    def test_values_to_use_with_care_are_circles_on_the_axis(self):
        product = homogeneous(times(START, 40, 300.0), flagged=0.0, sections=SECTIONS[:1])
        product["quality_flag"].values[[3, 9], 0] = int(Quality.OUTLIER)
        product["extinction"].values[9, 0] = 9e-4
        panel = retrieval([product]).axes[0]
        (marks,) = lines(panel, "care-extinction")
        np.testing.assert_allclose(
            marks.get_ydata(), 1e3 * product["extinction"].values[[3, 9], 0], rtol=1e-6
        )
        assert panel.get_ylim()[1] > 0.9
        assert not lines(panel, "flagged-extinction")

    def test_marks_take_no_room_from_the_panels(self):
        product = homogeneous(times(START, 3, 60.0), flagged=0.0)
        product["quality_flag"].values[1, 1] = int(Quality.NO_SIGNAL)
        product["extinction"].values[1, 1] = np.nan
        figure = retrieval([product])
        product_figures.render(figure)
        heights = [panel.get_position().height for panel in figure.axes]
        assert sum(heights) > 0.6

    def test_flagged_values_do_not_set_the_axis(self):
        product = homogeneous(times(START, 40, 300.0), flagged=0.0)
        product["quality_flag"].values[5, 0] = int(HomogeneousQuality.AT_BOUND)
        product["extinction"].values[5, 0] = 5.0
        assert retrieval([product]).axes[0].get_ylim()[1] < 0.5

    def test_truth_is_drawn(self):
        time = times(START, 60, 300.0)
        upper, lower = retrieval([homogeneous(time)], truth_of(time), **INSTRUMENT).axes
        for line in lines(upper, "truth-extinction"):
            np.testing.assert_allclose(line.get_ydata(), 1e3 * fab.true_extinction(time))
        for line in lines(lower, "truth-background"):
            np.testing.assert_allclose(line.get_ydata(), fab.true_background(time))
        assert legend_texts(upper).count("simulated truth") == 1
        assert not lines(retrieval([homogeneous(time)]).axes[0], "truth-extinction")

    def test_each_legend_lists_only_what_the_other_lacks(self):
        time = times(START, 60, 300.0)
        truth = truth_of(time)
        truth["extinction"][:] = np.nan
        upper, lower = retrieval([homogeneous(time)], truth, **INSTRUMENT).axes
        assert "simulated truth" not in legend_texts(upper)
        assert "simulated truth" in legend_texts(lower)
        assert not set(legend_texts(upper)) & set(legend_texts(lower))

    def test_no_line_bridges_a_gap(self):
        time = np.concatenate([times(START, 20, 60.0), times(START + timedelta(hours=1), 20, 60.0)])
        product = homogeneous(time, flagged=0.0)
        (line, _) = lines(retrieval([product]).axes[0], "values-extinction")
        assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [20]

    def test_one_profile_and_all_flagged_and_all_missing(self):
        product_figures.render(retrieval([homogeneous(times(START, 1, 60.0), flagged=0.0)]))
        product = homogeneous(times(START, 5, 60.0))
        product["quality_flag"][:] = int(HomogeneousQuality.POOR_FIT)
        product_figures.render(retrieval([product]))
        for name in ("extinction", "background"):
            product[name][:] = np.nan
        figure = retrieval([product])
        product_figures.render(figure)
        assert "5 of 5 flagged" in product_figures.alt_text(figure)

    def test_foreign_product_is_refused(self):
        with pytest.raises(ProductError, match="extinction"):
            retrieval([signal(times(START, 3, 60.0))])


class TestComparison:
    def test_points_are_normalised_errors_of_unflagged_values(self):
        time = times(START, 300, 60.0)
        product = homogeneous(time, flagged=0.2)
        figure = truth_comparison([product], truth_of(time), **INSTRUMENT)
        assert len(figure.axes) == 3
        for k, line in enumerate(lines(figure.axes[0], "score-extinction")):
            good = product["quality_flag"].values[:, k] == 0
            score = (product["extinction"].values[:, k] - fab.true_extinction(time)) / product[
                "extinction_standard_error"
            ].values[:, k]
            np.testing.assert_allclose(line.get_ydata(), score[good], rtol=1e-4, atol=1e-4)
            share = np.mean(np.abs(score[good]) <= 3)
            assert f"{100 * share:.1f}" in line.get_label().replace("100 %", "100.0 %")
            assert f"of {good.sum()} within 3" in line.get_label()
        levels = [line.get_ydata()[0] for line in figure.axes[0].get_lines() if not line.get_gid()]
        assert {-3.0, 0.0, 3.0} <= set(levels)

    def test_far_off_values_are_drawn_at_the_edge_and_counted(self):
        time = times(START, 20_000, 4.0)
        product = homogeneous(time, flagged=0.0, sections=SECTIONS[:1])
        product["extinction"].values[777, 0] += 1.0
        panel = truth_comparison([product], truth_of(time), **INSTRUMENT).axes[0]
        (line,) = lines(panel, "score-extinction")
        assert line.get_ydata().max() == 10.0
        assert line.get_ydata().size < 8000
        assert "1 beyond 10, drawn there" in line.get_label()

    def test_without_a_truth_there_is_a_note(self):
        time = times(START, 5, 60.0)
        figure = truth_comparison([homogeneous(time)], truth_of(time), instrument="none")
        product_figures.render(figure)
        assert "no unflagged value has a truth" in product_figures.alt_text(figure)


class TestQuicklook:
    def test_colours_are_the_signal_and_flags_are_black(self):
        product = signal(times(START, 48, 1800.0), bins=300)
        figure = quicklook([product], title="vertical")
        image, below = figure.axes[:2]
        mesh, flagged = (item for item in image.collections if isinstance(item, QuadMesh))
        flag = product["quality_flag"].values
        usable = (flag & flags_of("signal").rejecting) == 0
        shown = mesh.get_array().T
        low = mesh.norm.vmin
        expected = product["signal"].values[:, : shown.shape[1]]
        usable = usable[:, : shown.shape[1]]
        np.testing.assert_allclose(
            shown[usable], np.where(expected <= 0, low, expected)[usable], rtol=1e-5
        )
        assert shown.mask[~usable].all()
        assert flagged.get_gid() == "flagged-signal"
        np.testing.assert_array_equal(~np.ma.getmaskarray(flagged.get_array().T), ~usable)
        assert flagged.get_cmap()(0.5)[:3] == (0.0, 0.0, 0.0)
        assert mesh.norm.vmin > 0
        assert "MHz m$^2$" in figure.axes[-1].get_ylabel()
        (line,) = lines(below, "values-background")
        np.testing.assert_allclose(line.get_ydata(), product["background"].values, rtol=1e-6)

    def test_the_colours_of_the_signal_exclude_black(self):
        product = signal(times(START, 24, 3600.0), bins=200)
        (mesh, _) = (c for c in quicklook([product]).axes[0].collections)
        luminance = mesh.get_cmap()(np.linspace(0, 1, 256))[:, :3] @ [0.2126, 0.7152, 0.0722]
        assert (np.diff(luminance) > -1e-3).all()
        assert luminance.min() > 0.15

    def test_gaps_in_time_are_white(self):
        time = np.concatenate(
            [times(START, 12, 600.0), times(START + timedelta(hours=4), 12, 600.0)]
        )
        panel = quicklook([signal(time, bins=100)]).axes[0]
        mesh = panel.collections[0]
        edges = mesh.get_coordinates()[0, :, 0] * 24
        (gap,) = np.flatnonzero(np.ma.getmaskarray(mesh.get_array()).all(axis=0))
        np.testing.assert_allclose(edges[gap : gap + 2], [2.0, 4.0], atol=1e-6)

    def test_large_products_are_reduced(self):
        product = signal(times(START, 1600, 20.0), bins=1700, bin_width=3.0)
        panel = quicklook([product]).axes[0]
        rows, columns = panel.collections[0].get_array().shape
        assert rows <= 800
        assert columns <= 1500

    def test_scenes_with_different_grids_share_a_panel(self):
        coarse = signal(times(START, 30, 60.0), bins=200, bin_width=15.0)
        fine = signal(times(START + timedelta(minutes=30), 30, 60.0), bins=800, bin_width=7.5)
        panel = quicklook([coarse, fine]).axes[0]
        assert panel.get_ylim()[1] <= 6.0
        assert {mesh.get_array().shape[0] for mesh in panel.collections[::2]} >= {200}

    @pytest.mark.parametrize("value", [-1.0, np.nan, 0.0])
    def test_an_empty_panel_has_a_note(self, value):
        product = signal(times(START, 5, 60.0), bins=40)
        product["signal"][:] = value
        figure = quicklook([product])
        product_figures.render(figure)
        assert "no usable signal above zero" in [t.get_text() for t in figure.axes[0].texts]

    def test_altitude_stands_beside_range(self):
        figure = quicklook([signal(times(START, 5, 60.0), bins=40)])
        (beside,) = figure.axes[0].child_axes
        product_figures.render(figure)
        assert beside.get_ylabel() == "altitude (km)"
        low, high = figure.axes[0].get_ylim()
        np.testing.assert_allclose(beside.get_ylim(), [0.12 + 0.94 * low, 0.12 + 0.94 * high])

    def test_share_with_care_is_that_of_the_product(self):
        product = signal(times(START, 60, 60.0), bins=4000, bin_width=15.0)
        share = ((product["quality_flag"].values & int(Quality.PILE_UP)) != 0).mean()
        assert share > 0.0015
        words = product_figures.alt_text(quicklook([product]))
        assert f"{100 * share:.1f} % of all bins: use with care (pile_up)" in words

    def test_far_noise_is_left_out_with_a_note(self):
        figure = quicklook([signal(times(START, 60, 60.0), bins=4000, bin_width=15.0)])
        assert figure.axes[0].get_ylim()[1] < 30.0
        assert "of 60 km: noise dominates beyond" in product_figures.alt_text(figure)


class TestFlags:
    def test_cells_hold_the_shares(self):
        shares = {
            "a $x$": {"saturated": 0.0, "poor_fit": 0.25, "outlier *": 0.0001},
            "b": {"saturated": 1.0, "no_signal": 0.0},
        }
        figure = product_figures.flags_overview(shares, title="Flags")
        (panel,) = figure.axes
        product_figures.render(figure)
        assert [label.get_text() for label in panel.get_xticklabels()] == [
            "saturated", "poor_fit", "outlier *",
        ]  # fmt: skip
        assert [label.get_text() for label in panel.get_yticklabels()] == ["a $x$", "b"]
        assert [text.get_text() for text in panel.texts] == [
            "0 %", "25.0 %", "<0.1 %", "100 %", "0 %", "0 %",
        ]  # fmt: skip
        assert "saturated in b" in product_figures.alt_text(figure)

    def test_no_flags_at_all(self):
        figure = product_figures.flags_overview({"a": {}})
        product_figures.render(figure)
        assert "no value carries" in product_figures.alt_text(figure)


class TestOverview:
    def test_is_a_picture_of_1200_by_600(self):
        time = times(START, 96, 900.0)
        product = homogeneous(time, sections=SECTIONS[:1])
        figure = report_figures.overview(
            product, truth_of(time), signal(time, bins=200), instrument="horizontal"
        )
        assert picture(figure).shape == (600, 1200, 3)
        assert lines(figure.axes[0], "truth-extinction")
        assert lines(figure.axes[0], "values-extinction")
        assert figure.axes[1].collections

    def test_signal_and_truth_may_be_absent(self):
        figure = report_figures.overview(homogeneous(times(START, 9, 900.0)), None, None)
        assert len(figure.axes) == 1
        assert picture(figure).shape == (600, 1200, 3)


def test_equal_figures_give_equal_bytes_and_are_not_blank():
    product = homogeneous(times(START, 20, 60.0))
    first, second = (product_figures.render(retrieval([product])) for _ in range(2))
    assert first == second
    assert first.alt.encode() in first.png


def test_titles_are_text_not_formulas():
    product = homogeneous(times(START, 3, 60.0))
    product_figures.render(retrieval([product], title=r"$\broken{ _x^ \name"))


def test_no_global_state_of_matplotlib_is_touched():
    code = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "import matplotlib\n"
        # Reading the parameters in the usual way would choose a backend and load pyplot.
        "def state(): return {k: matplotlib.rcParams._get(k) for k in matplotlib.rcParams}\n"
        "before = state()\n"
        "from support.products import fabricated as fab\n"
        "from lidarops.figures import product_figures as figures\n"
        "from lidarops.figures.raster import read_raster\n"
        "from lidarops.products.homogeneous.figure_data import read_sections\n"
        "from lidarops.products.homogeneous.report_figures import draw_retrieval\n"
        "time = fab.times(fab.START, 5, 60.0)\n"
        "figures.render(draw_retrieval(read_sections(fab.homogeneous(time))))\n"
        "figures.render(figures.draw_image([read_raster(fab.signal(time, bins=40))]))\n"
        "assert state() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parents[1])], check=True)

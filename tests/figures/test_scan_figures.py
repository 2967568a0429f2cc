"""Figures of multi-angle products show values, flags, residuals and truth."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import xarray as xr
from support.products.drawn import figures, images, labelled
from support.products.fabricated import START, Archive, outcome, run_record, times

from lidarops.errors import ProductError
from lidarops.figures.panels import FIRST, Curve
from lidarops.figures.raster import read_raster
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.products.multiangle import figure_data
from lidarops.reports import gallery
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

SCANNER = "plain-scanner"
STATION = 180.0
ALTITUDE = STATION + 300.0 + 50.0 * np.arange(90)
ZENITH = np.array([60.0, 45.0, 30.0, 0.0, 30.0, 45.0, 60.0])
AZIMUTH = np.array([270.0, 270.0, 270.0, 90.0, 90.0, 90.0, 90.0])
REACH = 3500.0
BEAMS = ("time", "beam", "altitude")
BOTH = ("time", "altitude")


def true_extinction(altitude):
    """Return the extinction in m-1 of a boundary layer below cleaner air."""
    return 2e-5 + 1.3e-4 / (1.0 + np.exp((altitude - 1500.0) / 80.0))


def true_depth(altitude):
    """Return the optical depth from the station, the exact integral of `true_extinction`."""

    def below(z):
        return 2e-5 * z - 1.3e-4 * 80.0 * np.log1p(np.exp(-(z - 1500.0) / 80.0))

    return below(altitude) - below(STATION)


def multiangle(cycles=12, *, seed=0, tilt=0.02):
    """Return a multi-angle product whose residuals grow with the sine of the zenith angle."""
    random = np.random.default_rng(seed)
    time = times(START, cycles, 1020.0)
    shape = (cycles, ALTITUDE.size)
    beyond = np.broadcast_to(ALTITUDE > REACH, shape)
    flag = np.where(beyond, int(MultiAngleQuality.EXTRAPOLATED), 0).astype(np.int32)
    flag[:, (ALTITUDE > 1450) & (ALTITUDE < 1600)] |= int(MultiAngleQuality.PRIOR_DOMINATED)
    flag[:, ALTITUDE < 600] |= int(MultiAngleQuality.POOR_STRATIFICATION)
    depth_error = np.broadcast_to(0.002 + 1e-6 * ALTITUDE, shape)
    error = np.broadcast_to(4e-6 + 2e-9 * ALTITUDE, shape)
    depth = true_depth(ALTITUDE) + depth_error * random.standard_normal(shape)
    extinction = true_extinction(ALTITUDE) + error * random.standard_normal(shape)
    depth, extinction = np.where(beyond, np.nan, depth), np.where(beyond, np.nan, extinction)
    slant = np.sin(np.radians(ZENITH)) * np.where(AZIMUTH == 90.0, 1.0, -1.0)
    residual = tilt * slant[None, :, None] + 0.01 * random.standard_normal(
        (cycles, ZENITH.size, ALTITUDE.size)
    )
    residual = np.where(beyond[:, None, :], np.nan, residual)
    per_m = {"units": "m-1"}
    dimensionless = {"units": "1"}
    return xr.Dataset(
        {
            "vertical_optical_depth": (BOTH, depth, dimensionless),
            "vertical_optical_depth_standard_error": (BOTH, depth_error, dimensionless),
            "vertical_optical_depth_gradient_error": (BOTH, 0.5 * depth_error, dimensionless),
            "total_extinction": (BOTH, extinction, per_m),
            "total_extinction_standard_error": (BOTH, error, per_m),
            "total_extinction_gradient_error": (BOTH, 2.0 * error, per_m),
            "data_share": (BOTH, np.ones(shape)),
            "inhomogeneity": (BOTH, np.full(shape, 0.01)),
            "reach": ("time", np.full(cycles, REACH), {"units": "m"}),
            "residual": (BEAMS, residual),
            "quality_flag": (BOTH, flag),
        },
        coords={
            "time": ("time", time),
            "altitude": ("altitude", ALTITUDE, {"units": "m"}),
            "beam_zenith_angle": ("beam", ZENITH, {"units": "degree"}),
            "beam_azimuth": ("beam", AZIMUTH, {"units": "degree"}),
            "station_altitude": ((), STATION, {"units": "m"}),
            "wavelength": ((), 532.0, {"units": "nm"}),
        },
    )


def truth_of(product, *, instrument="plain-scanner", zenith=(60.0, 30.0, 45.0)):
    """Return a truth with one file per cycle and zenith angle, given along its beam."""
    middles = np.repeat(product["time"].values, len(zenith))
    time = middles + np.tile(np.arange(len(zenith)) * 60, product.sizes["time"]).astype(
        "timedelta64[s]"
    )
    angle = np.tile(zenith, product.sizes["time"])
    end = 100.0 * np.arange(1, 81)
    # Files of another instrument come first, so that rows of profiles differ from rows of files.
    other = 4
    upright = np.cos(np.radians(angle))[:, None]
    depth = true_depth(STATION + end * upright) / upright
    cells = np.diff(depth, axis=1, prepend=0.0) / 100.0
    suffix = instrument.replace("-", "_")
    dims = (f"profile_{suffix}", f"wavelength_{suffix}", f"range_{suffix}")

    def filled(values, first):
        return np.concatenate([np.repeat(first, other), values])

    return xr.Dataset(
        {
            "path": ("granule", np.array([f"m{i}" for i in range(other + time.size)], object)),
            "instrument": ("granule", np.array(["other"] * other + [instrument] * time.size)),
            "time": ("granule", filled(time, time[0])),
            "zenith_angle": ("granule", filled(angle, 0.0)),
            "total_extinction": ("granule", np.full(other + time.size, np.nan)),
            f"profile_granule_{suffix}": (dims[0], other + np.arange(time.size)),
            f"range_end_{suffix}": (dims[2], end),
            f"profile_total_extinction_{suffix}": (dims, np.stack([0 * cells, cells], axis=1)),
            f"profile_path_optical_depth_{suffix}": (dims, np.stack([0 * depth, depth], axis=1)),
        },
        coords={
            f"wavelength_{suffix}": (dims[1], [355e-9, 532e-9]),
            f"range_{suffix}": (dims[2], end - 50.0),
        },
    )


def drawn(product, truth=None):
    (figure,) = figures("multiangle", "scan-profile", [product], truth=truth, instrument=SCANNER)
    return figure


def residual_figure(product):
    (figure,) = figures("multiangle", "scan-residuals", [product])
    return figure


class TestClearestCycle:
    def test_most_unflagged_values_win(self):
        product = multiangle()
        product["quality_flag"][7] = np.where(
            ALTITUDE > REACH, int(MultiAngleQuality.EXTRAPOLATED), 0
        )
        profile = figure_data.clearest_cycle(product)
        assert profile.time == product["time"].values[7]
        assert profile.altitude[-1] <= ALTITUDE[0] + 1.15 * (REACH - ALTITUDE[0])
        assert profile.altitude[-1] > REACH

    def test_where_all_carry_a_bit_of_care_rejections_decide_then_the_first(self):
        product = multiangle(cycles=4)
        flag = np.full((4, ALTITUDE.size), int(MultiAngleQuality.LOW_LEVERAGE))
        flag[0, :5] |= int(MultiAngleQuality.POOR_STRATIFICATION)
        flag[:, ALTITUDE > REACH] |= int(MultiAngleQuality.EXTRAPOLATED)
        product["quality_flag"] = (BOTH, flag)
        assert figure_data.clearest_cycle(product).time == product["time"].values[1]

    def test_where_all_are_rejected_the_cycle_with_most_values_is_shown(self):
        product = multiangle()
        product["quality_flag"][:] = int(MultiAngleQuality.POOR_STRATIFICATION)
        product["vertical_optical_depth"][:9, :3] = np.nan
        profile = figure_data.clearest_cycle(product)
        assert profile.time == product["time"].values[9]
        assert np.isnan(profile.estimates["total_extinction"].value).all()
        for panel in drawn(product).panels:
            (marks,) = labelled(panel, "do not use")
            assert ((marks.x >= panel.x.low) & (marks.x <= panel.x.high)).mean() > 0.9
        panel = drawn(product, truth_of(product)).panels[0]
        assert panel.x.low < 0.0 < panel.x.high

    def test_nothing_where_there_is_no_value(self):
        product = multiangle()
        product["vertical_optical_depth"][:] = np.nan
        assert figure_data.clearest_cycle(product) is None
        assert figure_data.clearest_cycle(multiangle().isel(time=slice(0))) is None

    def test_values_that_a_bit_rejects_are_kept_apart(self):
        product = multiangle()
        profile = figure_data.clearest_cycle(product)
        low = profile.altitude < 600
        for estimate in profile.estimates.values():
            assert np.isnan(estimate.value[low]).all()
            assert np.isfinite(estimate.rejected[low]).all()
            assert np.isnan(estimate.rejected[~low]).all()
        assert not profile.with_care[low].any()

    def test_everything_is_shown_where_there_is_no_reach(self):
        product = multiangle()
        product["reach"][:] = np.nan
        assert figure_data.clearest_cycle(product).altitude.size == ALTITUDE.size

    def test_a_fill_value_in_the_flags_means_missing(self):
        product = multiangle()
        product["quality_flag"] = product["quality_flag"].astype(np.float64)
        product["quality_flag"][:, 20] = np.nan
        profile = figure_data.clearest_cycle(product)
        assert profile.flag[20] == int(Quality.INPUT_MISSING)
        assert np.isnan(profile.estimates["vertical_optical_depth"].value[20])


def test_values_whose_errors_would_hide_all_others_do_not_set_the_axis():
    """A tenth of the altitudes, with errors of 200 per km, as in real scans far from the lidar."""
    product = multiangle()
    noisy = (ALTITUDE > REACH - 400.0) & (ALTITUDE <= REACH)
    error = product["total_extinction_standard_error"]
    product["total_extinction_standard_error"] = error.where(~noisy, 0.2)
    clear = drawn(multiangle()).panels[1].x
    axis = drawn(product).panels[1].x
    assert axis.high - axis.low < 1.2 * (clear.high - clear.low)


class TestTruth:
    def test_the_file_nearest_to_the_zenith_is_taken(self):
        product = multiangle()
        profile = figure_data.clearest_cycle(product, truth_of(product), instrument="plain-scanner")
        assert profile.truth.zenith_angle == 30.0
        assert profile.truth.time == profile.time + np.timedelta64(60, "s")

    @pytest.mark.parametrize("zenith", [0.0, 30.0, -60.0, 75.0])
    def test_in_level_layers_any_beam_gives_the_vertical_profile(self, zenith):
        product = multiangle(cycles=3)
        truth = truth_of(product, zenith=(zenith,))
        profile = figure_data.true_profile(product, 1, truth, instrument="plain-scanner")
        assert profile.edges[0] == STATION
        np.testing.assert_allclose(
            profile.optical_depth, true_depth(profile.edges), rtol=1e-9, atol=1e-9
        )
        np.testing.assert_allclose(
            profile.extinction,
            np.diff(true_depth(profile.edges)) / np.diff(profile.edges),
            rtol=1e-6,
        )
        assert profile.time == product["time"].values[1]

    def test_no_truth_near_the_horizon_far_off_in_time_or_of_another_kind(self):
        product = multiangle(cycles=3)
        for truth in (
            truth_of(product, zenith=(85.0,)),
            truth_of(product, instrument="other"),
            truth_of(product).drop_vars("zenith_angle"),
            truth_of(product.assign_coords(time=product["time"] + np.timedelta64(3, "h"))),
        ):
            assert figure_data.true_profile(product, 1, truth, instrument="plain-scanner") is None
        truth = truth_of(product)
        for other in (
            product.drop_vars("station_altitude"),
            product.assign_coords(wavelength=1064.0),
            product.drop_vars("wavelength"),
        ):
            assert figure_data.true_profile(other, 1, truth, instrument="plain-scanner") is None

    def test_bounds_of_the_cycle_limit_the_time_of_the_truth(self):
        product = multiangle(cycles=1)
        truth = truth_of(product, zenith=(30.0,))
        truth["time"] = truth["time"] + np.timedelta64(10, "m")
        assert figure_data.true_profile(product, 0, truth, instrument="plain-scanner") is None
        half = np.timedelta64(510, "s")
        middle = product["time"].values
        product["time_bnds"] = (("time", "nv"), np.stack([middle - half, middle + half], axis=1))
        assert figure_data.true_profile(product, 0, truth, instrument="plain-scanner") is not None

    def test_half_a_minute_before_is_no_minus_zero(self):
        product = multiangle(cycles=1)
        truth = truth_of(product, zenith=(30.0,))
        truth["time"] = truth["time"] - np.timedelta64(20, "s")
        (line,) = labelled(drawn(product, truth).panels[0], "truth")
        assert line.label.endswith(", +0 min")

    def test_a_wavelength_in_metres_is_understood(self):
        product = multiangle(cycles=2)
        product = product.assign_coords(wavelength=((), 532e-9, {"units": "m"}))
        truth = truth_of(product)
        assert figure_data.true_profile(product, 0, truth, instrument="plain-scanner") is not None


class TestProfileFigure:
    @pytest.mark.parametrize(
        ("place", "quantity", "scale"),
        [(0, "vertical_optical_depth", 1.0), (1, "total_extinction", 1e3)],
    )
    def test_lines_and_bands_hold_values_and_errors(self, place, quantity, scale):
        product = multiangle()
        panel = drawn(product).panels[place]
        (line,) = labelled(panel, "retrieved")
        chosen = product.isel(time=0, altitude=slice(0, line.x.size))
        use = (chosen["quality_flag"].values & flags_of("multiangle").rejecting) == 0
        np.testing.assert_array_equal(np.isfinite(line.x), use)
        np.testing.assert_allclose(line.x[use], scale * chosen[quantity].values[use])
        np.testing.assert_allclose(line.y, chosen["altitude"].values / 1e3)
        error = scale * chosen[f"{quantity}_standard_error"].values[20]
        gradient = scale * chosen[f"{quantity}_gradient_error"].values[20]
        for words, expected in (("standard", error), ("largest gradient", error + gradient)):
            (band,) = labelled(panel, words)
            assert (band.high - band.low)[20] / 2 == pytest.approx(expected)

    def test_the_error_of_the_dead_time_is_part_of_the_standard_error(self):
        product = multiangle()
        for number, quantity in enumerate(figure_data.QUANTITIES):
            error = product[f"{quantity}_standard_error"]
            product[f"{quantity}_dead_time_error"] = 3.0 * error
            scale = (1.0, 1e3)[number]
            panel = drawn(product).panels[number]
            (band,) = labelled(panel, "standard error, with the dead time")
            expected = scale * np.sqrt(10.0) * error.values[0, 20]
            assert (band.high - band.low)[20] / 2 == pytest.approx(expected)
            (band,) = labelled(panel, "largest gradient")
            expected += scale * product[f"{quantity}_gradient_error"].values[0, 20]
            assert (band.high - band.low)[20] / 2 == pytest.approx(expected)

    def test_flagged_values_and_missing_ones_are_marked_at_their_altitude(self):
        for panel in drawn(multiangle()).panels:
            (marks,) = labelled(panel, "do not use")
            np.testing.assert_allclose(1e3 * marks.y, ALTITUDE[ALTITUDE < 600])
            (marks,) = labelled(panel, "use with care")
            care = ALTITUDE[(ALTITUDE > 1450) & (ALTITUDE < 1600)]
            np.testing.assert_allclose(1e3 * marks.y, care)
            assert marks.label == f"use with care: {care.size} altitudes"
            (marks,) = labelled(panel, "no value")
            assert (1e3 * marks.y > REACH).all()

    def test_without_flags_there_are_no_marks(self):
        product = multiangle().sel(altitude=slice(None, REACH))
        product["quality_flag"][:] = 0
        for panel in drawn(product).panels:
            assert not any(getattr(layer, "mark", None) for layer in panel.layers)

    def test_a_rejected_value_far_off_does_not_set_the_axis(self):
        product = multiangle()
        product["total_extinction"][:, 0] = 1.0
        assert drawn(product).panels[1].x.high < 1.0

    def test_the_reach_is_a_line_where_there_is_one(self):
        for panel in drawn(multiangle()).panels:
            (line,) = labelled(panel, "reach")
            assert set(line.y) == {REACH / 1e3}
        product = multiangle()
        product["reach"][:] = np.nan
        assert not labelled(drawn(product).panels[0], "reach")

    def test_the_truth_lies_on_the_curve(self):
        product = multiangle()
        depth, extinction = drawn(product, truth_of(product)).panels
        (line,) = labelled(depth, "truth at zenith angle 30")
        np.testing.assert_allclose(line.x, true_depth(1e3 * line.y), rtol=1e-9, atol=1e-9)
        (steps,) = labelled(extinction, "truth")
        np.testing.assert_allclose(np.trapezoid(steps.x, steps.y), line.x[-1], rtol=1e-9)
        assert not labelled(drawn(product).panels[0], "truth")

    def test_a_cloud_above_the_reach_does_not_set_the_axis(self):
        product = multiangle()
        truth = truth_of(product)
        height = truth["range_plain_scanner"].values * np.cos(np.radians(30.0))
        truth["profile_total_extinction_plain_scanner"].values[
            ..., height > REACH - STATION + 60
        ] = 0.1
        panel = drawn(product, truth).panels[1]
        (cloud,) = labelled(panel, "truth")
        assert cloud.x[cloud.y < panel.y.high].max() == pytest.approx(100.0)
        assert panel.x.high < 1.0

    @pytest.mark.parametrize("error", [1.0, np.nan])
    def test_the_gradient_error_does_not_set_the_axis(self, error):
        product = multiangle()
        product["total_extinction_gradient_error"][:] = error
        panel = drawn(product).panels[1]
        (line,) = labelled(panel, "retrieved")
        assert np.nanmax(line.x) - np.nanmin(line.x) > 0.2 * (panel.x.high - panel.x.low)
        (band,) = labelled(panel, "standard error")
        assert np.isfinite(band.low).any()

    def test_extinction_withheld_where_the_optical_depth_is_known(self):
        product = multiangle()
        product["total_extinction"][:] = np.nan
        assert "Extinction no usable value" in drawn(product).words

    def test_the_description_lists_reach_and_flags(self):
        product = multiangle()
        profile = figure_data.clearest_cycle(product)
        text = drawn(product).text
        flagged = int((profile.flag != 0).sum())
        for part in (
            "2024-03-01 00:08:30 UTC",
            "reach 3.5 km",
            f"{flagged} of {profile.flag.size} altitudes flagged",
            "poor_stratification",
            "prior_dominated",
            "extrapolated",
        ):
            assert part in text


class TestResiduals:
    def test_means_and_rms_are_those_of_the_product_in_percent(self):
        product = multiangle()
        read = figure_data.read_residuals(product)
        residual = 100 * product["residual"].values[..., ALTITUDE <= REACH]
        np.testing.assert_array_equal(read.zenith_angle, [-60, -45, -30, 0, 30, 45, 60])
        np.testing.assert_allclose(read.mean, residual.mean(axis=0).T)
        np.testing.assert_allclose(read.rms, np.sqrt((residual**2).mean(axis=(0, 2))))
        np.testing.assert_allclose(
            read.rms_of_mean, np.sqrt((residual.mean(axis=0) ** 2).mean(axis=1))
        )
        assert read.cycles == 12
        assert read.azimuths == (90.0,)
        np.testing.assert_allclose(read.edges[[0, -1]], [ALTITUDE[0] - 25, REACH + 5], atol=30)

    def test_noise_averages_out_and_a_gradient_does_not(self):
        read = figure_data.read_residuals(multiangle(cycles=100, tilt=0.02))
        upright = int(np.flatnonzero(read.zenith_angle == 0)[0])
        assert read.rms_of_mean[upright] == pytest.approx(0.1, rel=0.3)
        assert read.rms_of_mean[[0, -1]] == pytest.approx(2 * np.sin(np.radians(60)), rel=0.05)
        assert (read.mean[:, 0] < 0).all()
        assert (read.mean[:, -1] > 0).all()

    def test_altitudes_that_few_cycles_reach_count_little(self):
        product = multiangle(cycles=100)
        high = ALTITUDE > 2000
        product["residual"][1:, :, high] = np.nan
        product["residual"][0, :, high] = 0.5
        read = figure_data.read_residuals(product)
        assert (read.rms_of_mean <= read.rms).all()
        residual = 100 * product["residual"].values
        np.testing.assert_allclose(read.rms, np.sqrt(np.nanmean(residual**2, axis=(0, 2))))
        assert 1.5 < residual_figure(product).panels[0].bar.high < 5.0

    def test_rows_join_altitudes_where_there_are_many(self):
        product = multiangle(cycles=2).sel(altitude=slice(None, REACH))
        fine = np.linspace(ALTITUDE[0], REACH, 950)
        product = product.interp(altitude=fine, method="nearest").assign(
            quality_flag=(BOTH, np.zeros((2, 950), dtype=np.int32))
        )
        read = figure_data.read_residuals(product)
        assert read.mean.shape == (95, ZENITH.size)
        assert read.edges.size == 96
        first = 100 * product["residual"].values[:, :, :10].mean(axis=(0, 2))
        np.testing.assert_allclose(read.mean[0], first)

    def test_what_is_zero_by_construction_is_left_out(self):
        product = multiangle()
        product["residual"][:6] = 0.0
        product["quality_flag"][:6] |= int(MultiAngleQuality.NO_RESIDUAL)
        read = figure_data.read_residuals(product)
        assert read.cycles == 6
        kept = 100 * product["residual"].values[6:][..., ALTITUDE <= REACH]
        np.testing.assert_allclose(read.rms, np.sqrt((kept**2).mean(axis=(0, 2))))
        product["quality_flag"][:] |= int(MultiAngleQuality.NO_RESIDUAL)
        assert figure_data.read_residuals(product) is None

    def test_reading_in_parts_changes_nothing(self, monkeypatch):
        product = multiangle()
        whole = figure_data.read_residuals(product)
        monkeypatch.setattr(figure_data, "_READ_BYTES", 1)
        parts = figure_data.read_residuals(product)
        np.testing.assert_allclose(parts.mean, whole.mean)
        np.testing.assert_allclose(parts.rms, whole.rms)
        assert parts.cycles == whole.cycles

    @pytest.mark.parametrize(
        ("zenith", "azimuth", "signed", "planes", "azimuths"),
        [
            # A negative angle points opposite to its azimuth.
            ([-60, 0, 60], [90, 90, 90], [-60, 0, 60], [0, 0, 0], (90.0,)),
            # Azimuths jump at north, planes do not.
            ([30, 40, 50], [359.8, 0.1, 180.0], [-50, 30, 40], [0, 0, 0], (0.1,)),
            ([30, 30, 30, 30], [0, 90, 180, 270], [-30, 30, -30, 30], [0, 0, 1, 1], (0.0, 90.0)),
            ([60, 0, -30], [np.nan] * 3, [-30, 0, 60], [0, 0, 0], (np.nan,)),
            ([30, 50, 40], [90, np.nan, 270], [-40, 30, 50], [0, 0, 1], (90.0, np.nan)),
            ([0, 0], [0, 90], [0, 0], [0, 0], ()),
        ],
    )
    def test_beams_are_sorted_by_plane_and_signed_zenith_angle(
        self, zenith, azimuth, signed, planes, azimuths
    ):
        beams = len(zenith)
        product = multiangle().isel(beam=slice(beams))
        product = product.assign_coords(
            beam_zenith_angle=("beam", np.array(zenith, dtype=float)),
            beam_azimuth=("beam", np.array(azimuth, dtype=float)),
        )
        read = figure_data.read_residuals(product)
        np.testing.assert_array_equal(read.zenith_angle, signed)
        np.testing.assert_array_equal(read.plane, planes)
        np.testing.assert_array_equal(read.azimuths, azimuths)
        upper = residual_figure(product).panels[0]
        assert sum(isinstance(layer, Curve) for layer in upper.layers) == max(planes)
        assert ("not known" in upper.x.label) == bool(np.isnan(azimuths).any())

    def test_the_description_names_planes_and_single_beams_as_they_are_drawn(self):
        product = multiangle().isel(beam=slice(4))
        product = product.assign_coords(
            beam_zenith_angle=("beam", np.array([30.0, 60.0, 70.0, 50.0])),
            beam_azimuth=("beam", np.array([137.0, 62.0, 317.0, np.nan])),
        )
        words = residual_figure(product).words
        assert words.endswith("toward azimuth 62 (one beam), 137, unknown (one beam) degree")

    def test_azimuths_may_be_missing(self):
        read = figure_data.read_residuals(multiangle().drop_vars("beam_azimuth"))
        np.testing.assert_array_equal(read.zenith_angle, np.sort(ZENITH))
        assert np.isnan(read.azimuths).all()

    def test_the_map_holds_the_means_on_a_scale_around_zero(self):
        product = multiangle()
        read = figure_data.read_residuals(product)
        panel, below = residual_figure(product).panels
        limit = panel.bar.high
        assert panel.bar.low == -limit < 0
        (image,) = images(panel)
        shares = (image.codes.T.astype(float) - FIRST) / (255 - FIRST)
        expected = np.clip(0.5 + 0.5 * read.mean / limit, 0, 1)
        np.testing.assert_allclose(shares, expected, atol=0.003)
        np.testing.assert_array_equal(image.edges, read.edges / 1e3)
        single, mean = below.layers
        np.testing.assert_allclose(single.y, read.rms)
        np.testing.assert_allclose(mean.y, read.rms_of_mean)
        assert below.x.ticks[0].label == "\u221260"

    def test_one_cycle_has_no_mean_apart(self):
        assert len(residual_figure(multiangle(cycles=1)).panels[1].layers) == 1
        # As of two vertical planes, each of which was scanned once.
        product = multiangle(cycles=2)
        product["residual"][0, :3] = np.nan
        product["residual"][1, 3:] = np.nan
        (single,) = residual_figure(product).panels[1].layers
        assert single.label == "one cycle of each beam"

    def test_residuals_that_are_all_zero_can_be_drawn(self):
        product = multiangle()
        product["residual"][:] = 0.0
        assert residual_figure(product).panels[0].bar.high == 0.01

    def test_the_description_names_the_beam_with_the_largest_residuals(self):
        product = multiangle()
        product["residual"][:, 1] += 0.2
        words = residual_figure(product).words
        assert "Mean of 12 cycles" in words
        assert "zenith angle of -45 degrees" in words


class TestImage:
    def test_extinction_in_km_over_altitude(self):
        product = multiangle()
        (figure,) = figures("multiangle", "multiangle-total-extinction", [product])
        (panel,) = figure.panels
        assert panel.y.label == "altitude (km)"
        assert panel.y.low == pytest.approx((ALTITUDE[0] - 25) / 1e3)
        assert panel.bar.label == "total extinction (km⁻¹)"
        assert (panel.bar.low, panel.bar.high) == (0.01, 10.0)
        assert "poor_stratification" in figure.words
        assert "prior_dominated" in figure.words

    def test_many_cycles_become_columns_of_means(self):
        product = multiangle(cycles=60)
        raster = READERS["image"](product, profiles=20)
        assert raster.mean.shape == (3, ALTITUDE.size)
        np.testing.assert_allclose(
            raster.mean[0, 10], product["total_extinction"].values[:20, 10].mean(), rtol=1e-6
        )
        assert raster.units == "m-1"

    def test_one_cycle_is_enough(self):
        assert figures("multiangle", "multiangle-total-extinction", [multiangle(cycles=1)])


READERS = {
    "profile": figure_data.clearest_cycle,
    "residuals": figure_data.read_residuals,
    "image": partial(read_raster, quantity="total_extinction", kind="multiangle", along="altitude"),
}
NEEDED = {
    "profile": (
        *(
            f"{q}{e}"
            for q in figure_data.QUANTITIES
            for e in ("", "_standard_error", "_gradient_error")
        ),
        "reach",
        "quality_flag",
        "time",
        "altitude",
    ),
    "residuals": ("residual", "beam_zenith_angle", "quality_flag", "time", "altitude"),
    "image": ("total_extinction", "total_extinction_standard_error", "quality_flag", "time"),
}


class TestRefusal:
    @pytest.mark.parametrize(
        ("reader", "name"), [(reader, name) for reader in NEEDED for name in NEEDED[reader]]
    )
    def test_a_missing_variable_is_named(self, reader, name):
        with pytest.raises(ProductError, match=f"^{name}: "):
            READERS[reader](multiangle(cycles=2).drop_vars(name))

    @pytest.mark.parametrize("reader", READERS)
    def test_other_dims_are_refused(self, reader):
        product = multiangle(cycles=2)
        product["quality_flag"] = product["quality_flag"].T
        with pytest.raises(ProductError, match="quality_flag"):
            READERS[reader](product)

    def test_other_units_are_refused(self):
        product = multiangle(cycles=2)
        product["total_extinction"].attrs["units"] = "km-1"
        with pytest.raises(ProductError, match="km-1"):
            READERS["profile"](product)


class TestGallery:
    def run(self, tmp_path, products, truth=None):
        archive = Archive(tmp_path / "products")
        records = tuple(archive.write(name, data, "multiangle") for name, data in products.items())
        path = ""
        if truth is not None:
            path = str(tmp_path / "truth.nc")
            truth.to_netcdf(path)
        scene = outcome("s", products=records, instrument="plain-scanner")
        return gallery.fill(run_record(archive.root, [scene], truth=path))

    def test_three_figures_of_every_channel_with_the_truth(self, tmp_path):
        product = multiangle()
        made = self.run(tmp_path, {"a.nc": product}, truth_of(product))
        assert not made.problems
        assert [picture.view for picture in made.pictures] == [
            "multiangle-total-extinction",
            "scan-profile",
            "scan-residuals",
        ]
        assert labelled(made.pictures[1].figure.panels[0], "truth at zenith angle")
        assert made.flags

    def test_an_unreadable_product_is_listed_once_and_the_next_is_drawn(self, tmp_path):
        broken = multiangle().drop_vars(["vertical_optical_depth", "residual"])
        made = self.run(tmp_path, {"a.nc": broken, "b.nc": multiangle()})
        assert [problem.path for problem in made.problems] == ["a.nc"]
        assert "vertical_optical_depth" in made.problems[0].reason
        assert len(made.pictures) == 3

    def test_figures_without_values_are_left_out(self, tmp_path):
        product = multiangle()
        product["quality_flag"][:] = int(
            MultiAngleQuality.NO_LEVERAGE | MultiAngleQuality.NO_RESIDUAL
        )
        product["vertical_optical_depth"][:] = np.nan
        made = self.run(tmp_path, {"a.nc": product})
        assert not made.problems
        assert [picture.view for picture in made.pictures] == ["multiangle-total-extinction"]

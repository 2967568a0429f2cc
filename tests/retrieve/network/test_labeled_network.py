"""Networks on xarray data: values, random and systematic errors, reasons for missing values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.products.made_network import EXTINCTION, beam, product, solved, without

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.retrieve.air.visibility import VisibilityDefinition
from lidarops.retrieve.network import labeled
from lidarops.retrieve.network.flags import NetworkQuality
from lidarops.retrieve.network.settings import EXPONENTS
from lidarops.retrieve.network.thresholds import THRESHOLDS


def test_homogeneous_air_is_within_the_errors():
    result = product(intervals=40)
    whole = np.hypot(
        result["total_extinction_standard_error"], result["total_extinction_systematic_error"]
    )
    score = (result["total_extinction"] - EXTINCTION) / whole
    assert result.sizes == {"time": 40, "crossing": 3, "nv": 2, "beam": 3}
    assert (result["quality_flag"] == 0).all()
    assert (abs(score) < 3).mean() > 0.97
    assert float(abs(result["total_extinction"] / EXTINCTION - 1).mean()) < 0.02
    np.testing.assert_allclose(
        result["visibility_in_air"], -np.log(0.05) / result["total_extinction"], rtol=1e-12
    )
    assert (result["visibility_in_air_lower"] < result["visibility_in_air"]).all()
    assert (result["visibility_in_air_upper"] > result["visibility_in_air"]).all()


def test_the_interval_of_visibility_follows_from_all_errors_of_extinction():
    result = product()
    whole = np.hypot(
        result["total_extinction_standard_error"], result["total_extinction_systematic_error"]
    )
    for end, value in (
        ("lower", result["total_extinction"] + whole),
        ("upper", result["total_extinction"] - whole),
    ):
        np.testing.assert_allclose(
            result[f"visibility_in_air_{end}"], -np.log(0.05) / value, rtol=1e-9
        )


@pytest.mark.parametrize(
    "setting",
    ["exponent_relative_error", "overlap_relative_error", "lidar_ratio_relative_error"],
)
def test_a_larger_declared_error_gives_a_larger_systematic_error(setting):
    beams = [beam(number, noise=0.01, seed=3) for number in range(3)]
    less, more = (solved(beams, **{setting: value}) for value in (0.0, 0.05))
    assert (
        more["total_extinction_systematic_error"] > less["total_extinction_systematic_error"]
    ).mean() > 0.9
    np.testing.assert_array_equal(more["total_extinction"], less["total_extinction"])
    np.testing.assert_array_equal(
        more["total_extinction_standard_error"], less["total_extinction_standard_error"]
    )


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_an_exponent_at_its_bound_has_an_error_too(exponent):
    beams = [beam(number, noise=0.001, exponent=exponent) for number in range(3)]
    declared = {"overlap_relative_error": 0.0, "lidar_ratio_relative_error": 0.0}
    less, more = (solved(beams, exponent_relative_error=error, **declared) for error in (0.0, 0.1))
    known = np.isfinite(more["total_extinction"]).to_numpy()
    assert known.any()
    changes = (
        more["total_extinction_systematic_error"] - less["total_extinction_systematic_error"]
    ).to_numpy()
    assert (changes[known] > 0.0).all()


def test_the_declared_error_covers_an_error_of_the_overlap():
    declared = 0.03
    beams = [beam(number) for number in range(3)]
    plain = solved(beams, overlap_relative_error=declared)
    reach = 3000.0
    error = 1.0 + declared * np.clip(
        1.0 - (beams[0].averages["range"] - 1588) / (reach - 1588), 0, 1
    )
    net = beams[0].averages["power"] - 0.1
    wrong = replace(beams[0], averages=beams[0].averages.assign(power=net * error + 0.1))
    shift = abs(solved([wrong, *beams[1:]])["total_extinction"] - plain["total_extinction"])
    assert float(shift.max()) > 0.5 * declared * EXTINCTION
    assert (shift <= 1.1 * plain["total_extinction_systematic_error"]).all()


def test_signal_left_in_the_background_is_flagged():
    short = beam(0).averages.isel(range=slice(560))
    tail = (0.9 * 4200.0, 4200.0)
    beams = [
        replace(beam(n), averages=beam(n).averages.isel(range=slice(560)), background_range=tail)
        for n in range(3)
    ]
    result = solved(beams)
    assert short.sizes["range"] == 560
    assert (result["quality_flag"] & int(Quality.BACKGROUND_UNCERTAIN)).all()
    whole = np.hypot(
        result["total_extinction_standard_error"], result["total_extinction_systematic_error"]
    )
    assert (abs(result["total_extinction"] - EXTINCTION) < 3 * whole).mean() > 0.9


def test_a_missing_beam_gives_a_reason():
    beams = [beam(number) for number in range(3)]
    result = solved([without(beams[0], slice(2, 4)), *beams[1:]])
    missing = np.isnan(result["total_extinction"].values)
    bits = result["quality_flag"].values
    on_beam = np.isfinite(result["beam_range"].values[0])
    assert (bits[2:4, on_beam] & flags_of("visibility").rejecting).all()
    assert (bits[2:4] & int(NetworkQuality.PRIOR_DOMINATED)).all()
    assert (bits[[0, 1, 4, 5]] == 0).all()
    assert ((bits & flags_of("visibility").rejecting) != 0)[missing].all()


def test_intervals_are_joined_by_the_clock():
    beams = [beam(number) for number in range(3)]
    late = replace(
        beams[2], averages=beams[2].averages.isel(time=slice(1, 4)), interval=np.arange(101, 104)
    )
    result = solved([*beams[:2], late])
    whole = solved(beams)
    assert result.sizes["time"] == 6
    np.testing.assert_array_equal(result["time"], whole["time"])
    # Two beams do not determine three points: values depend on the prior and are flagged.
    doubted = (result["quality_flag"].values != 0).all(axis=1)
    np.testing.assert_array_equal(doubted, [True, False, False, False, True, True])


def test_gaps_in_time_are_missing_profiles_of_the_block():
    filled = labeled._without_gaps(np.array([0, 1, 5, 72, 75, 300]), 72)
    assert filled.tolist() == [*range(6), *range(72, 76), 300]
    beams = [beam(number) for number in range(3)]
    given = np.array([100, 101, 102, 120, 121, 122])
    result = solved([replace(each, interval=given) for each in beams])
    assert result.sizes["time"] == 6
    np.testing.assert_array_equal(result["time"], solved(beams)["time"])
    assert (result["quality_flag"] == 0).all()


def test_pile_up_is_kept_where_the_signal_is_used():
    beams = [beam(number) for number in range(3)]
    for far, stated in ((2000.0, True), (300.0, False)):
        near = beams[1].averages["range"] < far
        bits = beams[1].averages["quality"] | (near * np.int32(Quality.PILE_UP))
        piled = replace(beams[1], averages=beams[1].averages.assign(quality=bits))
        result = solved([beams[0], piled, beams[2]])
        assert bool((result["quality_flag"] & int(Quality.PILE_UP)).any()) is stated


def test_visibility_follows_the_definition():
    koschmieder = product(visibility=VisibilityDefinition(wavelength=532e-9, contrast=0.02))
    np.testing.assert_allclose(
        koschmieder["visibility_in_air"] * koschmieder["total_extinction"], -np.log(0.02)
    )
    angstrom = product(
        visibility=VisibilityDefinition(
            wavelength=1064e-9, law="angstrom", angstrom_exponent=1.3, exponent_standard_error=0.2
        )
    )
    factor = (1064 / 550) ** 1.3
    np.testing.assert_allclose(
        angstrom["visibility_in_air"] * angstrom["total_extinction"] * factor, -np.log(0.05)
    )
    assert "angstrom" in angstrom.attrs["steps"]
    # The error of the law widens the interval, not the random error.
    ratio = angstrom["visibility_in_air_standard_error"] / angstrom["visibility_in_air"]
    np.testing.assert_allclose(
        ratio, angstrom["total_extinction_standard_error"] / angstrom["total_extinction"]
    )
    width = angstrom["visibility_in_air_upper"] / angstrom["visibility_in_air_lower"]
    assert (width > 1 + 2 * 0.2 * np.log(1064 / 550)).all()


def test_the_number_of_beams_must_match_the_network():
    with pytest.raises(RetrievalInputError, match="beams"):
        solved([beam(0)])


def test_bins_that_are_not_used_do_not_matter(monkeypatch):
    beams = [beam(number, noise=0.01, seed=3) for number in range(3)]
    cut = solved(beams)
    monkeypatch.setattr(labeled, "THRESHOLDS", THRESHOLDS._replace(bins_beyond=10**6))
    xr.testing.assert_identical(cut, solved(beams))
    assert beams[0].averages.sizes["range"] > 700


def test_the_bias_of_a_multiplier_is_part_of_the_systematic_error():
    beams = [beam(number, noise=0.01, seed=3) for number in range(3)]
    errors = {f"{name}_relative_error": 0.0 for name in ("exponent", "overlap", "lidar_ratio")}
    result = solved(beams, multiplier=0.8, **errors)
    np.testing.assert_allclose(result["multiplier"], 0.8)
    excess = (result["total_extinction"] - EXTINCTION).median("time").dropna("crossing")
    stated = result["total_extinction_systematic_error"].median("time").dropna("crossing")
    assert excess.size > 0
    assert (excess > 0.05 * EXTINCTION).all()
    np.testing.assert_allclose(excess, stated, rtol=0.1)
    assert "multiplier" not in solved(beams)
    assert "triangles of beams, with the multiplier 0.8" in result.attrs["steps"]

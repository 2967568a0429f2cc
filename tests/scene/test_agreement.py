"""Channels that measure the same disagree by noise as rarely as stated, and an outlier is named."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.special import ndtri
from support.products.made_products import STATION, context, multiangle

from lidarops.flags import Quality
from lidarops.products.multiangle import KIND
from lidarops.records import Disagreement
from lidarops.scene.agreement import Retrieved, compare_channels

CHANNELS = tuple(f"{detection}_532{p}" for detection in ("analog", "photon") for p in "ops")
ERROR = 0.01
LEVELS = 200


def retrieved(
    channel: str,
    depth: np.ndarray,
    gradient: float = 0.0,
    dead_time: float = 0.0,
    wavelength: float = 532e-9,
    air: float = 0.0,
) -> Retrieved:
    """Return a product of an optical depth (level,) with errors."""
    product = multiangle(profiles=2, levels=LEVELS).isel(time=[1])
    product["vertical_optical_depth"][:] = depth
    product["vertical_optical_depth_standard_error"][:] = np.hypot(ERROR, air)
    product["vertical_optical_depth_error_air"][:] = air
    product["vertical_optical_depth_gradient_error"][:] = gradient
    product["vertical_optical_depth_dead_time_error"][:] = dead_time
    product["quality_flag"][:] = 0
    if channel.startswith("analog"):
        product = product.drop_vars("vertical_optical_depth_dead_time_error")
    assert KIND.common is not None
    of_channel = context("multiangle", channel=channel, wavelength=wavelength)
    return Retrieved(KIND.common, of_channel, product, (product,))


def compared(*products: Retrieved) -> tuple[Disagreement, ...]:
    return compare_channels(products)[1]


def noisy(seed: int, shifts: dict[str, float]) -> dict[str, np.ndarray]:
    """Return the same optical depth of all channels with independent noise, some shifted."""
    rng = np.random.default_rng(seed)
    depths = {name: 0.3 + ERROR * rng.standard_normal(LEVELS) for name in CHANNELS}
    for name, shift in shifts.items():
        depths[name][LEVELS // 2] += shift
    return depths


def test_noise_makes_no_disagreement() -> None:
    # 60 pairs of 200 independent levels.
    for seed in range(4):
        products = [retrieved(*of) for of in noisy(seed, {}).items()]
        judged, pairs = compare_channels(products)
        assert pairs == ()
        assert judged == products


@pytest.mark.parametrize(("part", "pairs"), [(0.98, 0), (1.02, 1)])
def test_noise_makes_one_of_1000_pairs_disagree(part: float, pairs: int) -> None:
    # Of 200 independent levels, either sign.
    limit = -ndtri(0.5e-3 / LEVELS)
    depth = np.full(LEVELS, 0.3)
    shifted = depth.copy()
    shifted[70] += part * limit * np.sqrt(2.0) * ERROR
    pair = zip(CHANNELS, (depth, shifted), strict=False)
    assert len(compared(*(retrieved(*of) for of in pair))) == pairs


SHIFT = 10.0 * ERROR


@pytest.mark.parametrize(
    ("gradients", "dead_time", "pairs"),
    [
        ((0.0, 0.0), 0.0, 1),
        ((0.0, 0.0), SHIFT / 3, 0),
        ((SHIFT / 3, 0.0), 0.0, 0),
        # The same error of the air explains no difference.
        ((SHIFT, SHIFT), 0.0, 1),
    ],
)
def test_errors_explain_a_difference_if_they_differ_between_the_channels(
    gradients: tuple[float, float], dead_time: float, pairs: int
) -> None:
    depth = np.full(LEVELS, 0.3)
    analog = retrieved("analog_532o", depth, gradients[0])
    photon = retrieved("photon_532o", depth + SHIFT, gradients[1], dead_time)
    assert len(compared(analog, photon)) == pairs


@pytest.mark.parametrize(
    ("airs", "pairs"),
    [
        ((0.0, 0.0), 1),
        # Air that both see, with other weights.
        ((SHIFT / 3, SHIFT / 3), 0),
        # A distorted signal looks like air that one channel alone sees.
        ((0.0, SHIFT), 1),
        ((SHIFT, ERROR), 1),
    ],
)
def test_air_explains_a_difference_if_both_channels_see_it(
    airs: tuple[float, float], pairs: int
) -> None:
    depth = np.full(LEVELS, 0.3)
    first = retrieved("photon_532p", depth, air=airs[0])
    second = retrieved("photon_532s", depth + SHIFT, air=airs[1])
    assert len(compared(first, second)) == pairs


@pytest.mark.parametrize(
    ("third", "named"), [(0.0, "photon_532o"), (6.0, "analog_532o"), (3.0, "")]
)
def test_a_third_channel_tells_which_of_two_is_wrong_at_one_place(third: float, named: str) -> None:
    # A difference of 6 errors is no chance of 200 places; one of 3.5 errors is none at a place.
    shifts = {"analog_532o": 0.0, "photon_532o": 6.0, "photon_532p": third}
    products = []
    for channel, shift in shifts.items():
        depth = np.full(LEVELS, 0.3)
        depth[70] += shift * np.sqrt(2.0) * ERROR
        products.append(retrieved(channel, depth))
    judged, pairs = compare_channels(products)
    found = {pair.channels: pair.outlier for pair in pairs}
    assert found["analog_532o", "photon_532o"] == named
    flags = {product.context.channel: raised(product) for product in judged}
    elsewhere = np.arange(LEVELS) != 70
    if named:
        assert flags[named][70] == Quality.CONTRADICTED
        assert set(flags.pop(named)[elsewhere]) == {Quality.DISAGREES}
        assert not any(values.any() for values in flags.values())
    else:
        assert (flags["analog_532o"] == Quality.DISAGREES).all()
        assert (flags["photon_532o"] == Quality.DISAGREES).all()


def raised(product: Retrieved) -> np.ndarray:
    """Return the quality bits of the only profile of a product."""
    (rows,) = product.batches
    assert rows["quality_flag"].dtype == np.int32
    return rows["quality_flag"].values[0]


@pytest.mark.parametrize("level", [19, 70])
def test_a_layer_that_ends_at_a_contradicted_value_is_missing(level: int) -> None:
    bounds = [[STATION.altitude, STATION.altitude + 1200.0], [STATION.altitude + 3000.0, 9000.0]]
    products = []
    for channel in CHANNELS[:3]:
        depth = np.full(LEVELS, 0.3)
        depth[level] += SHIFT * (channel == CHANNELS[0])
        product = retrieved(channel, depth)
        rows = product.frame.assign(layer_bnds=(("layer", "nv"), bounds))
        products.append(Retrieved(product.common, product.context, rows, (rows,)))
    judged, _ = compare_channels(products)
    lost = [product.batches[0]["layer_vertical_optical_depth"].isnull() for product in judged]
    assert [values.values.tolist() for values in lost] == [[[level == 19, False]]] + 2 * [
        [[False, False]]
    ]


def test_rows_that_come_in_batches_are_judged_together() -> None:
    whole = [retrieved(*of) for of in noisy(9, {"photon_532p": SHIFT}).items()]
    parted = []
    for product in whole:
        double = xr.concat([product.frame, product.frame], "time", data_vars="minimal")
        rows = tuple(double.isel(time=[number]) for number in range(2))
        parted.append(Retrieved(product.common, product.context, double, rows))
    assert compared(*parted) == compared(*whole)
    (wrong,) = (p for p in compare_channels(parted)[0] if p.context.channel == "photon_532p")
    assert len(wrong.batches) == 2
    for rows in wrong.batches:
        assert rows["quality_flag"].values[0, LEVELS // 2] == Quality.CONTRADICTED


def test_channels_of_two_wavelengths_are_not_compared() -> None:
    depth = np.full(LEVELS, 0.3)
    green, red = retrieved("photon_532o", depth), retrieved("photon_607o", 2.0 * depth, 0, 0, 6e-7)
    assert compared(green, red) == ()


def test_two_wrong_channels_of_four_are_named_by_the_two_others() -> None:
    shifts = {"analog_532o": 0.0, "photon_532o": 0.0, "analog_532p": 8.0, "photon_532p": -8.0}
    depths = {name: np.full(LEVELS, 0.3 + shift * ERROR) for name, shift in shifts.items()}
    pairs = compared(*(retrieved(*of) for of in depths.items()))
    found = {pair.channels: pair.outlier for pair in pairs}
    assert len(found) == 5
    assert found.pop(("analog_532p", "photon_532p")) == ""
    for pair, named in found.items():
        assert {named} == {name for name in pair if shifts[name]}


def test_the_channel_that_all_others_contradict_is_named() -> None:
    depths = noisy(9, {"photon_532p": 10.0 * ERROR})
    pairs = compared(*(retrieved(*of) for of in depths.items()))
    assert len(pairs) == len(CHANNELS) - 1
    assert {pair.outlier for pair in pairs} == {"photon_532p"}
    places = {pair.place for pair in pairs}
    assert len(places) == 1

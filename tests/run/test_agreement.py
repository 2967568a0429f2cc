"""Channels that measure the same disagree by noise as rarely as stated, and an outlier is named."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtri
from support.archives.scene_jobs import scene_jobs
from support.archives.small_archive import Archive
from support.products.encoded_products import build_product
from support.products.made_products import SCENE, START, context, multiangle, provenance

from lidarops.errors import ProductError
from lidarops.netcdf.build import product_path
from lidarops.netcdf.write import write_product
from lidarops.process.guard import Failure
from lidarops.records import Disagreement, ProductRecord, Scene
from lidarops.run.agreement import find_disagreements
from lidarops.run.executor import attempt

CHANNELS = tuple(f"{detection}_532{p}" for detection in ("analog", "photon") for p in "ops")
ERROR = 0.01
LEVELS = 200


def write(
    root: Path, channel: str, depth: np.ndarray, gradient: float = 0.0, dead_time: float = 0.0
) -> ProductRecord:
    """Write a product of an optical depth (level,) with errors, and return its record."""
    product = multiangle(profiles=2, levels=LEVELS).isel(time=[1])
    product["vertical_optical_depth"][:] = depth
    product["vertical_optical_depth_standard_error"][:] = ERROR
    product["vertical_optical_depth_gradient_error"][:] = gradient
    product["vertical_optical_depth_dead_time_error"][:] = dead_time
    if channel.startswith("analog"):
        product = product.drop_vars("vertical_optical_depth_dead_time_error")
    origin = provenance("multiangle", channel=channel)
    of_channel = context("multiangle", channel=channel, provenance=origin)
    path = product_path(of_channel)
    write_product(build_product(product, of_channel), root / path)
    return ProductRecord(path, "multiangle", channel, "", 0, LEVELS, {}, LEVELS)


def noisy(seed: int, shifts: dict[str, float]) -> dict[str, np.ndarray]:
    """Return the same optical depth of all channels with independent noise, some shifted."""
    rng = np.random.default_rng(seed)
    depths = {name: 0.3 + ERROR * rng.standard_normal(LEVELS) for name in CHANNELS}
    for name, shift in shifts.items():
        depths[name][LEVELS // 2] += shift
    return depths


def compared(
    root: Path, new: list[ProductRecord], requested: tuple[str, ...] = CHANNELS
) -> tuple[Disagreement, ...]:
    scene = Scene(SCENE, "demo", "odesa", "lidar-1", START, START + timedelta(days=1), ())
    return find_disagreements(new, scene, [("multiangle", name) for name in requested], root)


def test_noise_makes_no_disagreement(tmp_path: Path) -> None:
    # 60 pairs of 200 independent levels.
    for seed in range(4):
        records = [write(tmp_path, name, depth) for name, depth in noisy(seed, {}).items()]
        assert compared(tmp_path, records) == ()


@pytest.mark.parametrize(("part", "pairs"), [(0.98, 0), (1.02, 1)])
def test_noise_makes_one_of_1000_pairs_disagree(part: float, pairs: int, tmp_path: Path) -> None:
    # Of 200 independent levels, either sign.
    limit = -ndtri(0.5e-3 / LEVELS)
    depth = np.full(LEVELS, 0.3)
    shifted = depth.copy()
    shifted[70] += part * limit * np.sqrt(2.0) * ERROR
    records = [write(tmp_path, *of) for of in zip(CHANNELS, (depth, shifted), strict=False)]
    assert len(compared(tmp_path, records)) == pairs


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
    gradients: tuple[float, float], dead_time: float, pairs: int, tmp_path: Path
) -> None:
    depth = np.full(LEVELS, 0.3)
    analog = write(tmp_path, "analog_532o", depth, gradients[0])
    photon = write(tmp_path, "photon_532o", depth + SHIFT, gradients[1], dead_time)
    assert len(compared(tmp_path, [analog, photon])) == pairs


@pytest.mark.parametrize(
    ("third", "named"), [(0.0, "photon_532o"), (6.0, "analog_532o"), (3.0, "")]
)
def test_a_third_channel_tells_which_of_two_is_wrong_at_one_place(
    third: float, named: str, tmp_path: Path
) -> None:
    # A difference of 6 errors is no chance of 200 places; one of 3.5 errors is none at a place.
    shifts = {"analog_532o": 0.0, "photon_532o": 6.0, "photon_532p": third}
    records = []
    for channel, shift in shifts.items():
        depth = np.full(LEVELS, 0.3)
        depth[70] += shift * np.sqrt(2.0) * ERROR
        records.append(write(tmp_path, channel, depth))
    found = {pair.channels: pair.outlier for pair in compared(tmp_path, records)}
    assert found["analog_532o", "photon_532o"] == named


def test_two_wrong_channels_of_four_are_named_by_the_two_others(tmp_path: Path) -> None:
    shifts = {"analog_532o": 0.0, "photon_532o": 0.0, "analog_532p": 8.0, "photon_532p": -8.0}
    records = []
    for channel, shift in shifts.items():
        records.append(write(tmp_path, channel, np.full(LEVELS, 0.3 + shift * ERROR)))
    found = {pair.channels: pair.outlier for pair in compared(tmp_path, records)}
    assert len(found) == 5
    assert found.pop(("analog_532p", "photon_532p")) == ""
    for pair, named in found.items():
        assert {named} == {name for name in pair if shifts[name]}


def test_the_channel_that_all_others_contradict_is_named(tmp_path: Path) -> None:
    depths = noisy(9, {"photon_532p": 10.0 * ERROR})
    records = [write(tmp_path, name, depth) for name, depth in depths.items()]
    pairs = compared(tmp_path, records)
    assert len(pairs) == len(CHANNELS) - 1
    assert {pair.outlier for pair in pairs} == {"photon_532p"}
    places = {pair.place for pair in pairs}
    assert len(places) == 1


def test_only_pairs_with_a_new_product_are_reported(tmp_path: Path) -> None:
    depths = noisy(9, {"photon_532p": 10.0 * ERROR})
    *_, new = [write(tmp_path, name, depth) for name, depth in depths.items()]
    (pair,) = compared(tmp_path, [new])
    # The older ones decide which channel is wrong.
    assert (set(pair.channels), pair.outlier) == ({"photon_532p", new.channel}, "photon_532p")


def test_the_product_of_a_channel_that_is_not_requested_is_no_witness(tmp_path: Path) -> None:
    depths = noisy(9, {"photon_532p": 10.0 * ERROR})
    records = [write(tmp_path, name, depth) for name, depth in depths.items()]
    rest = tuple(name for name in CHANNELS if name != "photon_532p")
    assert compared(tmp_path, records[-1:], rest) == ()


def test_a_new_product_that_cannot_be_read_raises_an_error(tmp_path: Path) -> None:
    old, new = [write(tmp_path, *of) for of in zip(CHANNELS, noisy(1, {}).values(), strict=True)][
        :2
    ]
    (tmp_path / old.path).write_bytes(b"")
    assert compared(tmp_path, [new]) == ()
    (tmp_path / new.path).write_bytes(b"")
    with pytest.raises(ProductError, match="cannot be read"):
        compared(tmp_path, [new])


def test_a_failed_comparison_does_not_end_the_tries_of_a_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    job, *_ = scene_jobs(Archive(tmp_path, days=1).write())
    outcome = Failure("").outcome(job.scene, job.plan)
    # A granule could not be read, and the next try may read it.
    monkeypatch.setattr("lidarops.process.scene.attempt", lambda _: (outcome, False))
    monkeypatch.setattr("lidarops.run.agreement.find_disagreements", fail)
    failed, final = attempt(job)
    assert "ZeroDivisionError" in failed.internal
    assert not final

"""Channels that measure the same disagree by noise as rarely as stated, and an outlier is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from support.products.encoded_products import build_product
from support.products.made_products import context, multiangle, provenance

from lidarops.netcdf.write import write_product
from lidarops.records import ProductRecord
from lidarops.run.agreement import find_disagreements

CHANNELS = tuple(f"{detection}_532{p}" for detection in ("analog", "photon") for p in "ops")
ERROR = 0.01
LEVELS = 200


def written(root: Path, seed: int, shifted: str = "", shift: float = 0.0) -> list[ProductRecord]:
    """Write products of the same optical depth with independent noise; one is shifted at a level.

    Return the records of the last one, which is the new one.
    """
    rng = np.random.default_rng(seed)
    for channel in CHANNELS:
        product = multiangle(profiles=2, levels=LEVELS).isel(time=[1])
        depth = 0.3 + ERROR * rng.standard_normal((1, LEVELS))
        if channel == shifted:
            depth[0, LEVELS // 2] += shift
        product["vertical_optical_depth"][:] = depth
        product["vertical_optical_depth_standard_error"][:] = ERROR
        name = f"site_lidar_multiangle_{channel}_20260301T000000.nc"
        origin = provenance("multiangle", channel=channel)
        of_channel = context("multiangle", channel=channel, provenance=origin)
        built = build_product(product, of_channel)
        write_product(built, root / name)
    return [ProductRecord(name, "multiangle", CHANNELS[-1], "", 0, LEVELS, {}, LEVELS)]


def test_noise_makes_no_disagreement(tmp_path: Path) -> None:
    # 60 pairs of 200 independent levels.
    for seed in range(4):
        assert find_disagreements(written(tmp_path, seed), tmp_path) == ()


def test_the_channel_that_all_others_contradict_is_named(tmp_path: Path) -> None:
    records = written(tmp_path, 9, shifted="photon_532p", shift=10.0 * ERROR)
    pairs = find_disagreements(records, tmp_path)
    assert len(pairs) == len(CHANNELS) - 1
    assert {pair.outlier for pair in pairs} == {"photon_532p"}
    places = {pair.place for pair in pairs}
    assert len(places) == 1

"""Shares of false values in comments of products: those of the committed results."""

from __future__ import annotations

import re

import measured_shares
import pytest
import verdicts

from lidarops.bench.harness.verdicts import Verdict
from lidarops.bench.stability.random_scenes import POOLED, TARGET
from lidarops.kinds import kinds
from lidarops.netcdf import false_shares
from lidarops.netcdf.measured_shares import SHARES

CLASSES = {
    "extinction": ("homogeneous", "total_extinction_model_error"),
    "background": ("homogeneous", "background_model_error"),
}
"""Quantity: product and variable whose comment states all classes."""
SINGLE = {
    ("background", "near the cut"): ("homogeneous", "background"),
    ("background, known shape", "shape of hazy air"): ("signal", "background_method"),
    ("voltage", "analog noise below half a step"): ("signal", ""),
    ("backscatter", "more haze than stated"): ("elastic", ""),
    ("lidar ratio", "model holds"): ("raman", "lidar_ratio"),
    ("scans", "layer"): ("multiangle", "total_extinction"),
    ("scans", "layer, blocks of 2"): ("multiangle", "total_extinction"),
    ("network", "plume, blocks of 1"): ("visibility", ""),
    ("network", "layered, blocks of 1"): ("visibility", ""),
    ("network", "lidar ratio, 2 % declared"): ("visibility", ""),
    ("network", "lidar ratio, 10 % declared"): ("visibility", ""),
}
"""Quantity and class: product and variable (none: the file) whose comment states it."""


def comment(kind: str, variable: str) -> str:
    layout = kinds()[kind].part("variables", "LAYOUT")
    return ({data.name: data.comment for data in layout.data} | {"": layout.comment})[variable]


def test_the_shares_are_those_of_the_results() -> None:
    """After new results, `make golden` writes them."""
    assert measured_shares.FILE.read_text(encoding="utf-8") == measured_shares.text()


@pytest.mark.parametrize("quantity", CLASSES)
def test_comments_state_every_class_of_violations(quantity: str) -> None:
    words = comment(*CLASSES[quantity])
    stated = words.partition("combined standard errors: ")[2].partition(" otherwise")[0]
    *named, rest = re.findall(r"([0-9.]+) percent", stated)
    shares = [
        share for (of, name), share in SHARES.items() if of == quantity and name != "near the cut"
    ]
    assert len(shares) == 9
    above = sorted((share for share in shares if share[0] > 0.5), reverse=True)
    assert len(above) == len(named)
    for number, (value, error) in zip(named, above, strict=True):
        assert abs(float(number) - value) <= error
    assert all(value + 2.0 * error <= float(rest) for value, error in shares if value <= 0.5)


@pytest.mark.parametrize("place", SINGLE)
def test_comments_state_single_shares(place: tuple[str, str]) -> None:
    text = false_shares.percent(*place)
    assert text in comment(*SINGLE[place])
    value, error = SHARES[place]
    assert abs(float(text.split()[0]) - value) <= error


FLAGGED = {
    "short sections": "NOISE_UNCERTAIN marks these values",
    "correlated noise": "products measure the correlation",
    "scans of photon counts": "products smooth the counts",
}
"""Parts of the benchmark whose missed classes no comment states, and why."""


def test_comments_state_every_class_that_misses_its_target() -> None:
    beside = [tuple(place[:4]) for place in measured_shares.BESIDE.values()]
    for one in verdicts.every_unmet():
        if one.target != TARGET or one.judgement.verdict is not Verdict.MISSED:
            continue
        pooled = one.name in POOLED or one.part in FLAGGED
        of_path = one.part == "homogeneous" and one.quantity in CLASSES
        single = (one.quantity, one.name) in SINGLE
        stated = ("stability", one.part, one.quantity, one.name) in beside
        assert pooled or of_path or single or stated, one


def test_classes_above_the_limit_are_named_and_the_rest_is_limited(monkeypatch) -> None:
    shares = {("x", "a"): (11.46, 1.0), ("x", "b"): (0.51, 0.1), ("x", "c"): (0.42, 0.15)}
    monkeypatch.setattr(false_shares, "SHARES", shares)
    words = {"a": "with a", "b": "with b", "c": "with c"}
    assert false_shares.by_class("x", words) == (
        "11 percent with a, 0.5 percent with b, at most 0.8 percent otherwise"
    )
    assert false_shares.percent("x", "c") == "0.4 percent"

"""Comments of products name the air and the signals in which values without a flag are false."""

from __future__ import annotations

import verdicts
from support.cases import each

from benchmarks.harness.figure import Verdict
from benchmarks.harness.rates import BROKEN, HELD, TARGET
from lidarops.kinds import kinds
from lidarops.netcdf.variables import MEASURED_SHARES

PATH = {
    "slope of the backscatter along the section": "changes along the section",
    "bent backscatter": "is curved",
    "plume": "a plume",
    "afterpulse": "an afterpulse",
    "saturated": "the top of the signal is clipped",
}
STATED = {
    **{
        ("homogeneous", quantity, name): ("homogeneous", variable, words)
        for quantity, variable in (
            ("extinction", "total_extinction_model_error"),
            ("background", "background_model_error"),
        )
        for name, words in PATH.items()
    },
    ("near the cut", "background", "near the limit of POORLY_DETERMINED"): (
        "homogeneous", "background", "10 to 15 percent",
    ),
    ("signal chain", "background, known shape", "shape of hazy air"): (
        "signal", "background_method", "haze with a scale height of 3 km",
    ),
    ("signal chain", "voltage", "analog noise below half a step"): (
        "signal", "", "below half a step of the digitizer",
    ),
    ("elastic", "backscatter", "more haze than stated"): ("elastic", "", "haze exceeds it"),
    ("multi-angle", "extinction", "layer of a few altitudes"): (
        "multiangle", "total_extinction", "layers of a few altitudes",
    ),
    ("multi-angle", "extinction", "layer with edges"): (
        "multiangle", "total_extinction", "layers of a few altitudes",
    ),
    ("scans, blocks of 1", "extinction", "layer with edges, blocks of 1"): (
        "multiangle", "total_extinction", "layers of a few altitudes",
    ),
    ("scans, blocks of 2", "extinction", "layer of a few altitudes, blocks of 2"): (
        "multiangle", "total_extinction", "layers of a few altitudes",
    ),
    ("scans, blocks of 2", "extinction", "layer with edges, blocks of 2"): (
        "multiangle", "total_extinction", "layers of a few altitudes",
    ),
    ("networks, plume, blocks of 1", "extinction", "plume, blocks of 1"): (
        "visibility", "", "with a plume",
    ),
    (
        "networks, varying lidar ratio", "extinction",
        "lidar ratio varies by 10 %, the default declared",
    ): ("visibility", "", "by 7 percent (rms)"),
}  # fmt: skip
"""Part, quantity and class of the benchmark: product, variable (none: the file) and words."""
FLAGGED = {
    "short sections": "NOISE_UNCERTAIN marks these values",
}
"""Parts of the benchmark whose missed classes no comment states, and why."""


@each("place", STATED)
def test_comments_name_what_no_flag_shows(place: tuple[str, str, str]) -> None:
    kind, variable, words = STATED[place]
    layout = kinds()[kind].part("variables", "LAYOUT")
    comment = ({row.name: row.comment for row in layout.variables} | {"": layout.comment})[variable]
    assert words in comment
    assert variable == "background" or MEASURED_SHARES in comment


def test_every_class_that_misses_its_target_is_named() -> None:
    missed = {
        (one.part, one.quantity, one.name)
        for one in verdicts.every_unmet()
        if one.target == TARGET
        and one.judgement.verdict is Verdict.MISSED
        and one.name not in {HELD, BROKEN}
        and one.part not in FLAGGED
    }
    assert missed - STATED.keys() == set()

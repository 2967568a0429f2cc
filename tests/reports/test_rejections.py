"""Which settings a flag follows from that rejects many values."""

from __future__ import annotations

import pytest

from lidarops.records import LeftOut, Plan, ProductRecord
from lidarops.reports.rejections import decided_by

DEAD_TIME = {"analog": "analog detection has no dead time", "photon": "the campaign gives none"}


@pytest.mark.parametrize(
    ("channel", "flag", "words"),
    [
        ("photon_532o", "poor_stratification", "dead_time: the campaign gives none"),
        ("photon_532o", "saturated", "dead_time: the campaign gives none"),
        ("analog_532o", "poor_stratification", "dark: no dark_files"),
        ("analog_532o", "saturated", ""),
        ("glued_532o", "saturated", "dead_time: the campaign gives none"),
        ("photon_532o", "no_signal", "none: the laser was off"),
        ("photon_532o", "cloud", ""),
    ],
)
def test_a_flag_names_a_setting_that_its_channel_has(channel: str, flag: str, words: str) -> None:
    left_out = [
        entry
        for mode, reason in DEAD_TIME.items()
        for entry in (
            LeftOut("dead_time", f"{mode}_532o", reason),
            LeftOut("dark", f"{mode}_532o", "no dark_files"),
        )
        if mode == "photon" or channel != "glued_532o"
    ]
    plan = Plan("scene", (), tuple(left_out))
    product = ProductRecord("a.nc", "signal", channel, "", 1, 1, {}, 1)
    assert decided_by(plan, product, flag).startswith(words)
    assert bool(decided_by(plan, product, flag)) == bool(words)

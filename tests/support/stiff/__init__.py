"""Stiff and extreme cases of all retrievals and of the forward model, and their table."""

from __future__ import annotations

from typing import Final

from support.stiff import elastic, forward, homogeneous, layouts, networks, scans, signals
from support.stiff.cases import StiffCase

CASES: Final[tuple[StiffCase, ...]] = (
    *homogeneous.stiff_homogeneous_cases(),
    *signals.stiff_signal_cases(),
    *elastic.stiff_elastic_cases(),
    *scans.stiff_scan_cases(),
    *networks.stiff_network_cases(),
    *forward.stiff_forward_cases(),
    *layouts.memory_layout_cases(),
)

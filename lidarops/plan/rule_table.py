"""The table of all rules: name, step, question, and the function that decides."""

from __future__ import annotations

from typing import Final

from lidarops.plan.availability import ABSENT, UNMATCHED
from lidarops.plan.network_plan import NETWORK
from lidarops.plan.preview import REFINEMENTS
from lidarops.plan.rules import Rule
from lidarops.plan.scene_plan import CHANNEL, PRODUCTS, RANGE_WINDOW
from lidarops.plan.signal_rules import CONDITIONING, GLUING

RULES: Final[tuple[Rule, ...]] = tuple(
    dict.fromkeys(
        (
            *(ABSENT, UNMATCHED, CHANNEL, RANGE_WINDOW),
            *CONDITIONING,
            *GLUING,
            *PRODUCTS,
            *NETWORK,
            *REFINEMENTS,
        )
    )
)
"""In the order in which they apply; the `REFINEMENTS` apply in the worker, to some profiles."""

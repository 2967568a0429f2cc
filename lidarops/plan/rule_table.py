"""All rules of plans in one table: name, step, what is asked, and the function that answers."""

from __future__ import annotations

from typing import Final

from lidarops.plan.availability import ABSENT, STRANGE
from lidarops.plan.network_plan import NETWORK
from lidarops.plan.preview import REFINEMENTS
from lidarops.plan.scene_plan import CHANNEL, PRODUCTS, RANGE_WINDOW
from lidarops.plan.signal_rules import CONDITIONING, GLUING, Rule

RULES: Final[tuple[Rule, ...]] = tuple(
    dict.fromkeys(
        (
            *(ABSENT, STRANGE, CHANNEL, RANGE_WINDOW),
            *CONDITIONING,
            *GLUING,
            *PRODUCTS,
            *NETWORK,
            *REFINEMENTS,
        )
    )
)
"""In the order in which they are asked; the last ones in the worker, of some profiles."""

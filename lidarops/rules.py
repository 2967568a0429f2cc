"""All rules of plans in one table: name, step, what is asked, and the function that answers."""

from __future__ import annotations

from typing import Final

from lidarops.network_plans import NETWORK
from lidarops.plan_rules import CONDITIONING, GLUING, Rule
from lidarops.plans import CHANNEL, GATE, PRODUCTS
from lidarops.presence import ABSENT, STRANGE
from lidarops.refinement import REFINEMENTS

RULES: Final[tuple[Rule, ...]] = tuple(
    dict.fromkeys(
        (
            *(ABSENT, STRANGE, CHANNEL, GATE),
            *CONDITIONING,
            *GLUING,
            *PRODUCTS,
            *NETWORK,
            *REFINEMENTS,
        )
    )
)
"""In the order in which they are asked; the last ones in the worker, of some profiles."""

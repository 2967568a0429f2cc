"""Estimate the CPU time of a run on a common server core, from its plans.

Every step of a plan states its own. The constants are set for one machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from lidarops.records import Plan, Scene
from lidarops.steps.dependence import is_product, planned_products, workloads
from lidarops.steps.registry import definition

_START: Final = 4.0
"""s for the process, its imports, loading compiled code and the ledger."""
_SCENE: Final = 0.005
"""s for a scene, besides its steps."""
_FILE: Final = 2e-5
"""s to open a raw file."""
_BYTE: Final = 2e-9
"""s for the digest of a byte of a raw file."""
_PAGE: Final = 0.2
"""s for the page of a report."""
_FIGURE: Final = 0.2
"""s for the figures of one kind of product of one channel of an instrument."""
MOST_FIGURES: Final = 40
"""Number of groups of products that a report draws."""


def scene_cpu_time(scene: Scene, plan: Plan, *, whole: bool = False) -> float:
    """Return the estimated CPU time of a scene, s.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        Before it is refined in the worker: sections that are left out there still count.
    whole : bool
        Whether every file is read in full, as with ``--all-steps``, even if its digest is known.
    """
    if not planned_products(plan):
        return 0.0
    times = [_SCENE]
    for step, work in workloads(scene, plan):
        known = definition(step)
        times.append(known.cpu_time(known.typed(step), work))
    files = (*scene.granules, *scene.dark)
    times += [_FILE + _BYTE * file.size * (whole or file.sha256 is None) for file in files]
    return math.fsum(times)


@dataclass(slots=True)
class RunTime:
    """The estimated CPU time of a run, which scenes are added to."""

    scenes: float = 0.0
    """s, of all scenes."""
    count: int = 0
    """Number of scenes with products."""
    _figures: set[tuple[str, str, str]] = field(default_factory=set)

    def add(self, scene: Scene, plan: Plan, *, whole: bool = False) -> float:
        """Add a scene and return its own CPU time, s; see `scene_cpu_time`."""
        seconds = scene_cpu_time(scene, plan, whole=whole)
        products = {(s.name, scene.instrument, s.channel) for s in plan.steps if is_product(s)}
        self.scenes += seconds
        self.count += bool(products)
        self._figures |= products
        return seconds

    @property
    def parts(self) -> dict[str, float]:
        """CPU time of scenes, of what a process does once, of the report, and of all, s."""
        start = _START if self.count else 0.0
        report = _PAGE + _FIGURE * min(len(self._figures), MOST_FIGURES) if self.count else 0.0
        return {
            "scenes": self.scenes,
            "start": start,
            "report": report,
            "all": self.scenes + start + report,
        }

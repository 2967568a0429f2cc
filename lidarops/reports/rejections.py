"""Which settings the flags follow from that reject many values of products, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Final

from lidarops.figures.wording import percent
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds
from lidarops.records import LeftOut, Plan, PlannedStep, ProductRecord, SceneOutcome, file_channels
from lidarops.scene.retrieval import settings_model
from lidarops.settings import unit_of
from lidarops.units import written

MANY: Final = 0.25
"""Least share of the values that a flag rejects to be named."""
_STAGES: Final = {
    "incomplete_overlap": "overlap", "saturated": "dead_time",
    "negative_backscatter": "overlap", "poor_stratification": "dead_time",
    "no_gluing": "lag", "no_reference": "reference", "unstable_inversion": "reference",
    "low_signal": "average", "not_homogeneous": "homogeneous",
}  # fmt: skip
"""Rejecting flags, and the entry of a plan whose settings they follow from."""
_OF_ANALOG: Final = _STAGES | {"poor_stratification": "dark", "saturated": ""}
UNLIT: Final = "none: the laser was off; leave these files out, or name them as dark_files"


def settings_in_words(step: PlannedStep) -> Iterator[str]:
    """Yield the settings of a step with their units."""
    model = settings_model(step)
    for key, value in step.settings.items():
        unit = "" if value is None else unit_of(model, key)
        words = written(value, unit) if isinstance(value, float) else f"{value} {unit}".rstrip()
        yield f"{key} {words}"


def decided_by(plan: Plan, product: ProductRecord, flag: str) -> str:
    """Return which settings of a plan a flag of a product follows from; empty if from none."""
    if flag == "no_signal":
        return UNLIT
    analog = file_channels(product.channel)[-1].startswith("analog_")
    stage = (_OF_ANALOG if analog else _STAGES).get(flag)
    channels = (product.channel, *file_channels(product.channel))
    entries: tuple[PlannedStep | LeftOut, ...] = (*plan.steps, *plan.left_out)
    for entry in entries:
        if entry.name == stage and entry.channel in channels:
            stated = settings_in_words(entry) if isinstance(entry, PlannedStep) else ()
            return f"{entry.name}: {', '.join((*stated, entry.reason))}"
    return ""


def rejection_rows(scenes: Iterable[SceneOutcome]) -> Iterator[tuple[str, str, str, str]]:
    """Yield product, flag, share of the values, and settings, of flags that reject many of them."""
    rejected: Counter[tuple[str, str, str]] = Counter()
    values: Counter[str] = Counter()
    for scene in scenes:
        plan = scene.plan or Plan(scene.scene, (), ())
        for product in scene.products:
            name = f"{product.kind} {product.channel} of {scene.instrument}"
            values[name] += product.values
            # A record may be of a kind that is not installed.
            flagged = product.flagged if product.kind in kinds() else {}
            for bit, count in ((flags_of(product.kind).named(f), n) for f, n in flagged.items()):
                if bit and bit.severity is Severity.REJECT:
                    rejected[name, bit.word, decided_by(plan, product, bit.word)] += count
    for (name, flag, words), count in rejected.most_common():
        if words and count >= MANY * values[name]:
            yield name, flag, percent(count / values[name]), words

"""What one product depends on: its part of the plan, of the campaign and of the inputs.

A scene gives several products. Each is fresh or stale by itself, so what is no part of it must
neither be told in it nor make it stale.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from lidarops.campaign.model import Campaign, InstrumentFacts, as_settings
from lidarops.plan.signal_rules import GLUED, StepName, parts_of
from lidarops.records import InputRecord, Plan, ProductKind, Role, Scene, Step

Wanted = tuple[ProductKind, str]
"""Kind and channel of a product."""

_KINDS: Final = frozenset(kind.value for kind in ProductKind)
_ONLY_FOR: Final[Mapping[str, frozenset[str]]] = {
    StepName.BACKGROUND: frozenset({ProductKind.SIGNAL, ProductKind.VISIBILITY}),
    StepName.RANGE_WINDOW: frozenset({ProductKind.HOMOGENEOUS, ProductKind.VISIBILITY}),
    StepName.LOOK: frozenset({ProductKind.HOMOGENEOUS}),
    StepName.ALONG_PATH: frozenset({ProductKind.HOMOGENEOUS}),
    StepName.GRADIENT: frozenset({ProductKind.MULTIANGLE}),
    StepName.GRADIENT_REGRESSOR: frozenset({ProductKind.MULTIANGLE}),
    StepName.ROBUST: frozenset({ProductKind.MULTIANGLE}),
    StepName.VERTICAL: frozenset({ProductKind.MULTIANGLE}),
    StepName.CORRELATION: frozenset({ProductKind.MULTIANGLE}),
    StepName.LAYERS: frozenset({ProductKind.MULTIANGLE}),
    StepName.PRIOR: frozenset({ProductKind.VISIBILITY}),
    StepName.AVERAGE: frozenset({ProductKind.ELASTIC, ProductKind.VISIBILITY}),
    StepName.MOLECULAR: frozenset({ProductKind.ELASTIC, ProductKind.MULTIANGLE}),
    StepName.KNOWN_SHAPE: frozenset({ProductKind.ELASTIC}),
    StepName.REFERENCE: frozenset({ProductKind.ELASTIC}),
}
"""Steps that serve some kinds only. Any other step counts for all."""

_OF_CAMPAIGN: Final = frozenset(
    {"all_steps", "archive", "output", "catalog", "superseded", "scenes", "simulation", "stations",
     "instruments", "networks"}
)  # fmt: skip
_OF_INSTRUMENT: Final = frozenset({"files", "dark_files", "header_position", "facts", "products"})
"""Settings that no product depends on but by plan, scene and inputs. Any other setting counts."""
_EDGES: Final = frozenset({"valid_from", "valid_to"})
_PROFILES: Final = ("molecular_profile", "overlap_profile")


def wanted(plan: Plan) -> tuple[Wanted, ...]:
    """Return kind and channel of the products that a plan gives, in its order."""
    found = ((ProductKind(step.name), step.channel) for step in plan.steps if step.name in _KINDS)
    return tuple(dict.fromkeys(found))


def plan_closure(plan: Plan, products: Collection[Wanted]) -> Plan:
    """Return the part of a plan that some of its products need.

    Parameters
    ----------
    plan : Plan
    products : collection of (ProductKind, str)
        Kind and channel of each.

    Returns
    -------
    Plan
        Equal for a product whatever else the plan it was taken from holds.
    """
    if any(step.instrument for step in plan.steps):
        return _part_of_network(plan, {kind.value for kind, _ in products})
    kinds: dict[str, set[str]] = {}
    for kind, channel in products:
        kinds.setdefault(channel, set()).add(kind.value)
        for parent in parts_of(channel) if channel.startswith(GLUED) else ():
            kinds.setdefault(parent, set())
    steps = tuple(
        _read_for(step, kinds)
        for step in plan.steps
        if step.channel in kinds and _serves(step.name, kinds[step.channel])
    )
    left_out = tuple(
        left
        for left in plan.left_out
        if left.channel in kinds and _serves(left.name, kinds[left.channel])
    )
    return replace(plan, steps=steps, left_out=left_out)


def of_kinds(plan: Plan, kinds: Collection[ProductKind]) -> Plan:
    """Return what a plan tells of some kinds of products: what they need, and what is left out.

    Parameters
    ----------
    plan : Plan
    kinds : collection of ProductKind
        All where empty.
    """
    if not kinds:
        return plan
    products = [product for product in wanted(plan) if product[0] in kinds]
    # What the members of a network share would stay without its product.
    mine = plan_closure(plan, products) if products else replace(plan, steps=(), left_out=())
    told = {*kinds, StepName.READ}
    left_out = tuple(left for left in plan.left_out if left.name in told or left in mine.left_out)
    return replace(mine, left_out=left_out)


def _part_of_network(plan: Plan, kinds: set[str]) -> Plan:
    # All members and channels meet in each product.
    return replace(
        plan,
        steps=tuple(step for step in plan.steps if _serves(step.name, kinds)),
        left_out=tuple(left for left in plan.left_out if _serves(left.name, kinds)),
    )


def _serves(step: str, kinds: set[str]) -> bool:
    if step in _KINDS:
        return step in kinds
    return step not in _ONLY_FOR or not kinds.isdisjoint(_ONLY_FOR[step])


def _read_for(step: Step, kinds: Mapping[str, set[str]]) -> Step:
    """Tell of a reading only those who are here, as the others may change."""
    if step.name != StepName.READ:
        return step
    asking = sorted(kinds[step.channel])
    asking += [
        name for name in sorted(kinds) if name.startswith(GLUED) and step.channel in parts_of(name)
    ]
    return replace(step, reason="asked for by " + " and ".join(asking))


class Settings:
    """The parts of a campaign that the contents of its products depend on."""

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        told = as_settings(campaign)
        self._common = {key: told[key] for key in sorted(told.keys() - _OF_CAMPAIGN)}
        self._stations = told["stations"]
        self._networks = told.get("networks", {})
        self._instruments = {
            name: {key: value for key, value in known.items() if key not in _OF_INSTRUMENT}
            for name, known in told["instruments"].items()
        }

    def of(self, scene: Scene, plan: Plan, channel: str) -> dict[str, Any]:
        """Return what a product of a scene depends on besides its inputs, as plain JSON types.

        Parameters
        ----------
        scene : Scene
        plan : Plan
            The product's, from `plan_closure`.
        channel : str
            Of the product.
        """
        members = scene.members or (scene,)
        return {
            "campaign": self._common,
            "network": self._networks.get(scene.instrument) if scene.members else None,
            "scene": [scene.id, scene.start.isoformat(), scene.stop.isoformat()],
            "members": [
                {
                    "station": self._stations[member.station],
                    "instrument": self._instruments[member.instrument],
                    "facts": facts(facts_of(self._campaign, member), plan, channel),
                }
                for member in members
            ],
        }


def facts_of(campaign: Campaign, scene: Scene) -> InstrumentFacts:
    """Return what is known of the instrument of a scene at its time."""
    moment = scene.granules[0].start if scene.granules else None
    return campaign.instruments[scene.instrument].facts_at(moment or scene.start)


def facts(known: InstrumentFacts, plan: Plan, channel: str) -> dict[str, Any]:
    """Return what is known of an instrument as far as a product depends on it.

    Parameters
    ----------
    known : InstrumentFacts
    plan : Plan
        The product's, from `plan_closure`.
    channel : str
        Of the product.

    Returns
    -------
    dict
        Plain JSON types, as those of `known`, without the edges of its validity period: a period
        that is closed changes nothing within it.
    """
    told = as_settings(known)
    channels = {step.channel for step in plan.steps} | {channel}
    named = {value for step in plan.steps for value in step.settings.values() if _is_text(value)}
    for name in _PROFILES:
        if told.get(name) not in named:
            told = {**told, name: None}
    return {
        **{key: value for key, value in told.items() if key not in _EDGES},
        "channels": {name: fact for name, fact in told["channels"].items() if name in channels},
    }


def asked(products: Mapping[str, Any] | None, channel: str) -> dict[str, Any] | None:
    """Return the settings of a kind of product as if they asked for one channel only."""
    return None if products is None else {**products, "channels": [channel]}


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def inputs(plan: Plan, files: Iterable[InputRecord]) -> tuple[InputRecord, ...]:
    """Return those of a scene's files that a part of its plan reads.

    Parameters
    ----------
    plan : Plan
        From `plan_closure`.
    files : iterable of InputRecord
        Of the scene.
    """
    dark = any(step.name == StepName.DARK for step in plan.steps)
    named = {step.settings.get(key) for step in plan.steps for key in _PROFILES}
    return tuple(
        used
        for used in files
        if used.role is Role.SIGNAL or (used.role is Role.DARK and dark) or used.path in named
    )


def digest(value: Any) -> str:
    """Return the sha256 of plain JSON types."""
    return hashlib.sha256(
        json.dumps(value, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def digest_of_inputs(files: Sequence[InputRecord]) -> str:
    """Return the sha256 of the contents of files and their roles, whatever their names."""
    # The JSON that `digest` would make of them, which has nothing to escape, at a quarter of the
    # cost: there are thousands of files, and this is asked of every product.
    contents = sorted([f'["{used.role}","{used.sha256}"]' for used in files])
    return hashlib.sha256(f"[{','.join(contents)}]".encode()).hexdigest()

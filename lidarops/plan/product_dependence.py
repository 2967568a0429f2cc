"""Determine what one product depends on: its part of the plan, of the campaign and of the inputs.

A scene gives several products, and each is up to date or stale by itself. Whatever a product does
not depend on must neither appear in it nor make it stale.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from lidarops.campaign.model import Campaign, InstrumentFacts, as_settings
from lidarops.kinds import kinds
from lidarops.plan.rules import StepName
from lidarops.plan.signal_rules import GLUED, glued_parts, required_by
from lidarops.records import InputRecord, Plan, Role, Scene, Step

ProductKey = tuple[str, str]
"""Kind and channel of a product."""

_KINDS: Final = frozenset(kind for kind in kinds())
_ONLY_FOR: Final[Mapping[str, frozenset[str]]] = {
    StepName.BACKGROUND: frozenset({"signal", "visibility"}),
    StepName.RANGE_WINDOW: frozenset({"homogeneous", "visibility"}),
    StepName.LOOK: frozenset({"homogeneous"}),
    StepName.ALONG_PATH: frozenset({"homogeneous"}),
    StepName.GRADIENT: frozenset({"multiangle"}),
    StepName.GRADIENT_REGRESSOR: frozenset({"multiangle"}),
    StepName.ROBUST: frozenset({"multiangle"}),
    StepName.VERTICAL: frozenset({"multiangle"}),
    StepName.CORRELATION: frozenset({"multiangle"}),
    StepName.LAYERS: frozenset({"multiangle"}),
    StepName.PRIOR: frozenset({"visibility"}),
    StepName.AVERAGE: frozenset({"elastic", "visibility"}),
    StepName.MOLECULAR: frozenset({"elastic", "multiangle"}),
    StepName.KNOWN_SHAPE: frozenset({"elastic"}),
    StepName.REFERENCE: frozenset({"elastic"}),
}
"""Steps that serve only some kinds of product. All other steps serve every kind."""

_OF_CAMPAIGN: Final = frozenset(
    {"all_steps", "archive", "output", "catalog", "superseded", "scenes", "simulation", "stations",
     "instruments", "networks"}
)  # fmt: skip
_OF_INSTRUMENT: Final = frozenset({"files", "dark_files", "header_position", "facts", "products"})
"""Settings that affect products only through plan, scene and inputs. All others count."""
_EDGES: Final = frozenset({"valid_from", "valid_to"})
_PROFILES: Final = ("molecular_profile", "overlap_profile")


def planned_products(plan: Plan) -> tuple[ProductKey, ...]:
    """Return kind and channel of the products that a plan makes, in its order."""
    keys = ((step.name, step.channel) for step in plan.steps if step.name in _KINDS)
    return tuple(dict.fromkeys(keys))


def plan_closure(plan: Plan, products: Collection[ProductKey]) -> Plan:
    """Return the part of a plan that the given products need.

    Parameters
    ----------
    plan : Plan
    products : collection of (str, str)
        Kind and channel of each product.

    Returns
    -------
    Plan
        The same for a product, whatever else the whole plan holds.
    """
    if any(step.instrument for step in plan.steps):
        return _network_closure(plan, {kind for kind, _ in products})
    kinds: dict[str, set[str]] = {}
    for kind, channel in products:
        kinds.setdefault(channel, set()).add(kind)
        for parent in glued_parts(channel) if channel.startswith(GLUED) else ():
            kinds.setdefault(parent, set())
    steps = tuple(
        _with_requesters(step, kinds)
        for step in plan.steps
        if step.channel in kinds and _serves(step.name, kinds[step.channel])
    )
    left_out = tuple(
        omission
        for omission in plan.left_out
        if omission.channel in kinds and _serves(omission.name, kinds[omission.channel])
    )
    return replace(plan, steps=steps, left_out=left_out)


def plan_of_kinds(plan: Plan, kinds: Collection[str]) -> Plan:
    """Return the part of a plan that concerns some kinds of product: their steps and omissions.

    Parameters
    ----------
    plan : Plan
    kinds : collection of str
        All kinds where empty.
    """
    if not kinds:
        return plan
    products = [product for product in planned_products(plan) if product[0] in kinds]
    # Without a product, steps that the members of a network share would remain.
    closure = plan_closure(plan, products) if products else replace(plan, steps=(), left_out=())
    names = {*kinds, StepName.READ}
    left_out = tuple(
        omission
        for omission in plan.left_out
        if omission.name in names or omission in closure.left_out
    )
    return replace(closure, left_out=left_out)


def _network_closure(plan: Plan, kinds: set[str]) -> Plan:
    """Return the part of a network's plan for some kinds; they need all members and channels."""
    return replace(
        plan,
        steps=tuple(step for step in plan.steps if _serves(step.name, kinds)),
        left_out=tuple(omission for omission in plan.left_out if _serves(omission.name, kinds)),
    )


def _serves(step: str, kinds: set[str]) -> bool:
    if step in _KINDS:
        return step in kinds
    return step not in _ONLY_FOR or not kinds.isdisjoint(_ONLY_FOR[step])


def _with_requesters(step: Step, kinds: Mapping[str, set[str]]) -> Step:
    """Return a step whose reason, if it reads a channel, names only the requesters in `kinds`."""
    if step.name != StepName.READ:
        return step
    requesters = sorted(kinds[step.channel])
    requesters += [
        name
        for name in sorted(kinds)
        if name.startswith(GLUED) and step.channel in glued_parts(name)
    ]
    return replace(step, reason=required_by(requesters))


class Settings:
    """The parts of a campaign on which the contents of its products depend."""

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        settings = as_settings(campaign)
        self._common = {key: settings[key] for key in sorted(settings.keys() - _OF_CAMPAIGN)}
        self._stations = settings["stations"]
        self._networks = settings.get("networks", {})
        self._instruments = {
            name: {key: value for key, value in known.items() if key not in _OF_INSTRUMENT}
            for name, known in settings["instruments"].items()
        }

    def of(self, scene: Scene, plan: Plan, channel: str) -> dict[str, Any]:
        """Return what a product depends on besides its inputs, as plain JSON types.

        Parameters
        ----------
        scene : Scene
        plan : Plan
            Plan of the product, from `plan_closure`.
        channel : str
            Channel of the product.
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
                    "facts": facts_settings(scene_facts(self._campaign, member), plan, channel),
                }
                for member in members
            ],
        }


def scene_facts(campaign: Campaign, scene: Scene) -> InstrumentFacts:
    """Return the facts about the instrument of a scene at its time."""
    moment = scene.granules[0].start if scene.granules else None
    return campaign.instruments[scene.instrument].facts_at(moment or scene.start)


def facts_settings(known: InstrumentFacts, plan: Plan, channel: str) -> dict[str, Any]:
    """Return the facts about an instrument on which a product depends.

    Parameters
    ----------
    known : InstrumentFacts
    plan : Plan
        Plan of the product, from `plan_closure`.
    channel : str
        Channel of the product.

    Returns
    -------
    dict
        `known` as plain JSON types, without the edges of its validity period, because closing a
        period changes nothing within it.
    """
    settings = as_settings(known)
    channels = {step.channel for step in plan.steps} | {channel}
    named = {value for step in plan.steps for value in step.settings.values() if _is_text(value)}
    for name in _PROFILES:
        if settings.get(name) not in named:
            settings = {**settings, name: None}
    return {
        **{key: value for key, value in settings.items() if key not in _EDGES},
        "channels": {name: fact for name, fact in settings["channels"].items() if name in channels},
    }


def single_channel_settings(
    products: Mapping[str, Any] | None, channel: str
) -> dict[str, Any] | None:
    """Return the settings of a kind of product as if only one channel were requested."""
    return None if products is None else {**products, "channels": [channel]}


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def product_inputs(plan: Plan, files: Iterable[InputRecord]) -> tuple[InputRecord, ...]:
    """Return the files of a scene that a part of its plan reads.

    Parameters
    ----------
    plan : Plan
        Plan of the product, from `plan_closure`.
    files : iterable of InputRecord
        Files of the scene.
    """
    dark = any(step.name == StepName.DARK for step in plan.steps)
    named = {step.settings.get(key) for step in plan.steps for key in _PROFILES}
    return tuple(
        file
        for file in files
        if file.role is Role.SIGNAL or (file.role is Role.DARK and dark) or file.path in named
    )


def digest(value: Any) -> str:
    """Return the sha256 of plain JSON types."""
    return hashlib.sha256(
        json.dumps(value, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def inputs_digest(files: Sequence[InputRecord]) -> str:
    """Return the sha256 of the contents and roles of files, independent of their names."""
    # Writes the JSON of `digest` directly, at a quarter of its cost: every product needs this,
    # for thousands of files.
    contents = sorted([f'["{file.role}","{file.sha256}"]' for file in files])
    return hashlib.sha256(f"[{','.join(contents)}]".encode()).hexdigest()

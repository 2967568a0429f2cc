"""A job: everything that a worker needs to process one scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarops.campaign.model import Campaign, InstrumentFacts, Station, as_settings
from lidarops.kinds import Scope, kinds_of
from lidarops.netcdf import provenance
from lidarops.netcdf.context import Context
from lidarops.raw.formats import raw_format
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    InputRecord,
    Plan,
    Provenance,
    Scene,
    Stamp,
)
from lidarops.scene import dependence
from lidarops.scene.case import REQUEST
from lidarops.scene.dependence import ProductKey, is_product, scene_facts
from lidarops.system.code_version import code_version


@dataclass(frozen=True, slots=True)
class Place:
    """What stands at the place of a product that is made."""

    stamp: Stamp
    """Of the product to be made."""
    sha256: str = ""
    """Of the product that it replaces; empty where it replaces none."""
    former: Stamp = field(default_factory=Stamp)
    """Of that product."""


@dataclass(frozen=True, slots=True)
class Job:
    """Everything that a worker needs to process one scene."""

    campaign: Campaign
    scene: Scene
    plan: Plan
    profiles_per_chunk: int | None = None
    products: tuple[ProductKey, ...] | None = None
    """Those to write; all of the plan where None. The others are only compared with them."""
    places: Mapping[ProductKey, Place] = field(default_factory=dict)
    """Of products that were made before."""

    def place(self, kind: str, channel: str) -> Place:
        """Return what stands at the place of a product."""
        return self.places.get((kind, channel), Place(Stamp()))

    def writes(self, kind: str, channel: str) -> bool:
        """Whether a product is written."""
        return self.products is None or (kind, channel) in self.products

    @property
    def facts(self) -> InstrumentFacts:
        """Facts about the instrument at the time of the scene."""
        return scene_facts(self.campaign, self.scene)


def nothing_to_do(plan: Plan) -> str:
    """Return why a plan makes no product: omissions of requested steps, those of products first."""
    requested = [omission for omission in plan.left_out if omission.rule != REQUEST]
    omissions = sorted(requested or plan.left_out, key=lambda omission: not is_product(omission))
    reasons = dict.fromkeys(
        f"{omission.name} of {omission.channel}: {omission.reason}" for omission in omissions
    )
    return "nothing to do: " + "; ".join(reasons)


def product_context(
    job: Job,
    scene: Scene,
    kind: str,
    channel: ChannelLayout,
    wavelength: float,
    inputs: tuple[InputRecord, ...],
) -> Context:
    """Return the context of one product.

    Parameters
    ----------
    job : Job
        With the plan as it is carried out.
    scene : Scene
        With usable granules only.
    kind : str
        Kind of product.
    channel : ChannelLayout
    wavelength : float
        m.
    inputs : tuple of InputRecord
        Files of the scene.
    """
    campaign = job.campaign
    # A product states only what it depends on.
    closure = dependence.plan_closure(job.plan, [(kind, channel.name)])
    notes = dependence.product_notes(scene, closure, channel.name)
    return Context(
        mode=DetectionMode(channel.mode),
        wavelength=wavelength,
        station_key=scene.station,
        station=_station(campaign, scene),
        instrument_key=scene.instrument,
        instrument_name=_instrument_name(campaign, scene),
        metadata=campaign.metadata,
        title=campaign.title,
        summary=campaign.summary,
        start=scene.start,
        stop=scene.stop,
        notes=notes,
        unused=dependence.product_unused(scene, closure),
        provenance=Provenance(
            campaign=campaign.name,
            scene=scene.id,
            kind=kind,
            channel=channel.name,
            inputs=dependence.product_inputs(closure, inputs),
            plan=closure,
            settings=recorded_settings(job, scene, closure, (kind, channel.name)),
            versions=provenance.package_versions(),
            code_version=code_version(kind),
        ),
        raw_format=" and ".join(
            sorted(
                {raw_format(granule.format).title for granule in (*scene.granules, *scene.dark)}
                if dependence.reads_files(closure)
                else ()
            )
        ),
        stamp=job.place(kind, channel.name).stamp,
    )


def recorded_settings(
    job: Job, scene: Scene, plan: Plan, product: dependence.ProductKey
) -> dict[str, Any]:
    """Return what a product states of the campaign: all that is needed to make it again.

    Parameters
    ----------
    job : Job
    scene : Scene
        With usable granules only.
    plan : Plan
        Plan of the product, from `plan_closure`.
    product : (str, str)
        Its kind and channel.
    """
    campaign, unused = job.campaign, dependence.product_unused(scene, plan)
    return {
        **_campaign_settings(job, plan, *product),
        "metadata": as_settings(campaign.metadata),
        "keys": {"station": scene.station, "instrument": scene.instrument},
        "campaign": {"title": campaign.title, "summary": campaign.summary},
        "window": [scene.start.isoformat(), scene.stop.isoformat()],
        "notes": list(dependence.product_notes(scene, plan, product[1])),
        **({dependence.UNUSED: [file._asdict() for file in unused]} if unused else {}),
    }


def _campaign_settings(job: Job, plan: Plan, kind: str, channel: str) -> dict[str, Any]:
    """Return the settings of stations and instruments on which a product depends."""
    campaign, scene = job.campaign, job.scene
    if not scene.members:
        instrument = campaign.instruments[scene.instrument]
        # Other products state the facts that they were made with.
        facts = job.facts if dependence.reads_files(plan) else InstrumentFacts()
        return {
            "station": as_settings(campaign.stations[scene.station]),
            "facts": dependence.facts_settings(facts, plan, channel),
            # `lidarops reproduce` also needs these to make the same bytes.
            "instrument": instrument.name,
            # As if only this product were requested, here and below.
            "products": {**as_settings(instrument.products)[kind], "channels": [channel]},
        }
    network = as_settings(campaign.networks[scene.instrument])
    others = {other.name for other in kinds_of(Scope.NETWORK)} - {kind}
    return {
        "network": {key: value for key, value in network.items() if key not in others},
        "members": {
            member.instrument: {
                "station": as_settings(campaign.stations[member.station]),
                "facts": dependence.facts_settings(
                    dependence.scene_facts(campaign, member), plan, channel
                ),
                "instrument": campaign.instruments[member.instrument].name,
                "keys": {"station": member.station, "instrument": member.instrument},
                "files": sorted(file.path for file in (*member.granules, *member.dark)),
            }
            for member in scene.members
        },
    }


def _station(campaign: Campaign, scene: Scene) -> Station:
    """Return the station of a scene; for a network, the mean position of its stations."""
    if not scene.members:
        return campaign.stations[scene.station]
    places = [campaign.stations[member.station] for member in scene.members]
    latitude, longitude, altitude = (
        sum(getattr(place, name) for place in places) / len(places)
        for name in ("latitude", "longitude", "altitude")
    )
    return Station(
        name=campaign.networks[scene.instrument].name or scene.instrument,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
    )


def _instrument_name(campaign: Campaign, scene: Scene) -> str:
    if scene.members:
        members = (
            campaign.instruments[member.instrument].name or campaign.stations[member.station].name
            for member in scene.members
        )
        return "network of " + ", ".join(members)
    return campaign.instruments[scene.instrument].name or scene.instrument

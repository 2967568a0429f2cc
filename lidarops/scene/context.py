"""The context of the products of a scene: what their files state besides numbers."""

from __future__ import annotations

from typing import Any

from lidarops.campaign.model import Campaign, Station, as_settings
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
)
from lidarops.scene import dependence
from lidarops.scene.job import Job
from lidarops.system.code_version import code_version


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
            sorted({raw_format(granule.format).title for granule in (*scene.granules, *scene.dark)})
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
    campaign = job.campaign
    return {
        **_campaign_settings(job, plan, *product),
        "metadata": as_settings(campaign.metadata),
        "keys": {"station": scene.station, "instrument": scene.instrument},
        "campaign": {"title": campaign.title, "summary": campaign.summary},
        "window": [scene.start.isoformat(), scene.stop.isoformat()],
        "notes": list(dependence.product_notes(scene, plan, product[1])),
        **dependence.unused_settings(scene, plan),
    }


def _campaign_settings(job: Job, plan: Plan, kind: str, channel: str) -> dict[str, Any]:
    """Return the settings of stations and instruments on which a product depends."""
    campaign, scene = job.campaign, job.scene
    if not scene.members:
        instrument = campaign.instruments[scene.instrument]
        return {
            "station": as_settings(campaign.stations[scene.station]),
            "facts": dependence.facts_settings(job.facts, plan, channel),
            # `lidarops reproduce` also needs these to make the same bytes.
            "instrument": instrument.name,
            "products": dependence.single_channel_settings(
                as_settings(instrument.products).get(kind), channel
            ),
        }
    return {
        "network": dependence.single_kind_settings(
            as_settings(campaign.networks[scene.instrument]), kind
        ),
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

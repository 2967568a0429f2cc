"""The recipe of a product: what its provenance says of campaign, plan and inputs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath
from typing import Any, Final

from pydantic import ValidationError

from lidarops.campaign.model import Campaign
from lidarops.errors import ProductError
from lidarops.netcdf.read import read_origin
from lidarops.raw.formats import RawFile, read_raw_header
from lidarops.raw.header import named_layout, recorder_names
from lidarops.records import (
    Granule,
    InputRecord,
    LeftOut,
    Plan,
    PlannedStep,
    Role,
    Scene,
    Stamp,
    Status,
    UnusedFile,
    after_pulse,
)
from lidarops.scene.dependence import UNUSED

RAW: Final = (Role.SIGNAL, Role.DARK)
"""Roles of files in the archive; paths of other inputs start from the campaign folder."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a product was made from, and how, according to itself."""

    file: Path
    kind: str
    channel: str
    campaign_name: str
    settings: Mapping[str, Any]
    plan: Plan
    inputs: tuple[InputRecord, ...]
    code_version: str
    versions: Mapping[str, str]
    stamp: Stamp
    """Version and time of writing that the product states."""

    @classmethod
    def of(cls, file: Path) -> Recipe:
        """Read the provenance of a product; raise ProductError if it is insufficient."""
        document, attributes_of_file = read_origin(file)
        try:
            entities = document["entity"]
            attributes = entities["lidarops:product"]
            software = document["agent"]["lidarops:software"]
            recipe = cls(
                file=file,
                kind=str(attributes["lidarops:kind"]),
                channel=str(attributes["lidarops:channel"]),
                campaign_name=str(attributes["lidarops:campaign"]),
                settings=json.loads(attributes["lidarops:settings"]),
                plan=_plan(json.loads(entities["lidarops:plan"]["lidarops:json"])),
                inputs=_inputs(entities, document["used"]),
                code_version=software["lidarops:code_version"],
                versions=dict(package.split(" ", 1) for package in software["lidarops:versions"]),
                stamp=Stamp(
                    int(attributes_of_file["product_version"]),
                    datetime.fromisoformat(str(attributes_of_file["date_modified"])),
                ),
            )
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise _insufficient(file, repr(error)) from error
        for record in recipe.inputs:
            # It is read, and copies are written under it: a forged product could choose it freely.
            if not stays_inside(record.path):
                raise ProductError(
                    f"names an input outside its archive: {record.path}",
                    file=file,
                    field="provenance",
                    remedy="lidarops does not write such products: do not trust this one",
                )
        return recipe

    def campaign(self, archive: Path, folder: Path, output: Path) -> Campaign:
        """Return a campaign that gives only this product; its other inputs are in `folder`."""
        settings = self.settings
        try:
            campaign = Campaign.model_validate(
                {
                    **settings["campaign"],
                    "name": self.campaign_name,
                    "archive": str(archive),
                    "output": str(output),
                    "metadata": settings["metadata"],
                    **self._instruments(),
                }
            )
        except (KeyError, TypeError, ValidationError) as error:
            raise _insufficient(self.file, str(error)) from error
        campaign._folder = str(folder)  # noqa: SLF001 - as `load_campaign` sets it
        return campaign

    def _instruments(self) -> dict[str, Any]:
        """Return the stations, instruments and network that the product records."""
        settings = self.settings
        keys = settings["keys"]
        if "network" in settings:
            members = settings["members"]
            return {
                "stations": {
                    member["keys"]["station"]: member["station"] for member in members.values()
                },
                "instruments": {name: _instrument(member, {}) for name, member in members.items()},
                "networks": {keys["instrument"]: settings["network"]},
            }
        products = {self.kind: settings["products"]}
        return {
            "stations": {keys["station"]: settings["station"]},
            "instruments": {keys["instrument"]: _instrument(settings, products)},
        }

    def scene(self, archive: Path) -> Scene:
        """Return the scene of the product, from the headers of the raw files in a folder."""
        settings = self.settings
        try:
            if "network" not in settings:
                return self._scene_of(archive, settings, self.inputs)
            members = tuple(
                self._scene_of(archive, member, own)
                # The members of a product are sorted by name; the network defines their order.
                for name in settings["network"]["instruments"]
                for member in [settings["members"].get(name)]
                if member is not None
                for own in [[used for used in self.inputs if used.path in set(member["files"])]]
            )
            whole = self._scene_of(archive, settings, ())
        except (KeyError, TypeError, ValueError) as error:
            raise _insufficient(self.file, repr(error)) from error
        granules = (granule for member in members for granule in member.granules)
        dark = (granule for member in members for granule in member.dark)
        return replace(
            whole,
            granules=tuple(sorted(granules, key=_order)),
            dark=tuple(sorted(dark, key=_order)),
            members=members,
        )

    def _scene_of(
        self, archive: Path, part: Mapping[str, Any], inputs: Iterable[InputRecord]
    ) -> Scene:
        """Return the scene of one instrument, with its part of the settings and inputs."""
        keys = part["keys"]
        start, stop = (datetime.fromisoformat(moment) for moment in self.settings["window"])
        raw = (record for record in inputs if record.role in RAW)
        read = (_granule(archive, record, keys["instrument"], part["facts"]) for record in raw)
        granules = sorted((_named(g, self.plan, part["facts"]) for g in read), key=_order)
        return Scene(
            id=self.plan.scene,
            campaign=self.campaign_name,
            station=keys["station"],
            instrument=keys["instrument"],
            start=start,
            stop=stop,
            notes=tuple(self.settings["notes"]),
            unused=self.unused,
            granules=tuple(granule for granule in granules if granule.role is Role.SIGNAL),
            dark=tuple(granule for granule in granules if granule.role is Role.DARK),
            products=tuple(record for record in self.inputs if record.role is Role.PRODUCT),
        )

    @property
    def unused(self) -> tuple[UnusedFile, ...]:
        """The raw files that the product states as unused."""
        return tuple(
            UnusedFile(str(file["path"]), Role(file["role"]), str(file["reason"]))
            for file in self.settings.get(UNUSED, ())
        )


def stays_inside(path: str) -> bool:
    """Return whether a path stays in the folder that it is relative to."""
    pure = PurePosixPath(path)
    return not (pure.is_absolute() or ".." in pure.parts or "\0" in path)


def _insufficient(file: Path, problem: str) -> ProductError:
    return ProductError(
        f"its provenance is not sufficient to make the product again: {problem}",
        file=file,
        field="provenance",
        remedy="reprocess the campaign with this version of lidarops",
    )


def _plan(fields: Mapping[str, Any]) -> Plan:
    return Plan(
        fields["scene"],
        tuple(PlannedStep(**step) for step in fields["steps"]),
        tuple(LeftOut(**left) for left in fields["left_out"]),
    )


def _inputs(
    entities: Mapping[str, Any], uses: Mapping[str, Mapping[str, Any]]
) -> tuple[InputRecord, ...]:
    """Return the inputs of a PROV document, in which files of equal content are one entity."""
    paths = {
        name: iter([paths] if isinstance(paths, str) else list(paths))
        for name, entity in entities.items()
        for paths in [entity.get("lidarops:path")]
        if paths is not None
    }
    # The writer numbered the uses in sorted order; the paths of an entity have the same order.
    numbered = [uses[name] for name in sorted(uses, key=lambda name: int(name[len("_:use") :]))]
    return tuple(
        InputRecord(
            next(paths[use["prov:entity"]]),
            Role(use["prov:role"]),
            str(entities[use["prov:entity"]]["lidarops:sha256"]),
        )
        for use in numbered
    )


def _instrument(settings: Mapping[str, Any], products: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "station": settings["keys"]["station"],
        "name": settings["instrument"],
        "files": "*",
        "facts": [settings["facts"]],
        "products": products,
    }


def _order(granule: Granule) -> tuple[bool, datetime | None, str]:
    return granule.start is not None, granule.start, granule.path


def _granule(root: Path, record: InputRecord, instrument: str, facts: Mapping[str, Any]) -> Granule:
    with RawFile(root / record.path) as file:
        header = read_raw_header(file)
    shift = timedelta(seconds=facts["clock_offset"])
    return Granule(
        path=record.path,
        size=header.size,
        mtime_ns=0,
        instrument=instrument,
        role=record.role,
        status=Status.GOOD,
        start=header.start - shift,
        stop=header.stop - shift,
        zenith_angle=header.zenith_angle,
        azimuth=header.azimuth,
        altitude=header.altitude,
        layout=header.layout,
        format=header.format,
    )


def _named(granule: Granule, plan: Plan, facts: Mapping[str, Any]) -> Granule:
    """Return a granule with the channel names of a product, whose plan states their recorders.

    Without the bins before the pulse.
    """
    own = {channel.name: channel.recorder for channel in granule.layout}
    stated = {
        step.channel: step.settings["recorder"]
        for step in plan.steps
        if step.settings.get("recorder", "") not in ("", own.get(step.channel))
        and step.instrument in ("", granule.instrument)
    }
    names = recorder_names([(granule.layout, 1, datetime.fromtimestamp(0, UTC))], stated)
    layout = named_layout(granule.layout, names)
    return replace(granule, layout=after_pulse(layout, facts.get("pre_trigger", 0.0)))

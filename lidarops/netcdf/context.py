"""The context of a product: its path, its provenance, and all that its file states besides numbers.

The global attributes follow from it, after ACDD-1.3 (`acdd13`); the provenance is W3C PROV-JSON.
"""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from typing import Any, Final
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from lidarops import __version__
from lidarops.campaign.model import Metadata, Station
from lidarops.errors import ProductError
from lidarops.netcdf.variables import CONVENTIONS, RECORDERS, STANDARD_NAME_TABLE, Layout
from lidarops.raw.header import POLARISATIONS, label_of
from lidarops.records import (
    DetectionMode,
    Provenance,
    Role,
    Stamp,
    UnusedFile,
    canonical,
    is_glued,
)

EPOCH_VARIABLE: Final = "SOURCE_DATE_EPOCH"
NAMESPACE: Final = "urn:lidarops:"

_PACKAGES: Final = ("lidarops", "netCDF4", "numba", "numpy", "scipy", "xarray")
UNUSED_INPUTS: Final = "lidarops_unused_inputs"
MOST_UNUSED: Final = 20
"""Unused files that a product names; its provenance names all."""
_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True, slots=True)
class Context(Provenance):
    """Origin of a product, its station and instrument, and texts of its campaign."""

    mode: DetectionMode
    wavelength: float
    """m; NaN where it is not known."""
    station_key: str
    station: Station
    instrument_key: str
    instrument_name: str
    metadata: Metadata
    title: str
    summary: str
    start: datetime
    """Start of the scene's window, not of its first profile."""
    stop: datetime
    notes: tuple[str, ...]
    """Notes on its raw files."""
    raw_format: str
    """Raw format of its files, in words; empty where it is made of other products."""
    unused: tuple[UnusedFile, ...] = ()
    """Raw files of its scene from which it is not made."""
    stamp: Stamp = field(default_factory=Stamp)
    """Version of its content, and when it is written; now, where it has no time."""
    path: str = field(init=False)
    """Of the product; see `product_path`."""
    written: datetime = field(init=False)
    """When the product is written, UTC; several attributes state it."""

    def __post_init__(self) -> None:
        """Add the path, and the time of writing if the stamp has none."""
        names = (self.station_key, self.instrument_key, self.kind, self.channel)
        written = self.stamp.written or writing_time()
        object.__setattr__(self, "path", product_path(names, self.scene, self.start))
        object.__setattr__(self, "written", written)
        object.__setattr__(self, "stamp", replace(self.stamp, written=written))

    @property
    def detection(self) -> str:
        """``analog``, ``photon``, or ``glued`` of both."""
        return "glued" if is_glued(self.channel) else self.mode.value


def product_path(names: tuple[str, str, str, str], scene: str, start: datetime) -> str:
    """Return the path of a product's file.

    Parameters
    ----------
    names : (str, str, str, str)
        Keys of station and instrument, kind and channel.
    scene : str
        Id of its scene.
    start : datetime
        Start of the scene.

    Returns
    -------
    str
        Relative to the product root, with forward slashes:
        ``station/instrument/kind/YYYY/station_instrument_kind_channel_YYYYMMDDTHHMMSS.nc``;
        where a window holds several range grids, the key of the grid is added.

    Raises
    ------
    ProductError
        If a name cannot be part of a file name.
    """
    # The id of a scene without its instrument: start time, and key of the grid where there are two.
    parts = (*names, scene.removeprefix(f"{names[1]}_"))
    for part in parts:
        if not _SAFE.fullmatch(part):
            raise ProductError(
                f"{part!r} cannot be part of a file name",
                field=scene,
                remedy="use letters, digits, '.', '_' and '-' in names of the campaign file",
            )
    folder = "/".join((*parts[:3], f"{start.astimezone(UTC):%Y}"))
    return f"{folder}/{'_'.join(parts)}.nc"


def product_of_path(path: str) -> tuple[str, str]:
    """Return kind and channel of a product from a path by `product_path`."""
    *names, _, file = path.split("/")
    return names[2], file.removeprefix(f"{'_'.join(names)}_").rpartition("_")[0]


def global_attributes(
    context: Context, layout: Layout, extents: Mapping[str, Any], feature_type: str
) -> dict[str, Any]:
    """Return the global attributes of a product, in the order in which they are written.

    Parameters
    ----------
    context : Context
    layout : Layout
    extents : mapping
        Attributes on the extents in time and space, from its coordinates.
    feature_type : str
        CF ``featureType`` where the layout states none.
    """
    dates = ("date_created", "date_modified", "date_issued", "date_metadata_modified")
    attributes = {
        "Conventions": CONVENTIONS,
        "featureType": layout.feature_type or feature_type,
        **_description(context, layout),
        **_people(context),
        "platform": context.station.name,
        "platform_vocabulary": "station names of the campaign",
        # Identifiers as in files of EARLINET and E-PROFILE.
        "station_ID": context.station_key,
        "wigos_station_id": context.station.wigos_station_id,
        "measurement_ID": context.scene,
        "instrument": context.instrument_name,
        "instrument_vocabulary": "instrument names of the campaign",
        **extents,
        **dict.fromkeys(dates, iso(context.written)),
        **_processing(context),
    }
    # What is not known is left out.
    return {
        name: value for name, value in attributes.items() if value or not isinstance(value, str)
    }


_DETECTION: Final = {
    "analog": "analog detection",
    "photon": "photon counting",
    "glued": "analog detection glued to photon counting",
}


def _description(context: Context, layout: Layout) -> dict[str, Any]:
    metadata = context.metadata
    station = context.station.name
    files = f"{context.raw_format} raw files" if context.raw_format else "products"
    known = math.isfinite(context.wavelength)
    wavelength = f"{context.wavelength * 1e9:.6g} nm" if known else "wavelength unknown"
    summary = (
        f"{layout.summary} Channel {context.channel} ({wavelength},"
        f" {_DETECTION[context.detection]}) of {context.instrument_name} at {station}."
    )
    references = (metadata.references, *layout.references)
    program = f"lidarops {__version__} ({context.code_version})"
    # The plan of a product holds what it depends on, such as the corrections of glued channels.
    lines = [*context.plan.lines(context.channel), f"wrote the {context.kind} product"]
    return {
        "title": f"{context.title}: {layout.title}, channel {context.channel}, {station}",
        "summary": f"{context.summary.strip()} {summary}".strip(),
        "keywords": ", ".join(layout.keywords),
        "keywords_vocabulary": "GCMD Science Keywords",
        "id": product_id(context),
        "naming_authority": metadata.naming_authority,
        "source": f"surface observation: {files} of the lidar {context.instrument_name}",
        "processing_level": layout.processing_level,
        # As the templates of NCEI name time series of profiles at stations.
        "cdm_data_type": "Station",
        "product_version": str(context.stamp.version),
        # One line for each step, as CF requires: date, step, program.
        "history": "\n".join(
            f"{iso(context.written)} {' '.join(line.split())} [{program}]" for line in lines
        ),
        "references": "\n".join(text for text in references if text),
        "comment": f"{metadata.comment.strip()} {layout.comment.strip()}".strip(),
        "acknowledgement": metadata.acknowledgement,
        "license": metadata.license,
        "standard_name_vocabulary": STANDARD_NAME_TABLE,
    }


def _people(context: Context) -> dict[str, str]:
    metadata = context.metadata
    institution = metadata.institution
    publisher = metadata.publisher_name or metadata.creator_name
    types = {institution: "institution", "": ""}
    return {
        "institution": institution,
        "project": metadata.project,
        "program": metadata.program or metadata.project,
        "creator_name": metadata.creator_name,
        "creator_type": types.get(metadata.creator_name, "person"),
        "creator_institution": institution,
        "creator_email": metadata.creator_email,
        "creator_url": metadata.creator_url,
        # As in files of EARLINET.
        "PI": metadata.principal_investigator,
        "publisher_name": publisher,
        "publisher_type": types.get(publisher, "person"),
        "publisher_institution": institution,
        "publisher_email": metadata.publisher_email or metadata.creator_email,
        "publisher_url": metadata.publisher_url or metadata.creator_url,
        "contributor_name": "The lidarops developers",
        "contributor_role": "processing software",
        "metadata_link": metadata.creator_url,
    }


def _processing(context: Context) -> dict[str, Any]:
    """Return the attributes that lidarops itself reads."""
    unused = [
        f"{'dark file ' if role is Role.DARK else ''}{path}: {reason}"
        for path, role, reason in context.unused[:MOST_UNUSED]
    ]
    if len(context.unused) > MOST_UNUSED:
        unused.append(f"{len(context.unused) - MOST_UNUSED} other raw files")
    return {
        "lidarops_campaign": context.campaign,
        "lidarops_scene": context.scene,
        "lidarops_window_start": iso(context.start),
        "lidarops_window_end": iso(context.stop),
        "lidarops_kind": context.kind,
        "lidarops_station": context.station_key,
        "lidarops_instrument": context.instrument_key,
        "lidarops_channel": context.channel,
        "lidarops_detection_mode": context.detection,
        RECORDERS: ", ".join(
            step.settings["recorder"]
            for step in context.plan.steps
            if step.settings.get("recorder") and not is_glued(step.channel)
        ),
        "lidarops_polarisation": POLARISATIONS.get(label_of(context.channel)[-1:], ""),
        "lidarops_plan_sha256": context.plan.hash,
        "lidarops_code_version": context.code_version,
        "lidarops_input_count": np.int32(len(context.inputs)),
        "lidarops_input_notes": "\n".join(context.notes),
        UNUSED_INPUTS: "\n".join(unused),
    }


def iso(moment: datetime) -> str:
    """Return a time as ISO 8601 text in UTC."""
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def duration(seconds: float) -> str:
    """Return an ISO 8601 duration, such as ``P1DT2H30M0.5S``."""
    whole, milliseconds = divmod(round(seconds * 1000), 1000)
    minutes, second = divmod(whole, 60)
    hours, minute = divmod(minutes, 60)
    days, hour = divmod(hours, 24)
    fraction = f".{milliseconds:03d}".rstrip("0") if milliseconds else ""
    parts = ((hour, "H", ""), (minute, "M", ""), (second, "S", fraction))
    clock = "".join(f"{n}{end}{unit}" for n, unit, end in parts if n or end)
    date = f"{days}D" if days else ""
    if not date and not clock:
        clock = "0S"
    return f"P{date}{'T' + clock if clock else ''}"


def prov_json(provenance: Provenance) -> str:
    """Return the provenance of a product as W3C PROV-JSON (`provo2013`).

    Inputs with equal content are one entity, because a product depends on content only.

    Returns
    -------
    str
        ASCII, with sorted keys; independent of the order of the inputs.
    """
    inputs = sorted(provenance.inputs, key=attrgetter("sha256", "path", "role"))
    files = {}
    for digest, group in groupby(inputs, key=attrgetter("sha256")):
        records = list(group)
        paths = [record.path for record in records]
        sort = "Product" if records[0].role is Role.PRODUCT else "RawFile"
        files[f"sha256:{digest}"] = {
            "prov:type": prov_type(f"lidarops:{sort}"),
            "lidarops:path": paths[0] if len(paths) == 1 else paths,
            "lidarops:sha256": digest,
        }
    plan, omissions = provenance.plan, []
    for omission in plan.left_out:
        number = "" if omission.number is None else f", {omission.number:g}"
        rule = f" [{omission.rule}{number}]" if omission.rule else ""
        omissions.append(f"{omission.name} of {omission.channel}: {omission.reason}{rule}")
    return prov_document(
        "lidarops:product",
        ("lidarops:processing", {"lidarops:scene": provenance.scene}),
        {
            "lidarops:product": {
                "prov:type": prov_type("lidarops:Product"),
                "lidarops:id": product_id(provenance),
                "lidarops:campaign": provenance.campaign,
                "lidarops:scene": provenance.scene,
                "lidarops:kind": provenance.kind,
                "lidarops:channel": provenance.channel,
                "lidarops:settings": canonical(dict(provenance.settings)),
            },
            "lidarops:plan": {
                "prov:type": prov_type("prov:Plan"),
                "lidarops:sha256": plan.hash,
                # The text of this digest.
                "lidarops:json": plan.text,
                "lidarops:left_out": omissions,
            },
            **files,
        },
        ({"prov:entity": f"sha256:{record.sha256}", "prov:role": record.role} for record in inputs),
        (provenance.code_version, provenance.versions),
        {"prov:plan": "lidarops:plan"},
    )


def prov_document(
    result: str,
    activity: tuple[str, Mapping[str, str]],
    entities: Mapping[str, Any],
    uses: Iterable[Mapping[str, str]],
    software: tuple[str, Mapping[str, str]],
    association: Mapping[str, str],
) -> str:
    """Return how a file was made as W3C PROV-JSON: ASCII, with sorted keys.

    Parameters
    ----------
    result : str
        Name of the entity that was made.
    activity : (str, mapping of str to str)
        Name of what made it, and what is stated of that.
    entities : mapping of str to dict
    uses : iterable of mapping of str to str
        What was used, besides the activity.
    software : (str, mapping of str to str)
        Code version, and the versions of packages.
    association : mapping of str to str
        What is stated of how the software did it.
    """
    name, stated = activity
    code_version, versions = software
    of_activity = {"prov:activity": name}
    document = {
        "prefix": {"lidarops": NAMESPACE, "sha256": "urn:sha256:"},
        "entity": entities,
        "activity": {name: stated},
        "agent": {
            "lidarops:software": {
                "prov:type": prov_type("prov:SoftwareAgent"),
                "lidarops:code_version": code_version,
                "lidarops:versions": [f"{key} {versions[key]}" for key in sorted(versions)],
            }
        },
        "wasGeneratedBy": {"_:generation": {"prov:entity": result, **of_activity}},
        "wasAssociatedWith": {
            "_:association": {"prov:agent": "lidarops:software", **of_activity, **association}
        },
        "used": {f"_:use{number}": {**of_activity, **use} for number, use in enumerate(uses, 1)},
    }
    return canonical(document)


def prov_type(name: str) -> dict[str, str]:
    """Return the type of an entity or agent."""
    return {"$": name, "type": "prov:QUALIFIED_NAME"}


def product_id(provenance: Provenance) -> str:
    """Return the identifier of a product: equal for equal inputs, plan, settings and code.

    Returns
    -------
    str
        UUID version 5 of kind, channel, inputs' sha256, plan hash, settings and code version.
    """
    return identifier(
        {
            "kind": provenance.kind,
            "channel": provenance.channel,
            "inputs": sorted([record.role, record.sha256] for record in provenance.inputs),
            "plan": provenance.plan.hash,
            "settings": dict(provenance.settings),
            "code_version": provenance.code_version,
        }
    )


def identifier(content: Mapping[str, Any]) -> str:
    """Return the UUID version 5 of plain JSON types."""
    return str(uuid5(NAMESPACE_URL, NAMESPACE + canonical(content)))


@cache
def package_versions() -> Mapping[str, str]:
    """Return the versions of Python and of the packages that can change a product."""
    return {name: version(name) for name in _PACKAGES} | {"python": platform.python_version()}


def writing_time() -> datetime:
    """Return the time now in UTC to the second, or that of ``SOURCE_DATE_EPOCH`` if it is set.

    Raises
    ------
    ProductError
        If ``SOURCE_DATE_EPOCH`` is not a number of seconds.
    """
    epoch = os.environ.get(EPOCH_VARIABLE, "")
    if not epoch:
        return datetime.now(UTC).replace(microsecond=0)
    try:
        return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise ProductError(
            f"is {epoch!r}, not a number of seconds",
            field=EPOCH_VARIABLE,
            remedy="set it to whole seconds since 1970-01-01, or unset it",
        ) from error

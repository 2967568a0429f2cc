"""The context of a product: its path, and all that its file states besides numbers.

The global attributes follow from it, after ACDD-1.3 (`acdd13`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Final, cast

import numpy as np

from lidarops import __version__
from lidarops.campaign.model import Metadata, Station
from lidarops.errors import ProductError
from lidarops.netcdf.provenance import product_id, writing_time
from lidarops.netcdf.variables import CONVENTIONS, STANDARD_NAME_TABLE, Layout
from lidarops.raw.header import POLARISATIONS, label_of
from lidarops.records import DetectionMode, Provenance, Role, Stamp, UnusedFile, is_glued

RECORDERS: Final = "lidarops_recorder"
UNUSED_INPUTS: Final = "lidarops_unused_inputs"
MOST_UNUSED: Final = 20
"""Unused files that a product names; its provenance names all."""
_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True, slots=True)
class Context:
    """Station, instrument and provenance of a product, and texts of its campaign."""

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
    provenance: Provenance
    raw_format: str
    """Raw format of its files, in words; empty where it is made of other products."""
    unused: tuple[UnusedFile, ...] = ()
    """Raw files of its scene from which it is not made."""
    stamp: Stamp = field(default_factory=Stamp)
    """Version of its content, and when it is written; now, where it has no time."""
    kind: str = field(init=False)
    """That of the provenance, as the two that follow."""
    channel: str = field(init=False)
    scene: str = field(init=False)

    def __post_init__(self) -> None:
        """Take what the provenance states; and the time once: several attributes state it."""
        for name in ("kind", "channel", "scene"):
            object.__setattr__(self, name, getattr(self.provenance, name))
        if self.stamp.written is None:
            object.__setattr__(self, "stamp", replace(self.stamp, written=writing_time()))

    @property
    def written(self) -> datetime:
        """When the product is written, UTC."""
        return cast("datetime", self.stamp.written)

    @property
    def detection(self) -> str:
        """``analog``, ``photon``, or ``glued`` of both."""
        return "glued" if is_glued(self.channel) else self.mode.value


def product_path(context: Context) -> str:
    """Return the path of a product's file.

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
    names = (context.station_key, context.instrument_key, context.kind, context.channel)
    return path_of_product(names, context.scene, context.start)


def path_of_product(names: tuple[str, str, str, str], scene: str, start: datetime) -> str:
    """Return the path of a product's file; see `product_path`.

    Parameters
    ----------
    names : (str, str, str, str)
        Keys of station and instrument, kind and channel.
    scene : str
        Id of its scene.
    start : datetime
        Start of the scene.
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
    """Return kind and channel of a product from a path by `path_of_product`."""
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
    return {
        "title": f"{context.title}: {layout.title}, channel {context.channel}, {station}",
        "summary": _sentences(context.summary, summary),
        "keywords": ", ".join(layout.keywords),
        "keywords_vocabulary": "GCMD Science Keywords",
        "id": product_id(context.provenance),
        "naming_authority": metadata.naming_authority,
        "source": f"surface observation: {files} of the lidar {context.instrument_name}",
        "processing_level": layout.processing_level,
        # As the templates of NCEI name time series of profiles at stations.
        "cdm_data_type": "Station",
        "product_version": str(context.stamp.version),
        "history": _history(context),
        "references": "\n".join(text for text in references if text),
        "comment": _sentences(metadata.comment, layout.comment),
        "acknowledgement": metadata.acknowledgement,
        "license": metadata.license,
        "standard_name_vocabulary": STANDARD_NAME_TABLE,
    }


def _sentences(*texts: str) -> str:
    return " ".join(text.strip() for text in texts if text.strip())


def _history(context: Context) -> str:
    """Return one line for each step, as CF requires: date, step, program."""
    program = f"lidarops {__version__} ({context.provenance.code_version})"
    # The plan of a product holds what it depends on, such as the corrections of glued channels.
    lines = [*context.provenance.plan.lines(context.channel), f"wrote the {context.kind} product"]
    return "\n".join(
        f"{iso(context.written)} {' '.join(line.split())} [{program}]" for line in lines
    )


def _people(context: Context) -> dict[str, str]:
    metadata = context.metadata
    institution = metadata.institution
    publisher = metadata.publisher_name or metadata.creator_name
    return {
        "institution": institution,
        "project": metadata.project,
        "program": metadata.program or metadata.project,
        "creator_name": metadata.creator_name,
        "creator_type": _kind_of(metadata.creator_name, institution),
        "creator_institution": institution,
        "creator_email": metadata.creator_email,
        "creator_url": metadata.creator_url,
        # As in files of EARLINET.
        "PI": metadata.principal_investigator,
        "publisher_name": publisher,
        "publisher_type": _kind_of(publisher, institution),
        "publisher_institution": institution,
        "publisher_email": metadata.publisher_email or metadata.creator_email,
        "publisher_url": metadata.publisher_url or metadata.creator_url,
        "contributor_name": "The lidarops developers",
        "contributor_role": "processing software",
        "metadata_link": metadata.creator_url,
    }


def _kind_of(name: str, institution: str) -> str:
    if not name:
        return ""
    return "institution" if name == institution else "person"


def _processing(context: Context) -> dict[str, Any]:
    """Return the attributes that lidarops itself reads."""
    provenance = context.provenance
    unused = [
        f"{'dark file ' if role is Role.DARK else ''}{path}: {reason}"
        for path, role, reason in context.unused[:MOST_UNUSED]
    ]
    if len(context.unused) > MOST_UNUSED:
        unused.append(f"{len(context.unused) - MOST_UNUSED} other raw files")
    return {
        "lidarops_campaign": provenance.campaign,
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
            for step in provenance.plan.steps
            if step.settings.get("recorder") and not is_glued(step.channel)
        ),
        "lidarops_polarisation": POLARISATIONS.get(label_of(context.channel)[-1:], ""),
        "lidarops_plan_sha256": provenance.plan.hash,
        "lidarops_code_version": provenance.code_version,
        "lidarops_input_count": np.int32(len(provenance.inputs)),
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

"""The context of a product: everything that its file states besides numbers; and its path."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import cast

from lidarops.campaign.model import Metadata, Station
from lidarops.errors import ProductError
from lidarops.netcdf.provenance import writing_time
from lidarops.records import DetectionMode, Provenance, Stamp, UnusedFile

_SAFE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True, slots=True)
class Context:
    """Kind, channel, station, instrument, campaign, scene and provenance of a product."""

    kind: str
    channel: str
    mode: DetectionMode
    wavelength: float
    """m; NaN where it is not known."""
    station_key: str
    station: Station
    instrument_key: str
    instrument_name: str
    metadata: Metadata
    campaign: str
    title: str
    summary: str
    scene: str
    start: datetime
    """Start of the scene's window, not of its first profile."""
    stop: datetime
    notes: tuple[str, ...]
    """Notes on its raw files."""
    provenance: Provenance
    raw_format: str
    """Raw format of its files, in words."""
    unused: tuple[UnusedFile, ...] = ()
    """Raw files of its scene from which it is not made."""
    stamp: Stamp = field(default_factory=Stamp)
    """Version of its content, and when it is written; now, where it has no time."""

    def __post_init__(self) -> None:
        """Take the time once: several attributes of the file state it."""
        if self.stamp.written is None:
            object.__setattr__(self, "stamp", replace(self.stamp, written=writing_time()))

    @property
    def written(self) -> datetime:
        """When the product is written, UTC."""
        return cast("datetime", self.stamp.written)


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

"""The raw files of a scene: on a local disk, checked against the catalog, and opened."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import xarray as xr

from lidarops.campaign.model import Campaign, InstrumentFacts, channel_facts
from lidarops.errors import LidarOpsError, SceneError, UnavailableError, UnreadableFileError
from lidarops.raw.archive import open_counts
from lidarops.raw.formats import RawFile, parse_raw_header, read_all_counts
from lidarops.raw.header import Stretches
from lidarops.records import UNREADABLE, Granule, InputRecord, Scene, Status
from lidarops.scene.dependence import scene_facts
from lidarops.scene.profiles import BEFORE
from lidarops.scene.retrieval import bins_before
from lidarops.system.stores import RemoteStore

# A file that a scan does not find either counts as lost, like one that cannot be read.
_VANISHED: Final = f"{UNREADABLE}: vanished after it was catalogued (run lidarops catalog again)"


@contextmanager
def local_files(archive: str, scene: Scene) -> Iterator[tuple[Path, Mapping[str, str]]]:
    """Yield the folder under which the scene's granules can be opened, and why some cannot.

    Files of an archive behind an fsspec URL are fetched for the time of the scene.
    """
    if "://" not in archive:
        yield Path(archive), {}
        return
    paths = [granule.path for granule in (*scene.granules, *scene.dark)]
    with _temporary_folder() as folder:
        yield Path(folder), RemoteStore(archive).fetch(paths, Path(folder))


def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    try:
        # What cannot be removed does not make the products wrong.
        return tempfile.TemporaryDirectory(prefix="lidarops-", ignore_cleanup_errors=True)
    except OSError as error:
        raise UnavailableError(
            f"no temporary folder for fetched raw files can be made: {error}",
            remedy="make space, or set TMPDIR to a folder you can write to",
        ) from error


def check_files(
    scene: Scene, root: Path, *, read_all: bool, denied: Mapping[str, str] | None = None
) -> tuple[Scene, tuple[InputRecord, ...], tuple[Granule, ...]]:
    """Check every file against the catalog, and take its digest.

    A file of unchanged size and modification time keeps the digest in the catalog, if there is
    one, and its header is not read again.

    Parameters
    ----------
    scene : Scene
    root : Path
        Folder of the granules.
    read_all : bool
        Whether unchanged files are read too.
    denied : mapping of str to str, optional
        Path of a file that the store did not give -> why.

    Returns
    -------
    scene : Scene
        With usable granules only.
    inputs : tuple of InputRecord
    refused : tuple of Granule
    """
    usable: dict[str, Granule] = {}
    inputs: list[InputRecord] = []
    refused: list[Granule] = []
    for granule in (*scene.granules, *scene.dark):
        sha256 = None
        try:
            status = os.stat(f"{root}/{granule.path}")  # noqa: PTH116 - for each, a Path is slow
            stated = (status.st_size, status.st_mtime_ns) == (granule.size, granule.mtime_ns)
            same = stated and not read_all
            sha256 = granule.sha256 if same else None
            if sha256 is None:
                content = (root / granule.path).read_bytes()
                sha256 = hashlib.sha256(content).hexdigest()
                _check(content, granule, root)
        except FileNotFoundError:
            why = (denied or {}).get(granule.path)
            reason = f"{UNREADABLE}: {why}" if why else _VANISHED
            refused.append(_refused(granule, reason))
        except OSError as error:
            refused.append(_refused(granule, f"{UNREADABLE}: {error.strerror or error}"))
        except LidarOpsError as error:
            passing = isinstance(error, UnreadableFileError | SceneError)
            error.file = None
            refused.append(_refused(granule, str(error), None if passing else sha256))
        else:
            usable[granule.path] = granule if same else replace(granule, header_digest=None)
            inputs.append(InputRecord(granule.path, granule.role, sha256))
    return _without(scene, usable), tuple(inputs), tuple(refused)


def _refused(granule: Granule, reason: str, sha256: str | None = None) -> Granule:
    """Return a granule as refused; with the SHA-256 of its content if this is at fault."""
    return replace(granule, status=Status.REFUSED, reason=reason, sha256=sha256)


def _check(content: bytes, granule: Granule, root: Path) -> None:
    """Raise an error if size, header or counts cannot be used, also those that no step reads."""
    if len(content) != granule.size:
        raise SceneError(
            f"{UNREADABLE}: holds {len(content)} bytes, {granule.size} according to the catalog",
            remedy="run lidarops catalog again",
        )
    header = parse_raw_header(content, file=granule.path, size=granule.size, known=granule.format)
    with RawFile(root / granule.path) as file:
        read_all_counts(file, header)


def _without(scene: Scene, usable: Mapping[str, Granule]) -> Scene:
    """Return a scene with its usable granules only."""
    return replace(
        scene,
        granules=tuple(usable[g.path] for g in scene.granules if g.path in usable),
        dark=tuple(usable[g.path] for g in scene.dark if g.path in usable),
        members=tuple(_without(member, usable) for member in scene.members),
    )


def open_granules(
    campaign: Campaign,
    scene: Scene,
    granules: Sequence[Granule],
    root: Path,
    channels: list[str],
    *,
    stretches: Mapping[str, Stretches] | None = None,
    before: bool = False,
) -> xr.Dataset:
    """Return the raw counts of some granules of a scene, lazy, with the pointing of the campaign.

    Parameters
    ----------
    campaign : Campaign
    scene : Scene
        Of the granules.
    granules : sequence of Granule
    root : Path
        Folder of the granules.
    channels, stretches
        As for `lidarops.raw.archive.open_archive`.
    before : bool
        Whether to add the bins before the pulse, as channels whose names begin with ``before_``.

    Raises
    ------
    RawFormatError
        If a file cannot be read.
    """
    archive = open_counts(granules, root=root, channels=channels, stretches=stretches)
    # Facts of the campaign override the pointing in the headers.
    facts = scene_facts(campaign, scene)
    if before and facts.pre_trigger:
        archive = archive.assign(_before_pulse(granules, root, channels, facts))
    fixed = {"zenith_angle": facts.zenith_angle, "azimuth": facts.azimuth}
    pointing = {
        name: xr.full_like(archive["zenith_angle"], angle)
        for name, angle in fixed.items()
        if angle is not None
    }
    return archive.assign_coords(pointing) if pointing else archive


def _before_pulse(
    granules: Sequence[Granule], root: Path, channels: Collection[str], facts: InstrumentFacts
) -> Mapping[str, xr.DataArray]:
    """Return the bins before the pulse of channels that have enough of them."""
    bins = {
        channel.name: bins_before(channel, channel_facts(facts, channel.name))
        for channel in granules[0].layout
        if channel.name in channels
    }
    shown = [name for name, number in bins.items() if number]
    if not shown:
        return {}
    records = (
        replace(
            granule,
            layout=tuple(
                replace(c, bins=bins.get(c.name, c.bins), pre_trigger=0.0) for c in granule.layout
            ),
        )
        for granule in granules
    )
    archive = open_counts(records, root=root, channels=shown)
    own = {dim: f"{BEFORE}{dim}" for dim in map(str, archive.dims) if dim.startswith("range")}
    return {f"{BEFORE}{name}": array for name, array in archive.rename(own).items()}

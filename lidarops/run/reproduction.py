"""Make a product again from its own provenance, and compare the bytes."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import xarray as xr
from pydantic import ValidationError

from lidarops.campaign.model import CATALOG_VARIABLE, Campaign
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, LidarOpsError, ProductError
from lidarops.netcdf.code_version import code_version
from lidarops.netcdf.provenance import (
    EPOCH_VARIABLE,
    package_versions,
    read_provenance,
)
from lidarops.process.job import Job
from lidarops.process.scene import process_scene
from lidarops.raw.file import RawFile
from lidarops.raw.formats import read_raw_header
from lidarops.records import Granule, InputRecord, LeftOut, Plan, PlannedStep, Role, Scene, Status
from lidarops.system.stores import RemoteStore, is_url

_LOG = logging.getLogger(__name__)

_RAW: Final = (Role.SIGNAL, Role.DARK)
"""Roles of files in the archive; paths of other inputs start from the campaign folder."""
_MOST_LISTED: Final = 20
"""Differences of one kind that are listed by name; the others are counted."""
_IF_MOVED: Final = (
    "Moved raw files are found by content in an up-to-date catalog: run lidarops catalog, and give"
    " its URL with --catalog if it is not in a folder above the product."
)


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference between the recorded and the present state."""

    what: str
    """``input``, ``code``, ``package``, ``processing``, ``attribute``, ``variable``, ``bytes``."""
    name: str
    problem: str


@dataclass(frozen=True, slots=True)
class Reproduction:
    """Result of making a product again."""

    product: str
    identical: bool
    """Whether every byte is the same."""
    differences: tuple[Difference, ...]
    """Empty if the bytes are identical."""


@dataclass(frozen=True, slots=True)
class _Origin:
    """The provenance of a product."""

    file: Path
    attributes: Mapping[str, Any]
    """Attributes of the entity ``lidarops:product``."""
    settings: Mapping[str, Any]
    plan: Plan
    inputs: tuple[InputRecord, ...]
    code_version: str
    versions: Mapping[str, str]
    epoch: str
    """SOURCE_DATE_EPOCH by which the product was dated; empty if there was none."""

    @classmethod
    def of(cls, file: Path) -> _Origin:
        document = read_provenance(file)
        try:
            entities = document["entity"]
            attributes = entities["lidarops:product"]
            software = document["agent"]["lidarops:software"]
            origin = cls(
                file=file,
                attributes=attributes,
                settings=json.loads(attributes["lidarops:settings"]),
                plan=_plan(json.loads(entities["lidarops:plan"]["lidarops:json"])),
                inputs=_inputs(entities, document["used"]),
                code_version=software["lidarops:code_version"],
                versions=dict(package.split(" ", 1) for package in software["lidarops:versions"]),
                epoch=_epoch(file),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise _insufficient(file, repr(error)) from error
        for record in origin.inputs:
            # Copies are written under this path, which a forged product could choose freely.
            if record.role in _RAW and not _inside(record.path):
                raise ProductError(
                    f"names a raw file outside its archive: {record.path}",
                    file=file,
                    field="provenance",
                    remedy="lidarops does not write such products: do not trust this one",
                )
        return origin


def _inside(path: str) -> bool:
    """Return whether a path stays in the folder that it is relative to."""
    pure = PurePosixPath(path)
    return not (pure.is_absolute() or ".." in pure.parts)


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


def _epoch(file: Path) -> str:
    with xr.open_dataset(file, decode_cf=False) as product:
        attributes = product.attrs
    if f"that of {EPOCH_VARIABLE}" not in str(attributes["comment"]):
        return ""
    created = datetime.fromisoformat(str(attributes["date_created"]))
    return str(round(created.timestamp()))


def reproduce_product(
    product: str | Path,
    *,
    archive: str | Path | None = None,
    ancillary: str | Path | None = None,
    catalog: str | None = None,
) -> Reproduction:
    """Make a product again in a temporary folder, and compare the two files.

    Station, facts of the instrument, settings, plan and digests of all inputs come from the product
    itself. No campaign file is read. A catalog is read only if raw files are missing or changed,
    to find moved files by content.

    Parameters
    ----------
    product : path or str
        A product of an instrument or of a network.
    archive : path or str, optional
        Folder or URL of the raw files; default the nearest folder above the product that holds
        them, directly or in one of its subfolders.
    ancillary : path or str, optional
        Folder of the campaign file, to which the paths of soundings and overlap functions are
        relative; searched for like the archive by default.
    catalog : str, optional
        SQLAlchemy URL of a catalog that knows where raw files were moved; default that of
        ``LIDAROPS_CATALOG``, or the nearest ``catalog.sqlite`` above the product.

    Returns
    -------
    Reproduction

    Raises
    ------
    ProductError
        If the file is no product, its provenance is insufficient, or its inputs are not found.
    CatalogError
        If the given folder, store or catalog does not exist or cannot be used.
    """
    local = None if is_url(str(archive)) else archive
    for field, folder in (("--archive", local), ("--ancillary", ancillary)):
        if folder is not None and not Path(folder).is_dir():
            raise CatalogError("is no folder", file=folder, field=field, wrong_use=True)
    origin = _Origin.of(Path(product))
    raw = [record for record in origin.inputs if record.role in _RAW]
    others = [record for record in origin.inputs if record.role not in _RAW]
    with _staged(origin, raw, archive, catalog) as (root, wrong):
        ancillaries = _ancillary_folder(origin, others, ancillary) if others else root
        changed = [*wrong, *_changed(ancillaries, others, str(ancillaries))]
        if changed:
            return Reproduction(str(product), identical=False, differences=tuple(changed))
        software = tuple(_software(origin))
        with tempfile.TemporaryDirectory(prefix="lidarops-") as out:
            differences = tuple(_made_again(origin, root, ancillaries, Path(out)))
    # Other software is a difference only if the bytes differ.
    if differences:
        differences = (*differences, *software)
    return Reproduction(str(product), identical=not differences, differences=differences)


@contextmanager
def _staged(
    origin: _Origin, records: Sequence[InputRecord], archive: str | Path | None, catalog: str | None
) -> Iterator[tuple[Path, list[Difference]]]:
    """Yield a local folder with the raw files under their recorded names, and their differences."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as name:
        staged = Path(name)
        unmoved = {record.path: record.path for record in records}
        if is_url(str(archive)):
            store = RemoteStore(str(archive))
            root, place, bring = staged, store.url, _from_store(store, staged)
            bring(unmoved)
        else:
            root = _raw_folder(origin, records, catalog) if archive is None else Path(archive)
            place, bring = str(root), _from_folder(root, staged)
        changed = list(_changed(root, records, place))
        wrong = {difference.name for difference in changed}
        lost = [record for record in records if record.path in wrong]
        moved = _moved(origin, lost, catalog)
        if moved:
            bring({**unmoved, **moved} if root is not staged else moved)
            root = staged
            wrong = {difference.name for difference in _changed(root, lost, place)}
        yield root, [difference for difference in changed if difference.name in wrong]


def _from_store(store: RemoteStore, staged: Path) -> Callable[[Mapping[str, str]], None]:
    """Return a function that copies files, recorded name -> present name, from a store."""

    def bring(names: Mapping[str, str]) -> None:
        with tempfile.TemporaryDirectory(prefix="lidarops-") as fetched:
            store.fetch(sorted(set(names.values())), Path(fetched))
            for old, now in names.items():
                if (Path(fetched) / now).is_file():
                    # Copied, not moved: two recorded names may have the same present name.
                    shutil.copyfile(Path(fetched) / now, _cleared(staged / old))

    return bring


def _from_folder(folder: Path, staged: Path) -> Callable[[Mapping[str, str]], None]:
    """Return a function that links to files, recorded name -> present name, of a folder."""

    def bring(names: Mapping[str, str]) -> None:
        for old, now in names.items():
            if (folder / now).is_file():
                _cleared(staged / old).symlink_to((folder / now).absolute())

    return bring


def _cleared(target: Path) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    return target


def _moved(origin: _Origin, lost: Sequence[InputRecord], catalog: str | None) -> dict[str, str]:
    """Return recorded name -> present name of files that a catalog knows under another name."""
    url = catalog or os.environ.get(CATALOG_VARIABLE) or _nearest_catalog(origin.file)
    if not lost or not url:
        return {}
    try:
        with Store(url, str(origin.attributes["lidarops:campaign"]), create=False) as store:
            present = store.paths_by_digest({record.sha256 for record in lost})
    except CatalogError:
        # A catalog that was not given but only found may be unusable.
        if catalog is not None:
            raise
        return {}
    names = {record.path: present.get(record.sha256, record.path) for record in lost}
    return {old: new for old, new in names.items() if old != new and _inside(new)}


def _nearest_catalog(file: Path) -> str:
    for parent in file.resolve().parents:
        if (parent / "catalog.sqlite").is_file():
            return f"sqlite:///{parent / 'catalog.sqlite'}"
    return ""


def _raw_folder(origin: _Origin, records: Sequence[InputRecord], catalog: str | None) -> Path:
    folder = _folder_with(origin.file, [record.path for record in records])
    if folder is None:
        folder = _folder_with(origin.file, list(_moved(origin, records, catalog).values()))
    if folder is None:
        raise _not_found(origin, records, "--archive")
    return folder


def _ancillary_folder(
    origin: _Origin, records: Sequence[InputRecord], ancillary: str | Path | None
) -> Path:
    if ancillary is not None:
        return Path(ancillary)
    folder = _folder_with(origin.file, [record.path for record in records])
    if folder is None:
        raise _not_found(origin, records, "--ancillary")
    return folder


def _folder_with(file: Path, paths: Sequence[str]) -> Path | None:
    """Return the nearest folder above a file, or subfolder of one, that holds any of the paths."""
    for parent in file.resolve().parents:
        for folder in (parent, *_folders_in(parent)):
            if any((folder / path).is_file() for path in paths):
                return folder
    return None


def _not_found(origin: _Origin, records: Sequence[InputRecord], option: str) -> ProductError:
    return ProductError(
        f"was made from {records[0].path}, which is in no folder above the product",
        file=origin.file,
        remedy=f"give its folder with {option}",
    )


def _folders_in(parent: Path) -> list[Path]:
    try:
        return sorted(path for path in parent.iterdir() if path.is_dir())
    except OSError:
        return []


def _changed(folder: Path, records: Iterable[InputRecord], place: str) -> Iterator[Difference]:
    for record in records:
        try:
            with (folder / record.path).open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            problem = f"missing from {place}: {error.strerror}"
            yield Difference("input", record.path, problem)
        else:
            if digest != record.sha256:
                problem = f"changed: sha256 {digest[:12]}, was {record.sha256[:12]}"
                yield Difference("input", record.path, problem)


def _software(origin: _Origin) -> Iterator[Difference]:
    code = code_version(str(origin.attributes["lidarops:kind"]))
    if origin.code_version != code:
        yield Difference("code", "lidarops", f"{code}, was {origin.code_version}")
    now = package_versions()
    for name in sorted({*origin.versions, *now}):
        if origin.versions.get(name) != now.get(name):
            problem = f"{now.get(name, 'absent')}, was {origin.versions.get(name, 'absent')}"
            yield Difference("package", name, problem)


def _made_again(origin: _Origin, root: Path, folder: Path, out: Path) -> Iterator[Difference]:
    """Yield the differences between a product and the one made from its inputs now."""
    channel, kind = (str(origin.attributes[f"lidarops:{key}"]) for key in ("channel", "kind"))
    with _dated(origin.epoch):
        outcome = process_scene(
            Job(
                _campaign(origin, root, folder, out),
                _scene(origin, root),
                origin.plan,
                only=channel,
            )
        )
    if outcome.internal:
        _LOG.error("scene %s: %s\n%s", outcome.scene, outcome.error, outcome.internal)
    if outcome.error:
        yield Difference("processing", origin.plan.scene, outcome.error)
        return
    record = next((made for made in outcome.products if made.kind == kind), None)
    if record is None:
        yield Difference("processing", origin.plan.scene, f"no longer gives a {kind} product")
        return
    with origin.file.open("rb") as stream:
        before = hashlib.file_digest(stream, "sha256").hexdigest()
    if record.sha256 != before:
        yield from _compared(origin.file, out / "products" / record.path)


@contextmanager
def _dated(epoch: str) -> Iterator[None]:
    """Set SOURCE_DATE_EPOCH to the one by which the product was dated."""
    before = os.environ.pop(EPOCH_VARIABLE, None)
    if epoch:
        os.environ[EPOCH_VARIABLE] = epoch
    try:
        yield
    finally:
        os.environ.pop(EPOCH_VARIABLE, None)
        if before is not None:
            os.environ[EPOCH_VARIABLE] = before


def _campaign(origin: _Origin, root: Path, folder: Path, out: Path) -> Campaign:
    settings = origin.settings
    try:
        campaign = Campaign.model_validate(
            {
                **settings["campaign"],
                "name": origin.attributes["lidarops:campaign"],
                "archive": str(root),
                "output": str(out),
                "metadata": settings["metadata"],
                **_instruments(origin),
            }
        )
    except (KeyError, TypeError, ValidationError) as error:
        raise _insufficient(origin.file, str(error)) from error
    campaign._folder = str(folder)  # noqa: SLF001 - as `lidarops.campaign.model.load_campaign` sets it
    return campaign


def _instruments(origin: _Origin) -> dict[str, Any]:
    """Return the stations, instruments and network that a product records."""
    settings = origin.settings
    if "network" in settings:
        members = settings["members"]
        return {
            "stations": {
                member["keys"]["station"]: member["station"] for member in members.values()
            },
            "instruments": {name: _instrument(member, {}) for name, member in members.items()},
            "networks": {settings["keys"]["instrument"]: settings["network"]},
        }
    kind, keys = str(origin.attributes["lidarops:kind"]), settings["keys"]
    return {
        "stations": {keys["station"]: settings["station"]},
        "instruments": {keys["instrument"]: _instrument(settings, {kind: settings["products"]})},
    }


def _instrument(settings: Mapping[str, Any], products: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "station": settings["keys"]["station"],
        "name": settings["instrument"],
        "files": "*",
        "facts": [settings["facts"]],
        "products": products,
    }


def _scene(origin: _Origin, root: Path) -> Scene:
    settings = origin.settings
    try:
        if "network" not in settings:
            return _member_scene(origin, root, settings["keys"], origin.inputs)
        members = tuple(
            _member_scene(origin, root, member["keys"], _files_of(origin, member["files"]))
            # The members of a product are sorted by name; the network defines their order.
            for name in settings["network"]["instruments"]
            for member in [settings["members"].get(name)]
            if member is not None
        )
        whole = _member_scene(origin, root, settings["keys"], ())
    except (KeyError, TypeError, ValueError) as error:
        raise _insufficient(origin.file, repr(error)) from error
    granules = (granule for member in members for granule in member.granules)
    dark = (granule for member in members for granule in member.dark)
    return replace(
        whole,
        granules=tuple(sorted(granules, key=_order)),
        dark=tuple(sorted(dark, key=_order)),
        members=members,
    )


def _files_of(origin: _Origin, names: Sequence[str]) -> tuple[InputRecord, ...]:
    """Return the raw files of one member of a network."""
    return tuple(record for record in origin.inputs if record.path in set(names))


def _member_scene(
    origin: _Origin, root: Path, keys: Mapping[str, str], inputs: Iterable[InputRecord]
) -> Scene:
    """Return the scene of one instrument with its part of the inputs."""
    start, stop = (datetime.fromisoformat(moment) for moment in origin.settings["window"])
    granules = [
        _granule(root, record, keys["instrument"]) for record in inputs if record.role in _RAW
    ]
    granules.sort(key=_order)
    return Scene(
        id=origin.plan.scene,
        campaign=str(origin.attributes["lidarops:campaign"]),
        station=keys["station"],
        instrument=keys["instrument"],
        start=start,
        stop=stop,
        granules=tuple(granule for granule in granules if granule.role is Role.SIGNAL),
        dark=tuple(granule for granule in granules if granule.role is Role.DARK),
    )


def _order(granule: Granule) -> tuple[bool, datetime | None, str]:
    return granule.start is not None, granule.start, granule.path


def _granule(root: Path, record: InputRecord, instrument: str) -> Granule:
    with RawFile(root / record.path) as file:
        header = read_raw_header(file)
    return Granule(
        path=record.path,
        size=header.size,
        mtime_ns=0,
        instrument=instrument,
        role=record.role,
        status=Status.GOOD,
        start=header.start,
        stop=header.stop,
        layout=header.layout,
        format=header.format,
    )


def _compared(before: Path, after: Path) -> Iterator[Difference]:
    """Yield the differences between two NetCDF files whose bytes differ."""
    count = 0
    try:
        with (
            xr.open_dataset(before, decode_cf=False) as old,
            xr.open_dataset(after, decode_cf=False) as new,
        ):
            for difference in (*_attributes("", old.attrs, new.attrs), *_variables(old, new)):
                count += 1
                yield difference
    except (OSError, ValueError) as error:
        raise LidarOpsError(f"cannot be read: {error}", file=before) from error
    if not count:
        yield Difference("bytes", before.name, "the same content, stored in other bytes")


def _attributes(owner: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[Difference]:
    for name in sorted({*old, *new}):
        if not _same(old.get(name), new.get(name)):
            problem = f"{_short(new.get(name))}, was {_short(old.get(name))}"
            yield Difference("attribute", f"{owner}:{name}", problem)


def _same(old: Any, new: Any) -> bool:
    if old is None or new is None:
        return old is new
    return bool(np.array_equal(old, new))


def _short(value: Any) -> str:
    text = "absent" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _variables(old: xr.Dataset, new: xr.Dataset) -> Iterator[Difference]:
    for name in sorted({str(variable) for variable in (*old.variables, *new.variables)}):
        if name not in old.variables or name not in new.variables:
            state = "is new" if name in new.variables else "no longer exists"
            yield Difference("variable", name, state)
            continue
        before, after = old.variables[name], new.variables[name]
        yield from _attributes(name, before.attrs, after.attrs)
        problem = _values(before.values, after.values)
        if problem:
            yield Difference("variable", name, problem)


def _values(before: np.ndarray[Any, Any], after: np.ndarray[Any, Any]) -> str:
    if before.shape != after.shape or before.dtype != after.dtype:
        return f"has {after.dtype}{after.shape}, had {before.dtype}{before.shape}"
    # As bytes: NaN equals itself, and the sign of zero counts.
    differs = before.view(np.uint8) != after.view(np.uint8) if before.ndim else before != after
    if before.ndim:
        differs = differs.reshape(*before.shape, -1).any(axis=-1)
    count = int(np.count_nonzero(differs))
    if not count:
        return ""
    if before.dtype.kind != "f":
        return f"{count} of {before.size} values differ"
    most = float(np.max(np.abs(np.float64(after) - np.float64(before))[differs]))
    return f"{count} of {before.size} values differ, by {most:.3g} at most"


def explain_difference(result: Reproduction) -> str:
    """Return the result in words, one line per difference."""
    if result.identical:
        return f"{result.product}: identical in every byte"
    lines = [f"{result.product}: not the same"]
    for what in dict.fromkeys(difference.what for difference in result.differences):
        alike = [difference for difference in result.differences if difference.what == what]
        lines += [
            f"  {what} {difference.name}: {difference.problem}"
            for difference in alike[:_MOST_LISTED]
        ]
        if len(alike) > _MOST_LISTED:
            lines.append(f"  ... and {len(alike) - _MOST_LISTED} more of {what}")
    if any(difference.what == "input" for difference in result.differences):
        lines.append(f"  {_IF_MOVED}")
    return "\n".join(lines)

"""Make a product again from nothing but its own provenance, and compare the bytes."""

from __future__ import annotations

import hashlib
import json
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
from lidarops.netcdf.provenance import (
    EPOCH_VARIABLE,
    code_version,
    package_versions,
    read_provenance,
)
from lidarops.process.scene import Job, process_scene
from lidarops.raw import licel
from lidarops.records import Granule, InputRecord, LeftOut, Plan, Role, Scene, Status, Step
from lidarops.system.stores import RemoteStore, is_url

_RAW: Final = (Role.SIGNAL, Role.DARK)
"""Roles of files of the archive; those of the others lie beside the campaign file."""
_SHOWN: Final = 20
"""Files of one kind of trouble that are told by name."""
_IF_MOVED: Final = (
    "Raw files that were moved are found by content in a catalog that has seen them since: run"
    " lidarops catalog, and tell where it is with --catalog if it does not lie above the product."
)


@dataclass(frozen=True, slots=True)
class Difference:
    """One thing that is not what it was when the product was made."""

    what: str
    """``input``, ``code``, ``package``, ``processing``, ``attribute``, ``variable``, ``bytes``."""
    name: str
    problem: str


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What came of making a product again."""

    product: str
    identical: bool
    """Whether every byte is the same."""
    differences: tuple[Difference, ...]
    """Empty where it is identical with the same software."""


@dataclass(frozen=True, slots=True)
class _Told:
    """What a product tells of how it was made."""

    file: Path
    about: Mapping[str, Any]
    """Of the entity ``lidarops:product``."""
    settings: Mapping[str, Any]
    plan: Plan
    inputs: tuple[InputRecord, ...]
    code_version: str
    versions: Mapping[str, str]
    epoch: str
    """Of the environment in which the product was dated; empty where there was none."""

    @classmethod
    def of(cls, file: Path) -> _Told:
        document = read_provenance(file)
        try:
            entities = document["entity"]
            about = entities["lidarops:product"]
            software = document["agent"]["lidarops:software"]
            told = cls(
                file=file,
                about=about,
                settings=json.loads(about["lidarops:settings"]),
                plan=_plan(json.loads(entities["lidarops:plan"]["lidarops:json"])),
                inputs=_inputs(entities, document["used"]),
                code_version=software["lidarops:code_version"],
                versions=dict(each.split(" ", 1) for each in software["lidarops:versions"]),
                epoch=_epoch(file),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise _untold(file, repr(error)) from error
        for record in told.inputs:
            # Copies are put under that name, which whoever made the product may have chosen.
            if record.role in _RAW and not _inside(record.path):
                raise ProductError(
                    f"names a raw file outside its archive: {record.path}",
                    file=file,
                    field="provenance",
                    remedy="lidarops writes no such product: do not trust it",
                )
        return told


def _inside(path: str) -> bool:
    """Return whether a path stays in the folder that it is relative to."""
    pure = PurePosixPath(path)
    return not (pure.is_absolute() or ".." in pure.parts)


def _untold(file: Path, problem: str) -> ProductError:
    return ProductError(
        f"does not tell enough to make the product again: {problem}",
        file=file,
        field="provenance",
        remedy="reprocess the campaign: products of older versions tell less",
    )


def _plan(told: Mapping[str, Any]) -> Plan:
    return Plan(
        told["scene"],
        tuple(Step(**step) for step in told["steps"]),
        tuple(LeftOut(**left) for left in told["left_out"]),
    )


def _inputs(
    entities: Mapping[str, Any], uses: Mapping[str, Mapping[str, Any]]
) -> tuple[InputRecord, ...]:
    """Return the inputs of a document, in which files of equal content are one entity."""
    paths = {
        name: iter([paths] if isinstance(paths, str) else list(paths))
        for name, entity in entities.items()
        for paths in [entity.get("lidarops:path")]
        if paths is not None
    }
    # Numbered in the order in which the writer sorted them, as are the paths of an entity.
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
    made = datetime.fromisoformat(str(attributes["date_created"]))
    return str(round(made.timestamp()))


def reproduce_product(
    product: str | Path,
    *,
    archive: str | Path | None = None,
    ancillary: str | Path | None = None,
    catalog: str | None = None,
) -> Reproduction:
    """Make a product again in a temporary folder and compare it with what it is.

    Station, facts of the instrument, settings, plan and digests of all inputs are those that the
    product itself holds; no campaign file is read, and a catalog only where raw files are not
    what they were under their names: there, files that were moved are found by content.

    Parameters
    ----------
    product : path or str
        Of one instrument or of a network.
    archive : path or str, optional
        Folder or URL of the raw files; without it, the nearest folder above the product that
        holds them, itself or in a folder of its own.
    ancillary : path or str, optional
        Folder of the campaign file, from which soundings and overlap functions are named;
        looked for like the archive where it is not given.
    catalog : str, optional
        SQLAlchemy URL of a catalog that has seen where raw files were moved to; without it that
        of ``LIDAROPS_CATALOG``, or the nearest ``catalog.sqlite`` above the product.

    Returns
    -------
    Reproduction

    Raises
    ------
    ProductError
        If the file is no product, does not tell enough, or its inputs are nowhere to be found.
    CatalogError
        If the folder, store or catalog that is given is not there or cannot be used.
    """
    local = None if is_url(str(archive)) else archive
    for field, given in (("--archive", local), ("--ancillary", ancillary)):
        if given is not None and not Path(given).is_dir():
            raise CatalogError("is no folder", file=given, field=field, wrong_use=True)
    told = _Told.of(Path(product))
    raw = [record for record in told.inputs if record.role in _RAW]
    beside = [record for record in told.inputs if record.role not in _RAW]
    with _staged(told, raw, archive, catalog) as (root, wrong):
        folder = _beside(told, beside, ancillary) if beside else root
        changed = [*wrong, *_changed(folder, beside, str(folder))]
        if changed:
            return Reproduction(str(product), identical=False, differences=tuple(changed))
        software = tuple(_software(told))
        with tempfile.TemporaryDirectory(prefix="lidarops-") as out:
            found = tuple(_made_again(told, root, folder, Path(out)))
    # The same bytes from other software are the same product.
    return Reproduction(
        str(product), identical=not found, differences=(*found, *software) if found else ()
    )


@contextmanager
def _staged(
    told: _Told, records: Sequence[InputRecord], archive: str | Path | None, catalog: str | None
) -> Iterator[tuple[Path, list[Difference]]]:
    """Give a local folder of the raw files under their old names, and what is wrong with them."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as name:
        staged = Path(name)
        there = {record.path: record.path for record in records}
        if is_url(str(archive)):
            store = RemoteStore(str(archive))
            root, place, bring = staged, store.url, _from_store(store, staged)
            bring(there)
        else:
            root = _raw_folder(told, records, catalog) if archive is None else Path(archive)
            place, bring = str(root), _from_folder(root, staged)
        changed = list(_changed(root, records, place))
        wrong = {each.name for each in changed}
        lost = [record for record in records if record.path in wrong]
        moved = _moved(told, lost, catalog)
        if moved:
            bring({**there, **moved} if root is not staged else moved)
            root = staged
            wrong = {each.name for each in _changed(root, lost, place)}
        yield root, [each for each in changed if each.name in wrong]


def _from_store(store: RemoteStore, staged: Path) -> Callable[[Mapping[str, str]], None]:
    """Return what copies files, old name -> name, from behind a URL."""

    def bring(names: Mapping[str, str]) -> None:
        with tempfile.TemporaryDirectory(prefix="lidarops-") as fetched:
            store.fetch(sorted(set(names.values())), Path(fetched))
            for old, now in names.items():
                if (Path(fetched) / now).is_file():
                    # Two names may have become one.
                    shutil.copyfile(Path(fetched) / now, _cleared(staged / old))

    return bring


def _from_folder(folder: Path, staged: Path) -> Callable[[Mapping[str, str]], None]:
    """Return what links to files of a folder, old name -> name."""

    def bring(names: Mapping[str, str]) -> None:
        for old, now in names.items():
            if (folder / now).is_file():
                _cleared(staged / old).symlink_to((folder / now).absolute())

    return bring


def _cleared(target: Path) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    return target


def _moved(told: _Told, lost: Sequence[InputRecord], catalog: str | None) -> dict[str, str]:
    """Return old name -> name of the files whose content a catalog knows under another name."""
    url = catalog or os.environ.get(CATALOG_VARIABLE) or _nearest_catalog(told.file)
    if not lost or not url:
        return {}
    try:
        with Store(url, str(told.about["lidarops:campaign"]), create=False) as store:
            found = store.paths_by_digest({record.sha256 for record in lost})
    except CatalogError:
        # Nobody has asked for one that was only come across.
        if catalog is not None:
            raise
        return {}
    now = {record.path: found.get(record.sha256, record.path) for record in lost}
    return {old: new for old, new in now.items() if old != new and _inside(new)}


def _nearest_catalog(file: Path) -> str:
    for parent in file.resolve().parents:
        if (parent / "catalog.sqlite").is_file():
            return f"sqlite:///{parent / 'catalog.sqlite'}"
    return ""


def _raw_folder(told: _Told, records: Sequence[InputRecord], catalog: str | None) -> Path:
    found = _folder_with(told.file, [record.path for record in records])
    if found is None:
        found = _folder_with(told.file, list(_moved(told, records, catalog).values()))
    if found is None:
        raise _nowhere(told, records, "--archive")
    return found


def _beside(told: _Told, records: Sequence[InputRecord], given: str | Path | None) -> Path:
    if given is not None:
        return Path(given)
    found = _folder_with(told.file, [record.path for record in records])
    if found is None:
        raise _nowhere(told, records, "--ancillary")
    return found


def _folder_with(file: Path, paths: Sequence[str]) -> Path | None:
    """Return the nearest folder above a file, or in one above, that holds one of some paths."""
    for parent in file.resolve().parents:
        for folder in (parent, *_folders_in(parent)):
            if any((folder / path).is_file() for path in paths):
                return folder
    return None


def _nowhere(told: _Told, records: Sequence[InputRecord], option: str) -> ProductError:
    return ProductError(
        f"was made from {records[0].path}, which lies in no folder above the product",
        file=told.file,
        remedy=f"tell where with {option}",
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


def _software(told: _Told) -> Iterator[Difference]:
    if told.code_version != code_version():
        yield Difference("code", "lidarops", f"{code_version()}, was {told.code_version}")
    now = package_versions()
    for name in sorted({*told.versions, *now}):
        if told.versions.get(name) != now.get(name):
            problem = f"{now.get(name, 'absent')}, was {told.versions.get(name, 'absent')}"
            yield Difference("package", name, problem)


def _made_again(told: _Told, root: Path, folder: Path, out: Path) -> Iterator[Difference]:
    """Give what differs between a product and what is made of its inputs now."""
    channel, kind = (str(told.about[f"lidarops:{key}"]) for key in ("channel", "kind"))
    with _dated(told.epoch):
        outcome = process_scene(
            Job(_campaign(told, root, folder, out), _scene(told, root), told.plan, only=channel)
        )
    if outcome.error:
        yield Difference("processing", told.plan.scene, outcome.error)
        return
    record = next((each for each in outcome.products if each.kind.value == kind), None)
    if record is None:
        yield Difference("processing", told.plan.scene, f"makes no {kind} product any more")
        return
    with told.file.open("rb") as stream:
        before = hashlib.file_digest(stream, "sha256").hexdigest()
    if record.sha256 != before:
        yield from _compared(told.file, out / "products" / record.path)


@contextmanager
def _dated(epoch: str) -> Iterator[None]:
    """Set the date of products to that of the environment in which one was made."""
    before = os.environ.pop(EPOCH_VARIABLE, None)
    if epoch:
        os.environ[EPOCH_VARIABLE] = epoch
    try:
        yield
    finally:
        os.environ.pop(EPOCH_VARIABLE, None)
        if before is not None:
            os.environ[EPOCH_VARIABLE] = before


def _campaign(told: _Told, root: Path, folder: Path, out: Path) -> Campaign:
    settings = told.settings
    try:
        campaign = Campaign.model_validate(
            {
                **settings["campaign"],
                "name": told.about["lidarops:campaign"],
                "archive": str(root),
                "output": str(out),
                "metadata": settings["metadata"],
                **_instruments(told),
            }
        )
    except (KeyError, TypeError, ValidationError) as error:
        raise _untold(told.file, str(error)) from error
    campaign._folder = str(folder)  # noqa: SLF001 - as `lidarops.campaign.model.load_campaign` sets it
    return campaign


def _instruments(told: _Told) -> dict[str, Any]:
    """Return stations, instruments and network of a campaign, as far as a product tells them."""
    settings = told.settings
    if "network" in settings:
        members = settings["members"]
        return {
            "stations": {each["keys"]["station"]: each["station"] for each in members.values()},
            "instruments": {name: _instrument(each, {}) for name, each in members.items()},
            "networks": {settings["keys"]["instrument"]: settings["network"]},
        }
    kind, keys = str(told.about["lidarops:kind"]), settings["keys"]
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


def _scene(told: _Told, root: Path) -> Scene:
    settings = told.settings
    try:
        if "network" not in settings:
            return _part(told, root, settings["keys"], told.inputs)
        members = tuple(
            _part(told, root, each["keys"], _files_of(told, each["files"]))
            # Texts are sorted in a product; the network names its instruments in their order.
            for name in settings["network"]["instruments"]
            for each in [settings["members"].get(name)]
            if each is not None
        )
        whole = _part(told, root, settings["keys"], ())
    except (KeyError, TypeError, ValueError) as error:
        raise _untold(told.file, repr(error)) from error
    granules = (granule for member in members for granule in member.granules)
    dark = (granule for member in members for granule in member.dark)
    return replace(
        whole,
        granules=tuple(sorted(granules, key=_order)),
        dark=tuple(sorted(dark, key=_order)),
        members=members,
    )


def _files_of(told: _Told, names: Sequence[str]) -> tuple[InputRecord, ...]:
    """Return the raw files of one member of a network."""
    return tuple(record for record in told.inputs if record.path in set(names))


def _part(told: _Told, root: Path, keys: Mapping[str, str], inputs: Iterable[InputRecord]) -> Scene:
    """Return what one instrument gives to the scene of a product."""
    start, stop = (datetime.fromisoformat(moment) for moment in told.settings["window"])
    granules = [
        _granule(root, record, keys["instrument"]) for record in inputs if record.role in _RAW
    ]
    granules.sort(key=_order)
    return Scene(
        id=told.plan.scene,
        campaign=str(told.about["lidarops:campaign"]),
        station=keys["station"],
        instrument=keys["instrument"],
        start=start,
        stop=stop,
        granules=tuple(each for each in granules if each.role is Role.SIGNAL),
        dark=tuple(each for each in granules if each.role is Role.DARK),
    )


def _order(granule: Granule) -> tuple[bool, datetime | None, str]:
    return granule.start is not None, granule.start, granule.path


def _granule(root: Path, record: InputRecord, instrument: str) -> Granule:
    path = root / record.path
    header = licel.read_header(path)
    return Granule(
        path=record.path,
        size=path.stat().st_size,
        mtime_ns=0,
        instrument=instrument,
        role=record.role,
        status=Status.GOOD,
        start=header.start,
        stop=header.stop,
        layout=licel.layout(header),
    )


def _compared(before: Path, after: Path) -> Iterator[Difference]:
    """Give what differs between two NetCDF files of which some byte does."""
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
        yield Difference("bytes", before.name, "stored otherwise, with the same content")


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
    for name in sorted({str(each) for each in (*old.variables, *new.variables)}):
        if name not in old.variables or name not in new.variables:
            state = "is new" if name in new.variables else "is no more"
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
    other = before.view(np.uint8) != after.view(np.uint8) if before.ndim else before != after
    if before.ndim:
        other = other.reshape(*before.shape, -1).any(axis=-1)
    count = int(np.count_nonzero(other))
    if not count:
        return ""
    if before.dtype.kind != "f":
        return f"{count} of {before.size} values differ"
    most = float(np.max(np.abs(np.float64(after) - np.float64(before))[other]))
    return f"{count} of {before.size} values differ, by {most:.3g} at most"


def explain_difference(result: Reproduction) -> str:
    """Return what came of it in words, one line a difference."""
    if result.identical:
        return f"{result.product}: identical, every byte"
    lines = [f"{result.product}: not the same"]
    for what in dict.fromkeys(each.what for each in result.differences):
        named = [each for each in result.differences if each.what == what]
        lines += [f"  {what} {each.name}: {each.problem}" for each in named[:_SHOWN]]
        if len(named) > _SHOWN:
            lines.append(f"  ... and {len(named) - _SHOWN} more of {what}")
    if any(each.what == "input" for each in result.differences):
        lines.append(f"  {_IF_MOVED}")
    return "\n".join(lines)

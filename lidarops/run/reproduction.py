"""Make a product again from what it says of campaign, plan and inputs, and compare the bytes."""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal, TypeVar

import numpy as np
import xarray as xr
from pydantic import ValidationError

from lidarops.campaign.model import CATALOG_VARIABLE, Campaign
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, ProductError
from lidarops.netcdf.context import package_versions
from lidarops.netcdf.read import open_product, read_origin
from lidarops.netcdf.stored import reading
from lidarops.raw.formats import RawFile, read_raw_header
from lidarops.raw.header import named_layout, recorder_names
from lidarops.records import (
    Granule,
    InputRecord,
    LeftOut,
    Plan,
    PlannedStep,
    Provenance,
    Role,
    Scene,
    Stamp,
    Status,
    UnusedFile,
    after_pulse,
)
from lidarops.scene.dependence import UNUSED
from lidarops.scene.job import Job, Place
from lidarops.scene.processing import process_scene
from lidarops.system.code_version import code_version
from lidarops.system.files import sha256_of
from lidarops.system.stores import RemoteStore, is_url

_T = TypeVar("_T")
_LOG = logging.getLogger(__name__)

_MOST_LISTED: Final = 20
"""Differences of one kind that are listed by name; the others are counted."""
_IF_MOVED: Final = (
    "Moved raw files are found by content in an up-to-date catalog: run lidarops catalog, and give"
    " its URL with --catalog if it is not in a folder above the product."
)


_RAW: Final = (Role.SIGNAL, Role.DARK)
"""Roles of files in the archive; paths of other inputs start from the campaign folder."""


@dataclass(frozen=True, slots=True)
class Recipe(Provenance):
    """What a product was made from, and how, according to itself."""

    file: Path
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
            settings = json.loads(attributes["lidarops:settings"])
            plan = _plan(json.loads(entities["lidarops:plan"]["lidarops:json"]))
            recipe = cls(
                file=file,
                campaign=str(attributes["lidarops:campaign"]),
                scene=plan.scene,
                kind=str(attributes["lidarops:kind"]),
                channel=str(attributes["lidarops:channel"]),
                settings=settings,
                plan=plan,
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
            if not _stays_inside(record.path):
                raise ProductError(
                    f"names an input outside its archive: {record.path}",
                    file=file,
                    field="provenance",
                    remedy="lidarops does not write such products: do not trust this one",
                )
        return recipe

    def as_campaign(self, archive: Path, folder: Path, output: Path) -> Campaign:
        """Return a campaign that gives only this product; its other inputs are in `folder`."""
        settings = self.settings
        try:
            campaign = Campaign.model_validate(
                {
                    **settings["campaign"],
                    "name": self.campaign,
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

    def as_scene(self, archive: Path) -> Scene:
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
        raw = (record for record in inputs if record.role in _RAW)
        read = (_granule(archive, record, keys["instrument"], part["facts"]) for record in raw)
        granules = sorted((_named(g, self.plan, part["facts"]) for g in read), key=_order)
        return Scene(
            id=self.scene,
            campaign=self.campaign,
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


def _stays_inside(path: str) -> bool:
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
        them, directly or in one of its subfolders, or the archive of the last run in the catalog.
    ancillary : path or str, optional
        Folder of the campaign file, to which the paths of soundings and overlap functions are
        relative; searched for like the archive by default.
    catalog : str, optional
        SQLAlchemy URL of a catalog that knows the archive, and where raw files were moved; default
        that of ``LIDAROPS_CATALOG``, or the nearest ``catalog.sqlite`` above the product.

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
    recipe = Recipe.of(Path(product))
    raw = [record for record in recipe.inputs if record.role in _RAW]
    read = [record for record in recipe.inputs if record.role is Role.PRODUCT]
    others = [record for record in recipe.inputs if record not in (*raw, *read)]
    place = archive or (_folder(recipe, raw, "--archive", catalog) if raw else recipe.file.parent)
    # Below it lie station, instrument, kind and year.
    products = recipe.file.resolve().parents[:5][-1]
    with _staged(recipe, raw, str(place), catalog) as (root, wrong):
        ancillaries = root
        if others:
            ancillaries = Path(ancillary or _folder(recipe, others, "--ancillary", catalog))
        place_of_others = f"{ancillaries} (give the folder that holds it with --ancillary)"
        changed = [*wrong, *_changed(ancillaries, others, place_of_others)]
        changed += _changed(products, read, str(products))
        if changed:
            return Reproduction(str(product), identical=False, differences=tuple(changed))
        software = tuple(_software(recipe))
        with tempfile.TemporaryDirectory(prefix="lidarops-") as out:
            for record in read:
                place = Path(out, "products", record.path)
                place.parent.mkdir(parents=True, exist_ok=True)
                place.symlink_to(products / record.path)
            differences = tuple(_made_again(recipe, root, ancillaries, Path(out)))
    # Other software is a difference only if the bytes differ.
    if differences:
        differences = (*differences, *software)
    return Reproduction(str(product), identical=not differences, differences=differences)


@contextmanager
def _staged(
    recipe: Recipe, records: Sequence[InputRecord], archive: str, catalog: str | None
) -> Iterator[tuple[Path, list[Difference]]]:
    """Yield a local folder with the raw files under their recorded names, and their differences."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as name:
        staged, fetched = Path(name, "staged"), Path(name, "fetched")
        staged.mkdir()
        store = RemoteStore(archive) if is_url(archive) else None
        place = archive if store is None else store.url

        def bring(names: Mapping[str, str]) -> None:
            """Link to files of the folder, or fetch those of the store: recorded -> present."""
            if store is not None:
                store.fetch(sorted(set(names.values())), fetched)
            for old, now in names.items():
                file = Path(archive if store is None else fetched, now).absolute()
                if file.is_file():
                    target = staged / old
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.unlink(missing_ok=True)
                    target.symlink_to(file)

        bring({record.path: record.path for record in records})
        wrong = list(_changed(staged, records, place))
        lost = [record for record in records if record.path in {each.name for each in wrong}]
        moved = _moved(recipe, lost, catalog)
        if moved:
            bring(moved)
            still = {each.name for each in _changed(staged, lost, place)}
            wrong = [each for each in wrong if each.name in still]
        yield staged, wrong


def _moved(recipe: Recipe, lost: Sequence[InputRecord], catalog: str | None) -> dict[str, str]:
    """Return recorded name -> present name of files that a catalog knows under another name."""
    digests = {record.sha256 for record in lost}
    present = (
        _answer_of_catalog(recipe, catalog, lambda store: store.paths_by_digest(digests))
        if lost
        else {}
    )
    names = {record.path: (present or {}).get(record.sha256, record.path) for record in lost}
    return {old: new for old, new in names.items() if old != new and _stays_inside(new)}


def _answer_of_catalog(
    recipe: Recipe, catalog: str | None, question: Callable[[Store], _T]
) -> _T | None:
    """Return what the catalog of a product answers; None where no catalog is found."""
    near = (parent / "catalog.sqlite" for parent in recipe.file.resolve().parents)
    found = next((f"sqlite:///{file}" for file in near if file.is_file()), "")
    url = catalog or os.environ.get(CATALOG_VARIABLE) or found
    if not url:
        return None
    try:
        with Store(url, recipe.campaign, create=False) as store:
            return question(store)
    except CatalogError:
        # A catalog that was not given but only found may be unusable.
        if catalog is not None:
            raise
        return None


def _folder(
    recipe: Recipe,
    records: Sequence[InputRecord],
    option: Literal["--archive", "--ancillary"],
    catalog: str | None,
) -> str:
    """Return the nearest folder above the product, or subfolder of one, that holds any input.

    If there is none, the folder or URL of the last run in the catalog, if it may hold an input. A
    folder whose files only bear the names of inputs, with other content, is taken last, and none
    of those that every machine has: a product could name any file of them.
    """
    digests = {record.path: record.sha256 for record in records}
    moved = {name: digests[old] for old, name in _moved(recipe, records, catalog).items()}
    last = _answer_of_catalog(recipe, catalog, lambda store: next(iter(store.runs(limit=1)), None))
    known = "" if last is None else last.archive if option == "--archive" else last.folder
    last_read = [Path(known)] if known and not is_url(known) else []
    local = [*_folders_above(recipe.file), *last_read]
    own = [folder for folder in local if folder.parent != folder.parent.parent] + last_read
    for content, folders in ((True, local), (False, own)):
        for folder in folders:
            if any(_has_any(folder, names, content=content) for names in (digests, moved)):
                return str(folder)
        if is_url(known):
            return known
    elsewhere = f", nor in {known}, which the last run read" if known else ""
    raise ProductError(
        f"was made from {records[0].path}, which is in no folder above the product{elsewhere}",
        file=recipe.file,
        remedy=f"give its folder with {option}",
    )


def _has_any(folder: Path, digests: Mapping[str, str], *, content: bool) -> bool:
    """Return whether there is any named file, on request with the digest of its name."""
    return any(
        (folder / name).is_file() and (not content or sha256_of(folder / name) == digest)
        for name, digest in digests.items()
    )


def _folders_above(file: Path) -> Iterator[Path]:
    """Yield the folders above a file from the nearest on, each with its subfolders."""
    for parent in file.resolve().parents:
        yield parent
        with suppress(OSError):
            yield from sorted(path for path in parent.iterdir() if path.is_dir())


def _changed(folder: Path, records: Iterable[InputRecord], place: str) -> Iterator[Difference]:
    for record in records:
        try:
            digest = sha256_of(folder / record.path)
        except OSError as error:
            problem = f"missing from {place}: {error.strerror}"
            yield Difference("input", record.path, problem)
        else:
            if digest != record.sha256:
                problem = f"changed: sha256 {digest[:12]}, was {record.sha256[:12]}"
                yield Difference("input", record.path, problem)


def _software(recipe: Recipe) -> Iterator[Difference]:
    code = code_version(recipe.kind)
    if recipe.code_version != code:
        yield Difference("code", "lidarops", f"{code}, was {recipe.code_version}")
    now = package_versions()
    for name in sorted({*recipe.versions, *now}):
        if recipe.versions.get(name) != now.get(name):
            problem = f"{now.get(name, 'absent')}, was {recipe.versions.get(name, 'absent')}"
            yield Difference("package", name, problem)


def _made_again(recipe: Recipe, root: Path, folder: Path, out: Path) -> Iterator[Difference]:
    """Yield the differences between a product and the one made from its inputs now."""
    campaign, scene = recipe.as_campaign(root, folder, out), recipe.as_scene(root)
    # Version and time of writing are those of the file, so that every byte can be compared.
    product = recipe.kind, recipe.channel
    places = {product: Place(recipe.stamp)}
    outcome = process_scene(Job(campaign, scene, recipe.plan, products=(product,), places=places))
    if outcome.internal:
        _LOG.error("scene %s: %s\n%s", outcome.scene, outcome.error, outcome.internal)
    record = next((made for made in outcome.products if made.kind == recipe.kind), None)
    if record is None:
        refused = "; ".join(f"{file.path}: {file.reason}" for file in outcome.refused)
        problem = outcome.error or refused or f"no longer gives a {recipe.kind} product"
        yield Difference("processing", recipe.scene, problem)
        return
    if record.sha256 != sha256_of(recipe.file):
        files = (recipe.file, out / "products" / record.path)
        stored = partial(open_product, mask_and_scale=False, decode_times=False)
        same = Difference("bytes", recipe.file.name, "the same content, stored in other bytes")
        with reading(files[1]), stored(files[0]) as recorded, stored(files[1]) as made:
            yield from list(_differences(recorded, made)) or [same]


def _differences(old: xr.Dataset, new: xr.Dataset) -> Iterator[Difference]:
    """Yield how a file differs from what it was; one variable of each is in memory at a time."""
    for name in ["", *sorted(map(str, {*old.variables, *new.variables}))]:
        before, after = (file.variables.get(name) if name else file for file in (old, new))
        if before is None or after is None:
            yield Difference("variable", name, "is new" if before is None else "no longer exists")
            continue
        for key in sorted({*before.attrs, *after.attrs}):
            if words := _words(before.attrs.get(key), after.attrs.get(key)):
                yield Difference("attribute", f"{name}:{key}", words)
        if name and (words := _words(before.values, after.values)):
            yield Difference("variable", name, words)


def _words(before: Any, after: Any) -> str:
    """Return how a value or an array of a file differs from what it was; empty if it does not."""
    both = isinstance(before, np.ndarray) and isinstance(after, np.ndarray)
    if not both or (before.shape, before.dtype) != (after.shape, after.dtype):
        same = not both and np.array_equal(before, after)
        return "" if same else f"{_short(after)}, was {_short(before)}"
    # As bytes: NaN equals itself, and the sign of zero counts.
    differs = before.view(np.uint8) != after.view(np.uint8) if before.ndim else before != after
    if before.ndim:
        differs = differs.reshape(*before.shape, -1).any(axis=-1)
    count = int(np.count_nonzero(differs))
    if not count or before.dtype.kind != "f":
        return f"{count} of {before.size} values differ" if count else ""
    most = float(np.max(np.abs(np.float64(after) - np.float64(before))[differs]))
    return f"{count} of {before.size} values differ, by {most:.3g} at most"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.ndim:
        return f"{value.dtype}{value.shape}"
    text = "absent" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


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

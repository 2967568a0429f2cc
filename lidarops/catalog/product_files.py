"""The files of products: kept versions, temporary ones, a check of all, and copies in a store."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from glob import escape
from pathlib import Path
from typing import Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.lock import Lock, process_start
from lidarops.catalog.raw_files import Source
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, ProductError, UnavailableError
from lidarops.records import Role
from lidarops.system.files import MANIFEST, SITE, product_paths, sha256_of
from lidarops.system.stores import Published, RemoteStore

FOLDER: Final = "superseded"
"""Folder of kept versions, below the output folder."""
LONGEST_WRITE: Final = 3600.0
"""s for which a temporary file of a report is left alone, because reports are built outside the
lock. What it holds is in memory before it is made: its writer only writes and syncs it."""
_WRITER: Final = re.compile(r"\.(\d+)-[0-9a-f]+\.tmp$")
"""The number of the process that writes a temporary file, in its name."""
_LOADED: Final = time.time()
_UNLISTED: Final = (
    "is not in the ledger: a run makes it again if it is requested; else move it away"
)
LEFT_OVER: Final = "left by a killed process; the next run removes it"
_PUBLISHED: Final = ".."
"""Where the products are in a store, relative to the site."""
_ADDRESSES: Final = ("https://", "http://")

_LOG = logging.getLogger(__name__)
_NO_LINKS: Final = frozenset({errno.EPERM, errno.ENOTSUP, errno.EXDEV, errno.EMLINK, errno.ENOSYS})


def _kept(output: Path, product: str, sha256: str) -> Path:
    """Return the file that keeps a version of a product."""
    path = output / FOLDER / product
    return path.with_suffix(f".{sha256[:12]}{path.suffix}")


def keep(output: Path, product: str, sha256: str) -> None:
    """Keep the present file of a product under a name of its own, if it has the digest given.

    Parameters
    ----------
    output : Path
        The output folder.
    product : str
        Path below the folder of products.
    sha256 : str
        Digest of its content in the ledger, which becomes part of the name.

    Raises
    ------
    CatalogError
        If the version cannot be kept.
    """
    source, target = output / "products" / product, _kept(output, product, sha256)
    try:
        # A run that was killed has kept the version, and replaced the file but not entered it.
        if not source.exists() or sha256_of(source) != sha256:
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        # New products replace old ones by renaming, so a hard link keeps the old file.
        target.unlink(missing_ok=True)
        _link(source, target)
    except OSError as error:
        raise UnavailableError(
            f"the replaced version cannot be kept: {error.strerror or error}",
            file=target,
            remedy="make space, or set superseded: remove in the campaign file",
        ) from error


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        temporary = target.with_name(f".{target.name}.{os.getpid()}-0.tmp")
        shutil.copy2(source, temporary)
        temporary.replace(target)


def drop(output: Path, product: str, sha256: str) -> None:
    """Remove a kept version that was not replaced after all."""
    with suppress(OSError):
        _kept(output, product, sha256).unlink(missing_ok=True)


def remove_kept(output: Path, after: timedelta) -> None:
    """Remove the kept versions that were replaced longer ago than `after`."""
    for path in (output / FOLDER).rglob("*.nc"):
        with suppress(OSError):
            # The status of the file changed when its other name was given to the new version.
            if time.time() - path.stat().st_ctime > after.total_seconds():
                path.unlink()


def last_kept(product: Path) -> Path:
    """Return the file of the version of a product that was replaced last.

    Raises
    ------
    ProductError
        If none is kept.
    """
    path = product.resolve()
    root = next((folder for folder in path.parents if folder.name == "products"), path.parent)
    folder = root.parent / FOLDER / path.parent.relative_to(root)
    kept = folder.glob(f"{escape(path.stem)}.{'[0-9a-f]' * 12}.nc")
    found = max(kept, key=lambda file: file.stat().st_ctime_ns, default=None)
    if found is None:
        raise ProductError(
            "was not replaced, or the version before is not kept",
            file=product,
            remedy="name two files, or set superseded in the campaign file before a rerun",
            wrong_use=True,
        )
    return found


def sweep(output: Path, store: Store) -> bool:
    """Remove what killed processes left: temporary files, and kept versions that are present.

    Parameters
    ----------
    output : Path
        The output folder.
    store : Store
        Whose lock this run holds.

    Returns
    -------
    bool
        Whether all could be found and removed; if not, a later run has to try again.
    """
    failures: list[OSError] = []
    paths = list(temporary_files(output, failures))
    # Once the files are listed: those of a run that begins later are not among them.
    if Lock(store).is_taken(by_others=True):
        return False
    for path in paths:
        try:
            path.unlink(missing_ok=True)
            _LOG.warning("removed %s, left by a killed process", path)
        except OSError as error:
            failures.append(error)
    for kept in (output / FOLDER).rglob("*.nc"):
        present = kept.relative_to(output / FOLDER).with_suffix("").with_suffix(".nc")
        with suppress(FileNotFoundError):
            # The killed process has not replaced it.
            if kept.samefile(output / "products" / present):
                kept.unlink()
    return not failures


def is_littered(output: Path, store: Store) -> bool:
    """Return whether there are temporary files that no run writes and this one may remove."""
    files = temporary_files(output)
    return not _is_written(store) and any(os.access(file.parent, os.W_OK) for file in files)


def temporary_files(output: Path, failures: list[OSError] | None = None) -> Iterator[Path]:
    """Yield the hidden temporary files among products and reports that no process here writes.

    Processes of other machines may write them, if a run is at work. Folders that exist and cannot
    be read are appended to the failures.
    """
    unread: list[OSError] = [] if failures is None else failures
    for kept in ("products", FOLDER, "report"):
        for folder, _, names in os.walk(output / kept, onerror=unread.append):
            for name in names:
                path = Path(folder, name)
                hidden = name.startswith(".") and name.endswith(".tmp")
                old = hidden and (kept != "report" or _age(path) > LONGEST_WRITE)
                if old and not _has_writer(path):
                    yield path
    unread[:] = [error for error in unread if not isinstance(error, FileNotFoundError)]


def _has_writer(path: Path) -> bool:
    """Return whether the process that a name states runs on this machine."""
    writer = _WRITER.search(path.name)
    if writer is None:
        return False
    if int(writer[1]) == os.getpid():
        # In containers, another process had the same number before.
        return _age(path) <= time.time() - _LOADED
    return bool(process_start(int(writer[1])))


def _age(path: Path) -> float:
    """Return the time since a file was last written, s; 0 where it is gone."""
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return 0.0


@dataclass(frozen=True, slots=True)
class CheckedFile:
    """A file that was read and compared with the ledger."""

    what: str
    """``product``, ``superseded``, ``unlisted``, ``temporary`` or the role of an input."""
    path: str
    problem: str
    """Empty if it is as recorded."""


def verify_archive(
    campaign: Campaign, store: Store, *, inputs: bool = True
) -> Iterator[CheckedFile]:
    """Read every product and input, and yield them, with the problem of those that differ.

    Product files that the ledger does not know are yielded too, unless a run is active, which may
    yet enter them.

    Parameters
    ----------
    campaign : Campaign
    store : Store
    inputs : bool
        Whether to read also the inputs: raw, dark, molecular and overlap files.
    """
    output, products = Path(campaign.output), campaign.products_root
    temporary = [path.relative_to(output).as_posix() for path in temporary_files(output)]
    if not _is_written(store):
        for path in temporary:
            yield CheckedFile("temporary", path, LEFT_OVER)
    # Listed first: what a run writes from now on may be in the ledger only later.
    unlisted = set(product_paths(products))
    with store.all_products() as rows:
        for made in rows:
            unlisted.discard(made.path)
            problem = _problem(_digests_below(products), made.path, made.sha256)
            yield CheckedFile("product", made.path, problem)
    if unlisted and not _is_written(store):
        for path in sorted(unlisted - store.made_by_any_campaign(unlisted)):
            yield CheckedFile("unlisted", path, _UNLISTED)
    for kept in sorted((output / FOLDER).rglob("*")):
        if kept.is_file() and not kept.name.startswith("."):
            path, sha256 = kept.relative_to(output).as_posix(), kept.stem.rpartition(".")[2]
            yield CheckedFile("superseded", path, _problem(_digests_below(output), path, sha256))
    if inputs:
        yield from _check_inputs(campaign, store)


def _is_written(store: Store) -> bool:
    """Return whether a run may write products: campaigns of a catalog may share a folder."""
    lock = Lock(store)
    return lock.is_taken() or lock.is_taken(by_others=True)


def _check_inputs(campaign: Campaign, store: Store) -> Iterator[CheckedFile]:
    raw, ancillary = Source.of(campaign.archive).digest, _digests_below(campaign.folder)
    products = _digests_below(campaign.products_root)
    by_role = {Role.SIGNAL: raw, Role.DARK: raw, Role.PRODUCT: products}
    suspects: list[tuple[CheckedFile, str]] = []
    with store.all_inputs() as rows:
        for role, path, sha256 in rows:
            read = by_role.get(Role(role), ancillary)
            checked = CheckedFile(role, path, _problem(read, path, sha256))
            if checked.problem:
                suspects.append((checked, sha256))
            else:
                yield checked
    moved_paths = store.paths_by_digest({sha256 for _, sha256 in suspects})
    for checked, sha256 in suspects:
        # A moved file is accepted if its content is unchanged.
        moved = moved_paths.get(sha256, checked.path)
        accepted = moved != checked.path and not _problem(raw, moved, sha256)
        yield replace(checked, problem="") if accepted else checked


def _digests_below(folder: Path) -> Callable[[str], str]:
    return lambda name: sha256_of(folder / name)


def _problem(read: Callable[[str], str], name: str, sha256: str) -> str:
    """Return what is wrong with a file whose SHA-256 begins in some way; empty if nothing is."""
    try:
        digest = read(name)
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    if digest.startswith(sha256):
        return ""
    return f"holds other bytes: sha256 {digest[:12]}, not {sha256[:12]}"


def publish_products(campaign: Campaign, url: str) -> Published:
    """Copy the products in the ledger of a campaign to a store, as far as they changed.

    Parameters
    ----------
    campaign : Campaign
    url : str
        Destination, such as ``s3://bucket/prefix``; the driver finds the credentials.

    Raises
    ------
    CatalogError
        If there is no ledger or it cannot be read, or the URL is unknown.
    ProductError
        If the store cannot be written, or a product is missing or differs from the ledger.
    """
    with (
        Store(campaign.catalog_url, campaign.name, create=False) as store,
        store.all_products() as made,
    ):
        products = {product.path: product.sha256 for product in made}
    journal = _journal(campaign, url)
    return RemoteStore(url).publish(campaign.products_root, products, journal, beside=SITE)


def publish_site(campaign: Campaign, url: str) -> Published:
    """Copy the site of a campaign to the folder ``site`` of a store, as far as it changed.

    Parameters
    ----------
    campaign : Campaign
    url : str
        Destination of the products; the site goes beside them.

    Raises
    ------
    CatalogError
        If there is no site, or its downloads would not lead to published products.
    ProductError
        If the store cannot be written.
    """
    site = Path(campaign.output) / SITE
    _check_links(site)
    files = {
        path.relative_to(site).as_posix(): sha256_of(path)
        for path in sorted(site.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }
    place = f"{url.rstrip('/')}/{SITE}"
    return RemoteStore(place).publish(site, files, _journal(campaign, place))


def _check_links(site: Path) -> None:
    """Refuse a site whose downloads lead to the disk that it was made on."""
    manifest = site / MANIFEST
    try:
        place = str(json.loads(manifest.read_bytes())["products_at"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CatalogError(
            "there is no complete site", file=manifest, remedy="run lidarops site OUT first"
        ) from error
    if place.rstrip("/") != _PUBLISHED and not place.startswith(_ADDRESSES):
        raise CatalogError(
            f"downloads lead to {place}, but published products are beside the site",
            file=manifest,
            field="products_at",
            remedy=f"run lidarops site OUT --products-at {_PUBLISHED}",
        )


def _journal(campaign: Campaign, url: str) -> Path:
    """Return the journal of what was sent to a store."""
    name = hashlib.sha256(url.encode()).hexdigest()[:12]
    return Path(campaign.output) / f"published-{name}.sha256"

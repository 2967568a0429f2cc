"""Compare products and inputs with the digests that the ledger recorded, and find others."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from lidarops.campaign.model import Campaign
from lidarops.catalog import versions
from lidarops.catalog.sources import Source
from lidarops.catalog.store import Store
from lidarops.records import Role
from lidarops.system.files import product_paths, sha256_of

_UNLISTED: Final = (
    "is not in the ledger: a run makes it again if it is requested; else move it away"
)
LEFT_OVER: Final = "left by a killed process; the next run removes it"


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
    temporary = [path.relative_to(output).as_posix() for path in versions.temporary_files(output)]
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
    for old in store.superseded():
        if old.kept:
            problem = _problem(_digests_below(output), old.kept, old.sha256)
            yield CheckedFile("superseded", old.kept, problem)
    if inputs:
        yield from _check_inputs(campaign, store)


def _is_written(store: Store) -> bool:
    """Return whether a run may write products: campaigns of a catalog may share a folder."""
    return store.in_use() or store.others_at_work()


def _check_inputs(campaign: Campaign, store: Store) -> Iterator[CheckedFile]:
    raw, ancillary = Source.of(campaign.archive).digest, _digests_below(campaign.folder)
    suspects: list[tuple[CheckedFile, str]] = []
    with store.all_inputs() as rows:
        for role, path, sha256 in rows:
            read = raw if role in (Role.SIGNAL, Role.DARK) else ancillary
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
    try:
        digest = read(name)
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    return "" if digest == sha256 else f"holds other bytes: sha256 {digest[:12]}, not {sha256[:12]}"

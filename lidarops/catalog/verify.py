"""Compare products and inputs with the digests that the ledger recorded."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lidarops.campaign.model import Campaign
from lidarops.catalog.sources import Source
from lidarops.catalog.store import Store
from lidarops.records import Role


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A file that differs from the ledger."""

    what: str
    """``product``, ``superseded`` or the role of an input."""
    path: str
    problem: str


def verify_archive(
    campaign: Campaign,
    store: Store,
    *,
    inputs: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Mismatch]:
    """Read every product and input, and yield those whose content differs from the ledger.

    Parameters
    ----------
    campaign : Campaign
    store : Store
    inputs : bool
        Whether to read also the inputs: raw, dark, molecular and overlap files.
    progress : callable, optional
        Called with the number of files done since the last call.

    Yields
    ------
    Mismatch
    """
    for mismatch in _check_all(campaign, store, inputs=inputs):
        if progress:
            progress(1)
        if mismatch is not None:
            yield mismatch


def _check_all(campaign: Campaign, store: Store, *, inputs: bool) -> Iterator[Mismatch | None]:
    read = _digests_below(campaign.products_root)
    with store.all_products() as rows:
        for made in rows:
            problem = _problem(read, made.path, made.sha256)
            yield Mismatch("product", made.path, problem) if problem else None
    read = _digests_below(Path(campaign.output))
    for old in store.superseded():
        if old.kept:
            problem = _problem(read, old.kept, old.sha256)
            yield Mismatch("superseded", old.kept, problem) if problem else None
    if inputs:
        yield from _check_inputs(campaign, store)


def _check_inputs(campaign: Campaign, store: Store) -> Iterator[Mismatch | None]:
    raw, ancillary = Source.of(campaign.archive).digest, _digests_below(campaign.folder)
    suspects: list[tuple[Mismatch, str]] = []
    with store.all_inputs() as rows:
        for role, path, sha256 in rows:
            read = raw if role in (Role.SIGNAL, Role.DARK) else ancillary
            problem = _problem(read, path, sha256)
            if problem:
                suspects.append((Mismatch(role, path, problem), sha256))
            else:
                yield None
    moved_paths = store.paths_by_digest({sha256 for _, sha256 in suspects})
    for mismatch, sha256 in suspects:
        # A moved file is accepted if its content is unchanged.
        moved = moved_paths.get(sha256, mismatch.path)
        yield mismatch if moved == mismatch.path or _problem(raw, moved, sha256) else None


def _digests_below(folder: Path) -> Callable[[str], str]:
    def read(name: str) -> str:
        with (folder / name).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    return read


def _problem(read: Callable[[str], str], name: str, sha256: str) -> str:
    try:
        digest = read(name)
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    return "" if digest == sha256 else f"holds other bytes: sha256 {digest[:12]}, not {sha256[:12]}"

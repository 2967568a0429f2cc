"""Raw files that products were made from, and that the archive no longer gives.

A product is neither removed nor replaced by one of fewer files where more than a few files are
lost, of it or of all products with lost files, or all its dark files: the listing may be
incomplete, or a disk not mounted.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.sources import path_pattern
from lidarops.catalog.store import Store
from lidarops.records import FactsNote, LostFiles, Role

_NAMES_SHOWN: Final = 3
_IDLE: Final = "matches no raw file that has vanished: take the entry out, or correct it"
_OVER: Final = "has expired: its files count as lost again; take the entry out, or set until later"


@dataclass(frozen=True, slots=True)
class Lost:
    """The lost raw files of a campaign."""

    findings: tuple[LostFiles, ...] = ()
    """What a report says of those that the campaign does not acknowledge, by instrument."""
    protected: frozenset[str] = frozenset()
    """Products that are neither replaced nor removed."""
    excused: frozenset[str] = frozenset()
    """Products of which the campaign acknowledges lost files."""
    idle: tuple[FactsNote, ...] = ()
    """Entries of `acknowledged` that match no lost file, or have expired."""


def find_lost(campaign: Campaign, store: Store) -> Lost:
    """Return the raw files that products were made from and the archive does not give.

    Files whose content is found under another path, and those that no instrument of the campaign
    claims any more, are not lost.
    """
    claims = {
        name: _matcher((*instrument.files, *instrument.dark_files))
        for name, instrument in campaign.instruments.items()
    }
    inputs = store.lost_inputs()
    owners = {path: name for _, path in inputs for name, has in claims.items() if has(path)}
    known: set[str] = set()
    idle = []
    for entry in campaign.acknowledged:
        matched = set(filter(_matcher(entry.what), owners)) if entry.holds else set()
        known |= matched
        if not matched:
            reason = _IDLE if entry.holds else _OVER
            idle.append(FactsNote("all", f"acknowledged: {', '.join(entry.what)}", reason))
    if not owners:
        return Lost(idle=tuple(idle))
    sets = store.raw_sets()
    size, lost, gone = Counter[str](), Counter[str](), Counter[str]()
    excused, products_of = set[str](), defaultdict[str, set[str]](set)
    for raw in sets.values():
        size.update(dict.fromkeys(raw.products, raw.files))
    for name, path in inputs:
        products = sets[name].products
        gone[name] += path in owners
        if path in known:
            excused.update(products)
        elif path in owners:
            lost.update(products)
            products_of[owners[path]].update(products)
    unknown = sorted(owners.keys() - known)
    concerned = {name for name, raw in sets.items() if not lost.keys().isdisjoint(raw.products)}
    total = store.count_raw(concerned, known) if concerned else 0

    def too_many(files: int, of: int) -> bool:
        return files > 1 and files > campaign.vanished_share * of

    many = too_many(len(unknown), total)
    without_dark = {
        product
        for name, files in gone.items()
        if sets[name].role is Role.DARK and files == sets[name].files
        for product in sets[name].products
        if campaign.vanished_share < 1
    }
    protected = frozenset(
        product
        for product, files in lost.items()
        if many or product in without_dark or too_many(files, size[product])
    )
    findings = []
    for owner, products_with in sorted(products_of.items()):
        paths = tuple(path for path in unknown if owners[path] == owner)
        kept = len(products_with & protected)
        findings.append(LostFiles(owner, len(paths), total, paths[:_NAMES_SHOWN], kept))
    return Lost(tuple(findings), protected, frozenset(excused), tuple(idle))


def _matcher(patterns: Iterable[str]) -> Callable[[str], bool]:
    """Return a function that tells whether a path matches one of some patterns."""
    expressions = [path_pattern(pattern) for pattern in patterns]
    return lambda path: any(expression.match(path) for expression in expressions)

"""Makes the aggregates of an output: index, means, stores, STAC catalog."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from lidarops.aggregate.facts import (
    EVERYTHING,
    FOLDER,
    Facts,
    Period,
    ProductSelection,
    Refused,
    Weights,
    grid_notes,
    groups,
    list_products,
    read_product_facts,
)
from lidarops.aggregate.index import INDEX, KnownFacts, write_index
from lidarops.errors import ProductError
from lidarops.system.files import settled_before

if TYPE_CHECKING:
    from lidarops.aggregate.means import Means, MeansFile
    from lidarops.aggregate.versioned_store import StoreUpdate

Progress = Callable[[int], None]


@dataclass(slots=True)
class AggregateResult:
    """Aggregates that were made, and what failed and why."""

    root: Path
    products: int = 0
    index: str | None = None
    stac: str | None = None
    means: list[MeansFile] = field(default_factory=list)
    stores: list[StoreUpdate] = field(default_factory=list)
    refused: list[Refused] = field(default_factory=list)
    """Products that could not be read."""
    failed: list[str] = field(default_factory=list)
    """Aggregates that could not be made, one sentence each."""
    notes: list[str] = field(default_factory=list)
    """Notes, one sentence each."""


def make_aggregates(
    root: Path,
    selection: ProductSelection = EVERYTHING,
    *,
    period: Period | None = None,
    weights: Weights = Weights.SHOTS,
    stac: bool = False,
    products_at: str = "",
    store: bool = False,
    runs: Mapping[str, str] = MappingProxyType({}),
    progress: Progress = lambda _done: None,
) -> AggregateResult:
    """Make the aggregates of an output; a failure is reported and the others are made.

    Parameters
    ----------
    root : path
        Output of a campaign, or a folder of products; aggregates go to its ``aggregates``, stores
        to its ``stores``.
    selection : ProductSelection
    period : Period or None
        Of means; None for no means.
    weights : Weights
    stac, store : bool
        Whether to make a STAC catalog, and to update the stores.
    products_at : str
        Address to which the STAC catalog links products; empty: in the output.
    runs : mapping of str to str
        Product path -> run that made it, for the snapshots of stores.
    progress : callable
        Called with 1 for each product that was examined.

    Returns
    -------
    AggregateResult
        Index and STAC catalog are made only without a selection, because they list all products.

    Raises
    ------
    ProductError
        If the folder is missing, or contains no selected product.
    LidarOpsError
        If a package is missing.
    OSError
        If a file cannot be written.
    """
    made, as_of = AggregateResult(root), settled_before()
    known = KnownFacts(root, hashed=stac or period is not None)
    products = _products(root, selection, made, known, progress)
    if not products:
        _refuse_unknown(root, selection)
        absent, remedy = not list_products(root), _remedy(made)
        raise ProductError("no product found", file=root, remedy=remedy, wrong_use=absent)
    made.products = len(products)
    by_group = groups(products)
    made.notes += grid_notes(by_group)
    if selection == EVERYTHING:
        kept = known.are(products)
        made.index = f"{FOLDER}/{INDEX}" if kept else write_index(root, products, as_of)
    else:
        made.notes.append("the index lists all products; run without a selection to update it")
    means: Means | None = None
    if period is not None:
        from lidarops.aggregate.means import Means  # noqa: PLC0415 - the index is without xarray

        means = Means(root, by_group, period, weights)
    if store:
        with _failures(made):
            _update_stores(made, products, selection, runs, means)
    if means is not None:
        _make_means(made, means)
    if stac:
        from lidarops.aggregate.stac import write_stac  # noqa: PLC0415

        with _failures(made):
            if selection != EVERYTHING:
                remedy = "run without a selection"
                raise ProductError("the STAC catalog lists all products", remedy=remedy)
            made.stac = write_stac(root, products, products_at)
    return made


def _make_means(made: AggregateResult, means: Means) -> None:
    for group in means.groups:
        with _failures(made):
            done = means.of(group)
            made.means += done.files
            made.refused += done.refused
            made.notes += [done.note] if done.note else []


def _products(
    root: Path,
    selection: ProductSelection,
    made: AggregateResult,
    known: KnownFacts,
    progress: Progress,
) -> list[Facts]:
    products = []
    for path in list_products(root):
        facts = known.of(path) or read_product_facts(root, path, selection)
        if isinstance(facts, Refused):
            made.refused.append(facts)
        elif facts and selection.admits(facts.names, facts.start, facts.stop):
            products.append(facts)
        progress(1)
    return products


def _refuse_unknown(root: Path, selection: ProductSelection) -> None:
    """Refuse a selected channel, station or instrument that no product has."""
    unread = AggregateResult(root)
    products = _products(root, EVERYTHING, unread, KnownFacts(root), lambda _done: None)
    for name in ("channel", "station", "instrument"):
        selected = getattr(selection, name)
        known = sorted({getattr(product, name) for product in products})
        if known and selected is not None and selected not in known:
            raise ProductError(
                f"no product has the {name} {selected!r}",
                file=root,
                field=name,
                remedy=f"known: {', '.join(known)}",
                wrong_use=True,
            )


def _remedy(made: AggregateResult) -> str:
    if made.refused:
        first = made.refused[0]
        return (
            f"{len(made.refused)} files cannot be read; the first is {first.path}: {first.reason}"
        )
    return "process scenes first, or select less strictly"


@contextmanager
def _failures(made: AggregateResult) -> Iterator[None]:
    """Report what fails, so that the others are made."""
    try:
        yield
    except ProductError as error:
        made.failed.append(str(error))


def _update_stores(
    made: AggregateResult,
    products: Sequence[Facts],
    selection: ProductSelection,
    runs: Mapping[str, str],
    means: Means | None,
) -> None:
    from lidarops.aggregate.versioned_store import (  # noqa: PLC0415
        stored_kinds,
        update_store,
    )

    if selection.since is not None or selection.until is not None:
        raise ProductError("a store holds all times", remedy="run without --since and --until")
    for kind in sorted({product.kind for product in products} | set(stored_kinds(made.root))):
        if selection.kind not in (None, kind):
            continue
        with _failures(made):
            alike = [product for product in products if product.kind == kind]
            done = update_store(made.root, kind, alike, selection, runs, means)
            made.stores.append(done)
            made.refused += done.refused
            made.failed += done.failed

"""All aggregates of an output that are asked for, made one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from lidarops.aggregate.facts import (
    EVERYTHING,
    Facts,
    ProductSelection,
    Refused,
    groups,
    list_products,
    read_product_facts,
    told_grids,
)
from lidarops.aggregate.index import write_index
from lidarops.aggregate.means import MeansFile, write_means
from lidarops.aggregate.means_variables import Period, Weights
from lidarops.aggregate.stac import write_stac
from lidarops.aggregate.virtual_dataset import View, write_view
from lidarops.errors import ProductError

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is asked for besides the views, which are always made."""

    selection: ProductSelection = EVERYTHING
    period: Period | None = None
    """Of means; None for none."""
    weights: Weights = Weights.PLAIN
    stac: bool = False


@dataclass(slots=True)
class Made:
    """What was made, and what was not and why."""

    root: Path
    products: int = 0
    index: str | None = None
    stac: str | None = None
    views: list[View] = field(default_factory=list)
    means: list[MeansFile] = field(default_factory=list)
    refused: list[Refused] = field(default_factory=list)
    """Products that could not be read."""
    failed: list[str] = field(default_factory=list)
    """What could not be made, one sentence each."""
    told: list[str] = field(default_factory=list)
    """What is to be known, one sentence each."""


def make_aggregates(root: Path, wanted: Wanted, *, progress: Progress = lambda _done: None) -> Made:
    """Make the aggregates of an output; what fails is named, and the rest goes on.

    Parameters
    ----------
    root : path
        Output of a campaign, or a folder of products; aggregates go to its ``aggregates``.
    wanted : Wanted
    progress : callable
        Told 1 for each product that was looked at.

    Returns
    -------
    Made
        The index and the STAC catalog are made of all products only, not of a selection.

    Raises
    ------
    ProductError
        If there is no such folder, or it holds no product that is wanted.
    LidarOpsError
        If a package is missing.
    OSError
        If a file cannot be written.
    """
    made = Made(root)
    products = _products(root, wanted.selection, made, progress)
    if not products:
        _refuse_unknown(root, wanted.selection)
        raise ProductError("no product is found", file=root, remedy=_remedy(made))
    made.products = len(products)
    found = groups(products)
    made.told += told_grids(found)
    if wanted.selection == EVERYTHING:
        made.index = write_index(root, products)
    else:
        made.told.append("the index is of all products: run without a selection to renew it")
    for of_group in found.values():
        _try(made, partial(_view, made, of_group))
        if wanted.period is not None:
            _try(made, partial(_means, made, of_group, wanted.period, wanted.weights))
    if wanted.stac:
        _try(made, partial(_stac, made, products, wanted.selection))
    return made


def _products(root: Path, wanted: ProductSelection, made: Made, progress: Progress) -> list[Facts]:
    products = []
    for path in list_products(root):
        for found in read_product_facts(root, [path], wanted):
            if isinstance(found, Refused):
                made.refused.append(found)
            else:
                products.append(found)
        progress(1)
    return products


def _refuse_unknown(root: Path, wanted: ProductSelection) -> None:
    """Refuse what no product is of, and name what there is."""
    there = _products(root, EVERYTHING, Made(root), lambda _done: None)
    for name in ("channel", "station", "instrument"):
        asked, known = getattr(wanted, name), sorted({getattr(each, name) for each in there})
        if known and asked is not None and asked not in known:
            raise ProductError(
                f"no product is of {name} {asked!r}",
                file=root,
                field=name,
                remedy=f"known: {', '.join(known)}",
                wrong_use=True,
            )


def _remedy(made: Made) -> str:
    if made.refused:
        first = made.refused[0]
        return f"{len(made.refused)} files cannot be read, the first: {first.path}: {first.reason}"
    return "process scenes first, or ask for less"


def _try(made: Made, step: Callable[[], None]) -> None:
    try:
        step()
    except ProductError as error:
        made.failed.append(str(error))


def _view(made: Made, products: Sequence[Facts]) -> None:
    view = write_view(made.root, products)
    made.views.append(view)
    made.refused += view.refused


def _means(made: Made, products: Sequence[Facts], period: Period, weights: Weights) -> None:
    done = write_means(made.root, products, period, weights=weights)
    made.means += done.files
    made.refused += done.refused


def _stac(made: Made, products: Sequence[Facts], selection: ProductSelection) -> None:
    if selection != EVERYTHING:
        raise ProductError("the STAC catalog is of all products", remedy="run without a selection")
    made.stac = write_stac(made.root, products)

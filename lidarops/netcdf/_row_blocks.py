"""Cut the rows of a variable into the blocks that its chunks hold, however many come at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive rows that fill the chunks at one place along the first axis."""

    name: str
    first: int
    """Number of the first row."""
    values: Array

    @property
    def end(self) -> int:
        """Number of the row after the last."""
        return self.first + len(self.values)


class RowBlocks:
    """The rows of one variable.

    Parameters
    ----------
    name : str
    total : int
        Number of rows that will come.
    step : int
        Rows of a block; the last block may have fewer.
    """

    def __init__(self, name: str, total: int, step: int) -> None:
        self._name = name
        self._total = total
        self._step = step
        self._first = 0
        self._held: list[Array] = []

    def take(self, rows: Array) -> Iterator[Block]:
        """Take the next rows, and yield the blocks that are complete with them.

        Parameters
        ----------
        rows : ndarray, shape (n, ...)
            No more than are still to come. A copy is kept of rows whose block is incomplete.
        """
        while len(rows):
            size = min(self._step, self._total - self._first)
            missing = size - sum(map(len, self._held))
            if len(rows) < missing:
                self._held.append(rows.copy())
                return
            pieces = [*self._held, rows[:missing]]
            rows = rows[missing:]
            values = pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
            yield Block(self._name, self._first, values)
            self._held = []
            self._first += size

"""What a file holds besides its rows, which may come later, some at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr


@dataclass(frozen=True, slots=True)
class Skeleton:
    """All of a file except the values of its rows.

    The rows are those along the unlimited dimension, of the variables that have it first.
    """

    variables: Mapping[str, xr.Variable]
    """Encoded, in the order of the file. Of variables with rows, the values are not used."""
    attributes: Mapping[str, Any]
    unlimited: str | None

    def sizes(self) -> dict[str, int]:
        """Return the length of every dimension, in the order of the file."""
        return {
            str(dim): size
            for variable in self.variables.values()
            for dim, size in zip(variable.dims, variable.shape, strict=True)
        }

    def with_rows(self) -> dict[str, xr.Variable]:
        """Return the variables that have rows."""
        return {
            name: variable
            for name, variable in self.variables.items()
            if self.unlimited is not None and variable.dims[:1] == (self.unlimited,)
        }

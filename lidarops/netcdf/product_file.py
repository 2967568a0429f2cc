"""Write a product some profiles at a time, so that memory does not grow with its scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from lidarops.errors import ProductError
from lidarops.flags import FlagBit
from lidarops.kinds import flags_of
from lidarops.netcdf.build import ProductEncoder
from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.context import Context
from lidarops.netcdf.input_checks import Values
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.netcdf.write import RowFile, Written, create_file, written_file
from lidarops.records import Change, Grade
from lidarops.system.files import sha256_of


@dataclass(frozen=True, slots=True)
class WrittenProduct:
    """A product that was written, with counts of its ``quality_flag``."""

    sha256: str
    size: int
    values: int
    flagged: dict[str, int]
    """Number of values with each bit that occurs."""
    unflagged: int
    """Number of values without any bit."""
    usable: int
    """Number of values without a bit of severity reject."""
    change: Change | None
    """How it differs from the product that it replaces; None without one."""


@contextmanager
def create_product(
    frame: xr.Dataset, context: Context, path: Path, former: str = ""
) -> Iterator[ProductWriter]:
    """Yield a writer of a product; at the end the file is complete, on disk and has its name.

    The bytes depend on the data only, not on how many profiles are added at a time. Several threads
    may write products at once.

    Parameters
    ----------
    frame : xr.Dataset
        Coordinates of all profiles, and variables without time; see
        `lidarops.netcdf.build.ProductEncoder`.
    context : Context
        Kind, channel, station, instrument, campaign, scene and provenance of the product.
    path : Path
        Missing folders are created. A former file is replaced at the end, and stays if anything
        fails.
    former : str
        SHA-256 of the former file. If it is so, both are compared, and it stays if it is the same.

    Raises
    ------
    ProductError
        If data do not match the layout, profiles are missing at the end, or the file cannot be
        written. Other errors of the ``with`` block are raised as they are.
    """
    with ExitStack() as until_complete:
        writer = ProductWriter(frame, context, path, until_complete, former)
        yield writer
        if writer.file is None:
            raise ProductError("has no profiles", file=path)


class ProductWriter:
    """A product that is being written; see `create_product`."""

    def __init__(
        self,
        frame: xr.Dataset,
        context: Context,
        path: Path,
        until_complete: ExitStack,
        former: str,
    ) -> None:
        self._encoder = ProductEncoder(frame, context)
        self._path = path
        self._former = former
        self._change: Change | None = None
        self._until_complete = until_complete
        self._values = 0
        self._unflagged = 0
        self._rejected = 0
        self._flags = flags_of(context.kind)
        self._flagged: Counter[FlagBit] = Counter()
        self.file: RowFile | None = None
        """None until the first profiles, which decide on optional variables."""

    def add(self, profiles: xr.Dataset) -> None:
        """Write the next profiles.

        Parameters
        ----------
        profiles : xr.Dataset
            At least one, in memory, with every variable of the layout that has time.

        Raises
        ------
        ProductError
            If they do not match the layout or the profiles before, or cannot be written.
        """
        encoded = self._encoder.encode(profiles)
        if self.file is None:
            skeleton = self._encoder.skeleton(encoded)
            self.file = self._until_complete.enter_context(
                create_file(skeleton, self._path, replaces=self._replaces)
            )
        self.file.add(encoded)
        self._count(encoded[QUALITY_FLAG])

    def _replaces(self, new: Path) -> bool:
        """Return whether the new file differs from the former one."""
        if not (self._former and self._path.is_file() and sha256_of(self._path) == self._former):
            return True
        self._change = compare_products(self._path, new)
        return self._change.grade is not Grade.NONE

    def _count(self, flags: Values) -> None:
        self._values += flags.size
        self._unflagged += flags.size - int(np.count_nonzero(flags))
        self._rejected += int(np.count_nonzero(flags & np.int32(self._flags.rejecting)))
        # Few bits occur in a product: count only these.
        for bit in self._flags.raised(int(np.bitwise_or.reduce(flags, axis=None))):
            self._flagged[bit] += int(np.count_nonzero(flags & np.int32(bit)))

    @property
    def written(self) -> WrittenProduct:
        """The product, after the ``with`` block.

        Raises
        ------
        ProductError
            If it is not written.
        """
        change = self._change
        if change is not None and change.grade is Grade.NONE:
            file = Written(self._former, self._path.stat().st_size)
        else:
            file = written_file(self.file, self._path)
        return WrittenProduct(
            sha256=file.sha256,
            size=file.size,
            values=self._values,
            flagged={str(bit.name): self._flagged[bit] for bit in sorted(self._flagged)},
            unflagged=self._unflagged,
            usable=self._values - self._rejected,
            change=change,
        )

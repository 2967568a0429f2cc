"""Product kind ``visibility``: extinction and visibility where beams of lidars cross."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Final, Self

from pydantic import Field, model_validator

from lidarops.kinds import Kind
from lidarops.retrieve.network.settings import EXPONENTS, NetworkAssumptions
from lidarops.settings import (
    BackgroundRange,
    NetworkProduct,
    PartOfDay,
    VisibilitySettings,
    located_error,
    nearest,
    quantity,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders

NAME: Final = "visibility"
_MOST_AVERAGES: Final = 500
"""Averages of a block, whose memory and time grow with the square and the cube of their number."""


class VisibilityProductSettings(NetworkProduct, NetworkAssumptions):
    """The ``visibility`` product: extinction and visibility where beams of lidars cross."""

    average: PartOfDay = Field(
        default=timedelta(minutes=10), description="interval over which signals are averaged"
    )
    block: PartOfDay = Field(
        default=timedelta(hours=6), description="interval of averages that are one field"
    )
    visibility: VisibilitySettings = VisibilitySettings()
    farthest: float | None = quantity(
        None, unit="m", ge=10, description="largest range used; by default the last bin"
    )
    exponent: float = quantity(
        1.0,
        unit="1",
        ge=EXPONENTS[0],
        le=EXPONENTS[1],
        description="m in backscatter proportional to extinction^(1/m)",
    )
    exponents: dict[str, Annotated[float, Field(ge=EXPONENTS[0], le=EXPONENTS[1])]] = quantity(
        {}, unit="1", description="exponent of instruments that differ"
    )
    background_range: BackgroundRange | None = quantity(
        None, unit="m", description="by default the last tenth of the bins"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.block % self.average:
            raise ValueError("block must be a multiple of average")
        if self.block > _MOST_AVERAGES * self.average:
            raise ValueError(f"block must hold at most {_MOST_AVERAGES} averages")
        if self.multiplier is not None and "prior" in self.model_fields_set:
            raise located_error("is not used with a multiplier: leave one of them out", "prior")
        return self

    def check_members(self, instruments: Sequence[str]) -> None:
        """Raise ValueError where `exponents` names an instrument that is not in the network."""
        unknown = sorted(set(self.exponents) - set(instruments))
        if unknown:
            raise located_error(
                f"not in instruments; {nearest(unknown[0], instruments)}known instruments:"
                f" {', '.join(instruments)}",
                "exponents",
                unknown[0],
            )


def _section(members: Sequence[InstrumentHeaders]) -> tuple[str, ...]:
    """Return the lines of the section; empty where the members share no elastic channel."""
    first, *others = (member.elastic_channels for member in members)
    shared = [name for name in first if all(name in other for other in others)]
    return (f"visibility: {{channel: {shared[0]}, average: 10min}}",) if shared else ()


KIND: Final = Kind(
    name=NAME,
    title="Visibility",
    package=__name__,
    settings=VisibilityProductSettings,
    rank=10,
    draft=_section,
)
